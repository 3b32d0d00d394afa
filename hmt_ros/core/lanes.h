// Numbers side by side in vector registers, and sums in an order that is the same for all
// registers.
#pragma once

#include "arrays.h"
#include "wide.h"

namespace hmt {

// Count of numbers that are computed side by side, for registers of any width.
inline constexpr Index lanes = 8;

inline Index in_whole_lanes(Index count) { return (count + lanes - 1) / lanes * lanes; }

// ((s0 + s4) + (s2 + s6)) + ((s1 + s5) + (s3 + s7)).
inline double sum_lanes(const double* s) {
  return ((s[0] + s[4]) + (s[2] + s[6])) + ((s[1] + s[5]) + (s[3] + s[7]));
}

// Sum of x[i] over i < count, a multiple of `lanes`, from partial sums s[i % lanes].
inline double sum_of(const double* x, Index count) {
  double sums[lanes] = {};
  for (Index i = 0; i < count; i += lanes) {
#pragma omp simd
    for (int k = 0; k < lanes; ++k) sums[k] += x[i + k];
  }
  return sum_lanes(sums);
}

// Numbers in groups of 32 bytes, because compilers split larger groups badly for narrow registers.
template <class T>
struct Lanes {
  typedef T Group __attribute__((vector_size(32), aligned(alignof(T)), may_alias));
  static constexpr Index count = 32 / sizeof(T);
};
template <class T>
using Group = typename Lanes<T>::Group;
inline constexpr Index group_size = Lanes<double>::count;

// Sum of x[i] y[i] over i < n: partial sums by i % (2 count) are added in pairs; then the products
// beyond whole pairs of groups are added one by one.
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
