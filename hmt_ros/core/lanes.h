// Numbers side by side in vector registers, and sums of them in an order that no register changes.
#pragma once

#include "arrays.h"

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

// Sum of x[i] y[i] over i < count: of partial sums s[i % lanes], and then, one after the other, the
// products that are left beyond whole lanes.
inline double dot(const double* x, const double* y, Index count) {
  double sums[lanes] = {};
  Index i = 0;
  for (; i + lanes <= count; i += lanes) {
#pragma omp simd
    for (int k = 0; k < lanes; ++k) sums[k] += x[i + k] * y[i + k];
  }
  double total = sum_lanes(sums);
  for (; i < count; ++i) total += x[i] * y[i];
  return total;
}

// Adds factor x[i] to y[i] for i < count.
inline void add_scaled(double factor, const double* x, double* y, Index count) {
#pragma omp simd
  for (Index i = 0; i < count; ++i) y[i] += factor * x[i];
}

}  // namespace hmt
