// log sum exp(x), and the terms of the sum.
#pragma once

#include "elementary.h"

namespace hmt {

// Replaces x by exp(x - largest) and returns the sum of these.
HMT_WIDE inline double exponentials(double* x, double largest, Index count) {
  for (Index i = 0; i < count; ++i) x[i] = elementary::exp(x[i] - largest);
  double sum = 0.0;
  for (Index i = 0; i < count; ++i) sum += x[i];
  return sum;
}

// log sum exp of the numbers in `x`, which are overwritten.
HMT_WIDE inline double log_sum_exp(double* x, Index count) {
  double largest = -infinity;
  for (Index i = 0; i < count; ++i) {
    if (!(x[i] <= largest)) largest = x[i];
    if (std::isnan(largest)) return nan;
  }
  if (std::isinf(largest)) return largest;
  return largest + elementary::log(exponentials(x, largest, count));
}
HMT_INLINE double log_add_exp(double a, double b) {
  if (a == b) return a + 0x1.62e42fefa39efp-1;  // log 2; also if both are infinite
  const double larger = a > b ? a : b;
  return larger + elementary::log1p(elementary::exp(-std::abs(a - b)));
}

}  // namespace hmt
