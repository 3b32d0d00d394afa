// Symmetric block-tridiagonal matrices P in the columns (T n, width + 1) of LAPACK's band storage,
// [j, i - j] = P[i, j]; see hmt_ros/inference/block_tridiagonal.py.
#pragma once

#include "fused_products.h"

namespace hmt {

// Adds blocks (T, d, d) to the leading parts of the diagonal blocks (n, n). Of each block the upper
// triangle is read.
inline void add_diagonal(const Matrix& columns, const Tables& blocks, Index n) {
  const Index times = blocks.size(), d = blocks.size(1);
  expect_shape("blocks", blocks, {times, d, d});
  expect(d <= n && times * n == columns.size(), "n", "at least d, and T n columns");
  expect(d <= columns.size(1), "columns", "a band as wide as the blocks");
  for (Index t = 0; t < times; ++t) {
    for (Index b = 0; b < d; ++b) {
      const double* row = blocks[t][b].data;
      double* column = columns[t * n + b].data;
      for (Index a = b; a < d; ++a) column[a - b] += row[a];
    }
  }
}

// Writes the blocks E_t (T - 1, n, n) below the diagonal.
inline void fill_lower(const Matrix& columns, const Tables& lower) {
  const Index count = lower.size(), n = lower.size(1), width = columns.size(1) - 1;
  expect_shape("lower", lower, {count, n, n});
  expect_shape("columns", columns, {(count + 1) * n, -1});
  for (Index t = 0; t < count; ++t) {
    for (Index b = 0; b < n; ++b) {
      double* column = columns[t * n + b].data;
      const Index rows = std::min(n, width - n + b + 1);
      for (Index a = 0; a < rows; ++a) column[n + a - b] = lower(t, a, b);
    }
  }
}

// Adds P x, (S, T n), of vectors x (S, T n).
HMT_FUSED inline void add_band_product(const Matrix& columns, const Table& x,
                                       const Matrix& result) {
  const Index total = columns.size(), width = columns.size(1), count = x.size();
  expect_shape("x", x, {count, total});
  expect_shape("result", result, {count, total});
  for (Index s = 0; s < count; ++s) {
    for (Index c = 0; c < total; ++c) {
      const Index last = std::min(width, total - c);
      const double* column = columns[c].data;
      const double* from = x[s].data + c;
      double* to = result[s].data + c;
      const double own = from[0];
      to[0] += dot(column, from, last);
      for (Index b = 1; b < last; ++b) to[b] += column[b] * own;
    }
  }
}

// Takes variables out of a system: their rows and columns become those of the unit matrix.
inline void hold(const Matrix& columns, const Places& held) {
  expect_range("held", held, 0, columns.size());
  expect(columns.size(1) > 0, "columns", "a diagonal");
  for (Index j : held) {
    columns[j].fill(0.0);
    for (Index b = 1; b <= std::min(columns.size(1) - 1, j); ++b) columns(j - b, b) = 0.0;
    columns(j, 0) = 1.0;
  }
}

}  // namespace hmt
