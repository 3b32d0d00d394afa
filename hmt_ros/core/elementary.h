// Elementary functions with identical results on every processor.
//
// The C library selects an implementation by processor. These functions only use + - * / and the
// square root, for which IEEE 754 defines the rounding, in a fixed order and without fused
// products. Each result is within one unit in the last place. There are no branches, so that loops
// over arrays are vectorised; only sines and cosines beyond `reduced_limit` leave the loop.
// Polynomials are minimax fits with errors below 2^-58 of the result.
#pragma once

#include <bit>

#include "arrays.h"
#include "wide.h"

namespace hmt::elementary {

using Bits = std::uint64_t;

// The unevaluated sum of two numbers; the second is at most half a unit in the last place of the
// first.
struct Pair {
  double high, low;
};

inline constexpr double rounder = 0x1.8p52;  // adding and subtracting it rounds to an integer
inline constexpr double least_normal = 0x1p-1022;
inline constexpr double reduced_limit = 1e6;  // rad
inline constexpr double root_half_up = 0x1.6a09e667f3bcdp-1;

HMT_INLINE Bits bits_of(double x) { return std::bit_cast<Bits>(x); }
HMT_INLINE double from_bits(Bits bits) { return std::bit_cast<double>(bits); }
HMT_INLINE double absolute(double x) { return from_bits(bits_of(x) & ~Bits{0} >> 1); }
HMT_INLINE Bits sign_bit(double x) { return bits_of(x) & Bits{1} << 63; }
HMT_INLINE double with_sign(double x, Bits sign) { return from_bits(bits_of(x) ^ sign); }
// Selects one of two numbers; the mask has all bits or none.
HMT_INLINE double either(Bits mask, double yes, double no) {
  return from_bits((bits_of(yes) & mask) | (bits_of(no) & ~mask));
}

HMT_INLINE Pair two_sum(double a, double b) {  // exact, like the next two functions
  const double sum = a + b, part = sum - a;
  return {sum, (a - (sum - part)) + (b - part)};
}
HMT_INLINE Pair quick_two_sum(double a, double b) {  // |a| >= |b|
  const double sum = a + b;
  return {sum, b - (sum - a)};
}
HMT_INLINE Pair two_product(double a, double b) {
  constexpr double splitter = 0x1p27 + 1.0;
  const double p = a * splitter, q = b * splitter;
  const double a1 = p - (p - a), a2 = a - a1, b1 = q - (q - b), b2 = b - b1;
  const double product = a * b;
  return {product, ((a1 * b1 - product) + a1 * b2 + a2 * b1) + a2 * b2};
}
HMT_INLINE Pair sum_of(Pair a, Pair b) {
  const Pair s = two_sum(a.high, b.high);
  return quick_two_sum(s.high, s.low + (a.low + b.low));
}
HMT_INLINE Pair ratio_of(Pair a, Pair b) {
  const double q = a.high / b.high;
  const Pair p = two_product(q, b.high);
  const double left = ((a.high - p.high) - p.low) + (a.low - q * b.low);
  return {q, left / b.high};
}
HMT_INLINE Pair root_of(Pair a) {
  const double root = std::sqrt(a.high);
  const Pair p = two_product(root, root);
  const double left = ((a.high - p.high) - p.low) + a.low;
  return {root, root > 0.0 ? left / (2.0 * root) : 0.0};
}

HMT_INLINE double polynomial(double, double last) { return last; }
template <class... More>
HMT_INLINE double polynomial(double x, double first, More... more) {
  return first + x * polynomial(x, more...);
}

// ---- sine and cosine: x = n pi/2 + r, |r| <= pi/4

struct Reduced {
  Pair rest;
  Bits quadrant;  // only the last two bits are valid
};

// Pieces of pi/2 with 33 bits, so that products with integers up to 2^20 are exact.
HMT_INLINE Reduced reduced(double x) {
  const double shifted = x * 0x1.45f306dc9c883p-1 + rounder, n = shifted - rounder;
  const Pair first = two_sum(x - n * 0x1.921fb544p+0, -(n * 0x1.0b4611a6p-34));
  const Pair second = two_sum(first.high, -(n * 0x1.3198a2ep-69));
  const double low = (first.low + second.low) - n * 0x1.b839a252049c1p-104;
  return {quick_two_sum(second.high, low), bits_of(shifted)};
}

// Reduction of any |x| >= 1, with the 256 bits of 2/pi that determine x 2/pi mod 4.
inline Reduced reduced_far(double x) {
  __extension__ using Wide = unsigned __int128;
  static constexpr Bits two_over_pi[] = {0x0000000000000000, 0xa2f9836e4e441529,
                                         0xfc2757d1f534ddc0, 0xdb6295993c439041,
                                         0xfe5163abdebbc561, 0xb7246e3a424dd2e0,
                                         0x06492eea09d1921c, 0xfe1deb1cb129a73e,
                                         0xe88235f52ebb4484, 0xe99c7026b45f7e41,
                                         0x3991d639835339f4, 0x9c845f8bbdf9283b,
                                         0x1ff897ffde05980f, 0xef2f118b5a0a6d1f,
                                         0x6d367ecf27cb09b7, 0x4f463f669e5fea2d,
                                         0x7527bac7ebe5f17b, 0x3d0739f78a5292ea,
                                         0x6bfb5fb11f8d5d08, 0x56033046fc7b6bab,
                                         0xf0cfbc209af4361d, 0};
  const Bits whole = (bits_of(x) & ((Bits{1} << 52) - 1)) | Bits{1} << 52;
  // x = whole 2^e; bits of 2/pi above 2^(2 - e) give whole turns.
  const int e = int(bits_of(absolute(x)) >> 52) - 1075, start = e - 2 + 64;
  const int word = start / 64, shift = start % 64;
  Bits limbs[4];  // of x 2/pi mod 4, the highest first
  Wide carry = 0;
  for (int i = 3; i >= 0; --i) {
    Bits window = two_over_pi[word + i] << shift;
    if (shift) window |= two_over_pi[word + i + 1] >> (64 - shift);
    carry += Wide{whole} * window;
    limbs[i] = static_cast<Bits>(carry);
    carry >>= 64;
  }
  const bool negative = limbs[0] >> 61 & 1;  // nearer to the next quadrant
  Reduced result{{0.0, 0.0}, (limbs[0] >> 62) + negative};
  for (int i = 0; i < 4; ++i) {
    Bits limb = limbs[i] << 2 | (i < 3 ? limbs[i + 1] >> 62 : 0);
    if (negative) limb = ~limb;
    for (int half = 0; half < 2; ++half) {
      const double part = double(half ? limb & 0xffffffff : limb >> 32);
      const Pair sum = quick_two_sum(result.rest.high,
                                     part * from_bits(Bits(1023 - 64 * i - 32 * (half + 1)) << 52));
      result.rest = {sum.high, result.rest.low + sum.low};
    }
  }
  const double high = result.rest.high, low = result.rest.low;
  Pair rest = two_product(high, 0x1.921fb54442d18p+0);
  rest = quick_two_sum(rest.high,
                       rest.low + (high * 0x1.1a62633145c07p-54 + low * 0x1.921fb54442d18p+0));
  const Bits flip = sign_bit(x) ^ Bits { negative } << 63;
  result.rest = {with_sign(rest.high, flip), with_sign(rest.low, flip)};
  if (sign_bit(x)) result.quadrant = -result.quadrant;
  return result;
}

struct SineCosine {
  double sine, cosine;
};

HMT_INLINE SineCosine sine_cosine(Reduced at) {
  const double r = at.rest.high, low = at.rest.low, z = r * r, half = 0.5 * z, w = 1.0 - half;
  const double s =
      polynomial(z, -0.16666666666666666, 0.008333333333333323, -0.00019841269841255126,
                 2.7557319214222017e-06, -2.5052104920056576e-08, 1.6058367733826253e-10,
                 -7.578753955702908e-13);
  const double c =
      polynomial(z, 0.0416666666666666, -0.0013888888888874133, 2.4801587289487704e-05,
                 -2.755731435395923e-07, 2.0875723499094543e-09, -1.1359659759034824e-11);
  const double sine = r + (r * z * s + (low - half * low));
  const double cosine = w + (((1.0 - w) - half) + (z * z * c - r * low));
  const Bits q = at.quadrant, swap = -(q & 1);
  return {with_sign(either(swap, cosine, sine), q >> 1 << 63),
          with_sign(either(swap, sine, cosine), (q + 1) >> 1 << 63)};
}
HMT_INLINE double sin_near(double x) {
  const double sine = sine_cosine(reduced(x)).sine;
  return x == 0.0 ? x : sine;
}
HMT_INLINE double cos_near(double x) { return sine_cosine(reduced(x)).cosine; }
HMT_INLINE bool is_far(double x) { return absolute(x) > reduced_limit && absolute(x) < infinity; }
inline SineCosine sincos(double x) {
  SineCosine result = sine_cosine(is_far(x) ? reduced_far(x) : reduced(x));
  if (x == 0.0) result.sine = x;
  return result;
}
inline double sin(double x) { return is_far(x) ? sincos(x).sine : sin_near(x); }
inline double cos(double x) { return is_far(x) ? sincos(x).cosine : cos_near(x); }

// ---- exponential: x = n log 2 + r

struct Power {
  Pair less_one;  // exp(r) - 1
  Bits n;         // plus 2048
};

HMT_INLINE Power power_of(Pair x) {
  const double shifted = x.high * 0x1.71547652b82fep+0 + rounder, n = shifted - rounder;
  const double high = x.high - n * 0x1.62e42fefp-1;
  const double low = x.low - n * 0x1.473de6af278edp-34;
  const Pair r = quick_two_sum(high, low);
  const double p = polynomial(r.high, 0.5, 0.16666666666666685, 0.04166666666666673,
                              0.008333333333316588, 0.0013888888888858384, 0.00019841269897439225,
                              2.4801587373869427e-05, 2.755723385082424e-06, 2.755723323998492e-07,
                              2.511237629770123e-08, 2.092698284648139e-09);
  return {{r.high, r.high * r.high * p + (r.low + r.low * r.high)},
          bits_of(shifted) - bits_of(rounder) + 2048};
}
HMT_INLINE double scaled(double x, Bits n) {  // by 2^n in two steps, for subnormal results
  const Bits half = n >> 1, rest = n - half;
  return x * from_bits((half - 1) << 52) * from_bits((rest - 1) << 52);
}
HMT_INLINE double exp(Pair x) {
  const bool least = x.high < -750.0, most = x.high > 710.0;
  x.high = least ? -750.0 : x.high;
  x.high = most ? 710.0 : x.high;
  x.low = least || most ? 0.0 : x.low;
  const Power power = power_of(x);
  const Pair sum = quick_two_sum(1.0, power.less_one.high);
  return scaled(sum.high + (sum.low + power.less_one.low), power.n);
}
HMT_INLINE double exp(double x) { return exp(Pair{x, 0.0}); }

// exp(x) - 1 up to x = 700.
HMT_INLINE Pair less_one(double x) {
  const Power power = power_of({x < -50.0 ? -50.0 : x, 0.0});
  const double scale = from_bits((power.n - 1025) << 52);
  const Pair whole = quick_two_sum(scale, scale * power.less_one.high);
  const Pair less = two_sum(whole.high, -1.0);
  return quick_two_sum(less.high, less.low + (whole.low + scale * power.less_one.low));
}
HMT_INLINE double expm1(double x) {
  const double near = less_one(x > 700.0 ? 700.0 : x).high, far = exp(x);
  return x == 0.0 ? x : x > 50.0 ? far : near;
}
HMT_INLINE double tanh(double x) {
  const double size = absolute(x);
  const Pair e = less_one(size > 25.0 ? 50.0 : 2.0 * size);
  const Pair result = ratio_of(e, sum_of({2.0, 0.0}, e));
  const double sum = result.high + result.low;
  return x == 0.0 ? x : with_sign(sum, sign_bit(x));
}

// ---- logarithm: x = 2^n f, f from sqrt(1/2) up to sqrt(2)

struct Normal {
  double n, f;
};

HMT_INLINE Normal normal(double x) {
  constexpr Bits start = std::bit_cast<Bits>(root_half_up), one = Bits{1023} << 52;
  const bool tiny = x < least_normal;
  const Bits bits = bits_of(tiny ? x * 0x1p54 : x) + (one - start);
  const double n = from_bits((bits >> 52) | bits_of(0x1p52)) - (0x1p52 + 1023.0);
  return {tiny ? n - 54.0 : n, from_bits((bits & ((Bits{1} << 52) - 1)) + start)};
}
// n log 2 + log(1 + g) + low.
HMT_INLINE double log_of(double n, double g, double low) {
  const double s = g / (2.0 + g), z = s * s, half = 0.5 * g * g;
  const double rest = z * polynomial(z, 0.6666666666666666, 0.4000000000000624, 0.28571428569086726,
                                     0.22222222646688045, 0.18181775673194092, 0.15387090454064092,
                                     0.1325012441552209, 0.13251275996532197);
  const double small = s * (half + rest) + (n * 0x1.473de6af278edp-34 + low);
  return n * 0x1.62e42fefp-1 - ((half - small) - g);
}
HMT_INLINE double log_ends(double x, double inside) {
  return x > 0.0 ? (x < infinity ? inside : x) : x == 0.0 ? -infinity : nan;
}
HMT_INLINE double log(double x) {
  const Normal at = normal(x);
  return log_ends(x, log_of(at.n, at.f - 1.0, 0.0));
}
HMT_INLINE double log1p(double x) {
  const Pair u = two_sum(1.0, x);
  const Normal at = normal(u.high);
  const double inside = log_of(at.n, at.f - 1.0, u.low / u.high);
  return either(-Bits{x == 0.0}, x, log_ends(u.high, inside));
}

// The logarithm with a relative error below 2^-65, for powers.
HMT_INLINE Pair log_pair(double x) {
  const Normal at = normal(x);
  const double g = at.f - 1.0;
  const Pair s = ratio_of({g, 0.0}, two_sum(2.0, g));
  const Pair z = two_product(s.high, s.high);
  const double q =
      polynomial(z.high, 0.2000000000000102, 0.14285714285093756, 0.11111111253143434,
                 0.0909089271415285, 0.07693356559093556, 0.06628880351426666, 0.06594117177587548);
  // log f = 2 s (1 + z (1/3 + z q))
  const Pair third = quick_two_sum(0x1.5555555555555p-2, z.high * q);
  const double thirds = third.low + 0x1.5555555555555p-56 + z.low * q;
  Pair w = two_product(z.high, third.high);
  w.low += z.high * thirds + (z.low + 2.0 * s.high * s.low) * third.high;
  Pair more = two_product(s.high, w.high);
  more.low += s.high * w.low + s.low * w.high;
  const Pair fraction = sum_of(s, more);
  const Pair whole = two_sum(at.n * 0x1.62e42fefp-1, 2.0 * fraction.high);
  return quick_two_sum(whole.high, whole.low + (at.n * 0x1.473de6af278edp-34 + 2.0 * fraction.low));
}
// x^y for x >= 0; NaN for x < 0, unless y is 0.
HMT_INLINE double pow(double x, double y) {
  constexpr double most_power = 0x1p64;  // larger exponents give the same result
  double power = y > most_power ? most_power : y;
  power = power < -most_power ? -most_power : power;
  const Pair log = log_pair(x);
  Pair product = two_product(power, log.high);
  product.low += power * log.low;
  const double inside = exp(product), zero = y > 0.0 ? 0.0 : infinity;
  double result = x > 0.0 ? inside : x == 0.0 ? zero : nan;
  result = x == infinity ? (y > 0.0 ? infinity : 0.0) : result;
  result = y != y ? y : result;
  return x == 1.0 || y == 0.0 ? 1.0 : result;
}

// ---- inverse functions

// The angle of the point (x, y) with x, y >= 0; if turned, the angle of (-x, y).
HMT_INLINE double angle_of(Pair y, Pair x, bool turned) {
  const bool steep = y.high > x.high;
  Pair less = steep ? x : y, more = steep ? y : x;
  // Scale the larger one to 1 to 4, so that products neither overflow nor vanish.
  const double scale =
      more.high >= 0x1p1022
          ? 0x1p-1022
          : from_bits((Bits{2046} << 52) - (bits_of(more.high) & Bits{2047} << 52));
  const bool endless = more.high == infinity;
  less.high = endless ? (less.high == infinity ? 1.0 : 0.0) : less.high * scale;
  more.high = endless || more.high == 0.0 ? 1.0 : more.high * scale;
  less.low *= scale;
  more.low *= scale;
  const bool middle = less.high > 0.41421356237309503 * more.high;
  const Pair difference = sum_of(less, {-more.high, -more.low}), sum = sum_of(less, more);
  const Pair top{middle ? difference.high : less.high, middle ? difference.low : less.low};
  const Pair bottom{middle ? sum.high : more.high, middle ? sum.low : more.low};
  const Pair ratio = ratio_of(top, bottom);
  const double t = ratio.high, low = absolute(t) > 0x1p-900 ? ratio.low : 0.0, z = t * t;
  const double rest =
      (t * z) * polynomial(z, -0.33333333333333326, 0.19999999999997667, -0.14285714285387852,
                           0.11111111088170347, -0.09090908144318194, 0.07692282754855004,
                           -0.06666226711482101, 0.05877021423316261, -0.05218402328664302,
                           0.04503542075886042, -0.03347430225823904, 0.015195006964371408) +
      (low - z * low);
  // The angle is plus or minus the angle of t, plus a multiple of an eighth of a turn.
  const Bits flip = (Bits{steep} ^ Bits{turned}) << 63;
  double eighths = middle ? 1.0 : 0.0;
  eighths = steep ? 2.0 - eighths : eighths;
  eighths = turned ? 4.0 - eighths : eighths;
  const Pair whole = two_sum(eighths * 0x1.921fb54442d18p-1, with_sign(t, flip));
  return whole.high + (whole.low + (eighths * 0x1.1a62633145c07p-55 + with_sign(rest, flip)));
}
HMT_INLINE double atan2(double y, double x) {
  const double angle = angle_of({absolute(y), 0.0}, {absolute(x), 0.0}, sign_bit(x) != 0);
  const double result = with_sign(angle, sign_bit(y));
  return x != x ? x : y != y ? y : result;
}
HMT_INLINE double atan(double x) { return atan2(x, 1.0); }
HMT_INLINE Pair other_side(double x) {  // sqrt(1 - x^2)
  const Pair square = two_product(x, x), rest = two_sum(1.0, -square.high);
  return root_of(quick_two_sum(rest.high, rest.low - square.low));
}
HMT_INLINE double asin(double x) {
  const double angle = with_sign(angle_of({absolute(x), 0.0}, other_side(x), false), sign_bit(x));
  return absolute(x) <= 1.0 ? angle : nan;
}
HMT_INLINE double acos(double x) {
  const double angle = angle_of(other_side(x), {absolute(x), 0.0}, sign_bit(x) != 0);
  return absolute(x) <= 1.0 ? angle : nan;
}
HMT_INLINE double hypot(double x, double y) {
  const double a = absolute(x), b = absolute(y), more = a > b ? a : b;
  const double scale = more > 0x1p500 ? 0x1p-600 : more < 0x1p-400 ? 0x1p600 : 1.0;
  const double back = more > 0x1p500 ? 0x1p600 : more < 0x1p-400 ? 0x1p-600 : 1.0;
  const Pair p = two_product(a * scale, a * scale), q = two_product(b * scale, b * scale);
  const Pair root = root_of(sum_of(p, q));
  const double result = (root.high + root.low) * back;
  return a == infinity || b == infinity ? infinity : result;
}

// ---- arrays, vectorised: several times as fast as number by number

template <double (*f)(double)>
HMT_WIDE void map(const double* x, double* __restrict result, Index count) {
  for (Index i = 0; i < count; ++i) result[i] = f(x[i]);
}
template <double (*f)(double, double)>
HMT_WIDE void map(const double* x, const double* y, double* __restrict result, Index count) {
  for (Index i = 0; i < count; ++i) result[i] = f(x[i], y[i]);
}
inline bool any_far(const double* x, Index count) {
  bool far = false;
  for (Index i = 0; i < count; ++i) far |= absolute(x[i]) > reduced_limit;
  return far;
}
template <double (*near)(double), double (*any)(double)>
void map_angles(const double* x, double* __restrict result, Index count) {
  map<near>(x, result, count);
  const bool far = any_far(x, count);
  for (Index i = 0; far && i < count; ++i) result[i] = any(x[i]);
}
HMT_WIDE inline void sincos_near(const double* x, double* __restrict sines,
                                 double* __restrict cosines, Index count) {
  for (Index i = 0; i < count; ++i) {
    const SineCosine both = sine_cosine(reduced(x[i]));
    sines[i] = x[i] == 0.0 ? x[i] : both.sine;
    cosines[i] = both.cosine;
  }
}
inline void sincos(const double* x, double* __restrict sines, double* __restrict cosines,
                   Index count) {
  sincos_near(x, sines, cosines, count);
  const bool far = any_far(x, count);
  for (Index i = 0; far && i < count; ++i) {
    const SineCosine both = sincos(x[i]);
    sines[i] = both.sine;
    cosines[i] = both.cosine;
  }
}

}  // namespace hmt::elementary
