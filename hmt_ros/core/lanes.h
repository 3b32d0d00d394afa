// Numbers side by side in vector registers, and sums of them in an order that no register changes.
#pragma once

#include "arrays.h"
#include "wide.h"

namespace hmt {

// So many numbers are computed side by side, whatever the width of the registers.
inline constexpr Index lanes = 8;

inline Index in_whole_lanes(Index count) { return (count + lanes - 1) / lanes * lanes; }

// ((s0 + s4) + (s2 + s6)) + ((s1 + s5) + (s3 + s7)).
inline double sum_lanes(const double* s) {
  return ((s[0] + s[4]) + (s[2] + s[6])) + ((s[1] + s[5]) + (s[3] + s[7]));
}

// Sum of x[i] over i < count, which must be whole lanes: of partial sums s[i % lanes].
inline double sum_of(const double* x, Index count) {
  double sums[lanes] = {};
  for (Index i = 0; i < count; i += lanes) {
#pragma omp simd
    for (int k = 0; k < lanes; ++k) sums[k] += x[i + k];
  }
  return sum_lanes(sums);
}

// Numbers in groups of 32 bytes: compilers split larger ones badly where registers are not as wide.
template <class T>
struct Lanes {
  typedef T Group __attribute__((vector_size(32), aligned(alignof(T)), may_alias));
  static constexpr Index count = 32 / sizeof(T);
};
template <class T>
using Group = typename Lanes<T>::Group;
inline constexpr Index group_size = Lanes<double>::count;

// Sum of x[i] y[i] over i < n: of partial sums by i % (2 count), which are added in pairs, and
// then, one after the other, of the products that are left beyond whole pairs of groups.
template <class T>
HMT_INLINE T dot(const T* x, const T* y, Index n) {
  constexpr Index count = Lanes<T>::count;
  Group<T> sums{}, others{};
  Index i = 0;
  for (; i + 2 * count <= n; i += 2 * count) {
    const auto* left = reinterpret_cast<const Group<T>*>(x + i);
    const auto* right = reinterpret_cast<const Group<T>*>(y + i);
    sums += left[0] * right[0];
    others += left[1] * right[1];
  }
  sums += others;
  for (Index half = count / 2; half > 0; half /= 2) {
    for (Index k = 0; k < half; ++k) sums[k] += sums[k + half];
  }
  T total = sums[0];
  for (; i < n; ++i) total += x[i] * y[i];
  return total;
}

// Adds factor x[i] to y[i] for i < count.
inline void add_scaled(double factor, const double* x, double* y, Index count) {
#pragma omp simd
  for (Index i = 0; i < count; ++i) y[i] += factor * x[i];
}

}  // namespace hmt
