// Scalar products in vector registers, in an order that is fixed.
#pragma once

#include "arrays.h"

// A function with this attribute is compiled for processors with fused products in one instruction
// and for those without; loading the core chooses. Only what is inlined into it is compiled so.
#if defined(__x86_64__) && defined(__linux__)
#define HMT_FUSED [[gnu::target_clones("fma", "default")]]
#else
#define HMT_FUSED
#endif

namespace hmt {

using Four [[gnu::vector_size(4 * sizeof(double))]] = double;

// Adds the products of four entries to four sums.
[[gnu::always_inline]] inline void add_products(const double* x, const double* y, Four& sums) {
  sums = Four{std::fma(x[0], y[0], sums[0]), std::fma(x[1], y[1], sums[1]),
              std::fma(x[2], y[2], sums[2]), std::fma(x[3], y[3], sums[3])};
}

// Sum of x[i] y[i] over i < count: eight partial sums s[i % 8] of fused products,
// ((s0 + s4) + (s2 + s6)) + ((s1 + s5) + (s3 + s7)), and then, one after the other, the products
// that are left beyond a multiple of eight. Every processor gives the same bits.
[[gnu::always_inline]] inline double dot(const double* x, const double* y, Index count) {
  Four first{}, second{};
  Index i = 0;
  for (; i + 8 <= count; i += 8) {
    add_products(x + i, y + i, first);
    add_products(x + i + 4, y + i + 4, second);
  }
  const Four both = first + second;
  double total = (both[0] + both[2]) + (both[1] + both[3]);
  for (; i < count; ++i) total = std::fma(x[i], y[i], total);
  return total;
}

}  // namespace hmt
