// Symmetric block-tridiagonal matrices P in the columns (T n, width + 1) of LAPACK's band storage,
// [j, i - j] = P[i, j]; see hmt_ros/inference/block_tridiagonal.py.
#pragma once

#include "lanes.h"
#include "small_matrix.h"
#include "wide.h"

namespace hmt {

// Adds blocks (T, d, d) to the leading parts of the diagonal blocks (n, n). Only the upper triangle
// of each block is read.
inline void add_diagonal(const Matrix& columns, const Tables& blocks, Index n) {
  const Index times = blocks.size(), d = blocks.size(1);
  expect_shape("blocks", blocks, {times, d, d});
  const bool may_fit = d <= n && (times == 0 || n <= columns.size());  // so that T n is safe
  expect(may_fit && times * n == columns.size(), "n", "at least d, and T n columns");
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
HMT_WIDE inline void add_band_product(const Matrix& columns, const Table& x, const Matrix& result) {
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

// Removes variables from a system: their rows and columns become those of the identity.
inline void hold(const Matrix& columns, const Places& held) {
  expect_range("held", held, 0, columns.size());
  expect(columns.size(1) > 0, "columns", "a diagonal");
  for (Index j : held) {
    columns[j].fill(0.0);
    for (Index b = 1; b <= std::min(columns.size(1) - 1, j); ++b) columns(j - b, b) = 0.0;
    columns(j, 0) = 1.0;
  }
}

// ---- Cholesky factors, in place. Indexed by rows i and columns c, the band is a matrix [i, c]
// whose columns start `width` numbers apart.

inline constexpr Index panel_columns = 2 * lanes;  // number of columns eliminated together

// Subtracts products of the rows of a panel from R columns of the target, in G groups of rows from
// row i: target[i, r] -= sum over k of panel[k, r] panel[k, i].
template <int R, int G>
HMT_INLINE void subtract_products(double* target, Index width, const double* panel, Index stride,
                                  Index count, Index i) {
  Group<double> sums[R][G];
  for (int r = 0; r < R; ++r) {
    for (int g = 0; g < G; ++g) {
      sums[r][g] = matrices::group(target + r * width + g * group_size);
    }
  }
  for (Index k = 0; k < count; ++k) {
    const double* row = panel + k * stride;
    for (int g = 0; g < G; ++g) {
      const auto right = *reinterpret_cast<const Group<double>*>(row + i + g * group_size);
      for (int r = 0; r < R; ++r) sums[r][g] -= row[r] * right;
    }
  }
  for (int r = 0; r < R; ++r) {
    for (int g = 0; g < G; ++g) {
      matrices::group(target + r * width + g * group_size) = sums[r][g];
    }
  }
}

// The same for all `rows` of the columns, from the diagonal of the first column. A group may extend
// below the rows, where the panel is 0, but not above the diagonal or outside the band.
template <int R>
HMT_INLINE void subtract_products(double* target, Index width, const double* panel, Index stride,
                                  Index count, Index rows) {
  constexpr Index g = group_size;
  const auto subtract_some = [&](Index i) {
    double some[R * g] = {};
    const Index here = std::min(g, rows - i);
    for (int r = 0; r < R; ++r) std::copy_n(target + r * width + i, here, some + r * g);
    subtract_products<R, 1>(some, g, panel, stride, count, i);
    for (int r = 0; r < R; ++r) {
      for (Index b = i == 0 ? r : 0; b < here; ++b) target[r * width + i + b] = some[r * g + b];
    }
  };
  subtract_some(0);
  const Index last = std::min(rows, (width + 1) / g * g);
  Index i = g;
  for (; i + g < last; i += 2 * g) {
    subtract_products<R, 2>(target + i, width, panel, stride, count, i);
  }
  for (; i < last; i += g) subtract_products<R, 1>(target + i, width, panel, stride, count, i);
  if (i < rows) subtract_some(i);
}

// Returns the number of columns with a positive and finite pivot; if it is not all, the matrix is
// not positive definite. Columns of a block of n end with the next block; below it they are 0.
HMT_WIDE inline Index factorise_columns(const Matrix& columns, const Matrix& room, Index n) {
  const Index total = columns.size(), width = columns.size(1) - 1, stride = room.size(1);
  for (Index first = 0; first < total; first += panel_columns) {
    const Index count = std::min(panel_columns, total - first);
    const Index end = std::min(total, ((first + count - 1) / n + 2) * n);
    const Index rows = std::min(width + count, end - first);
    for (Index k = 0; k < count; ++k) {
      double* row = room.data + k * stride;
      std::fill_n(row, stride, 0.0);
      std::copy_n(columns[first + k].data, std::min(width + 1, rows - k), row + k);
      for (Index b = k / panel_columns * panel_columns; b < stride; b += panel_columns) {
        subtract_products<1, 4>(row + b, 0, room.data + k, stride, k, b - k);
      }
      const double pivot = row[k];
      if (!(pivot > 0.0 && pivot < infinity)) return first + k;
      const double root = std::sqrt(pivot), inverse = 1.0 / root;
      for (Index b = 0; b < stride; b += group_size) matrices::group(row + b) *= inverse;
      row[k] = root;
      std::copy_n(row + k, std::min(width + 1, rows - k), columns[first + k].data);
    }
    Index c = count;
    for (; c + 4 <= rows; c += 4) {
      subtract_products<4>(columns[first + c].data, width, room.data + c, stride, count, rows - c);
    }
    for (; c < rows; ++c) {
      subtract_products<1>(columns[first + c].data, width, room.data + c, stride, count, rows - c);
    }
  }
  return total;
}
inline Index factorise_blocks(const Matrix& columns, Index n) {
  const Index longest = (columns.size(1) / panel_columns + 3) * panel_columns;
  const Scratch<double, 2> room(panel_columns, longest);
  return factorise_columns(columns, room.view(), n);
}
// Cholesky factor of a positive definite band, in place; returns the number of columns, or the
// first column whose pivot is not positive.
inline Index factorise_band(const Matrix& columns) {
  expect(columns.size(1) > 0, "columns", "a diagonal");
  return factorise_blocks(columns, std::max<Index>(columns.size(), 1));
}

inline void expect_vectors(const Matrix& columns, const Matrix& x) {
  expect(columns.size(1) > 0, "columns", "a diagonal");
  expect_shape("x", x, {-1, columns.size()});
}

// Replaces vectors x (S, T n) by L^-1 x.
HMT_WIDE inline void solve_band_lower(const Matrix& columns, const Matrix& x) {
  expect_vectors(columns, x);
  const Index total = columns.size(), width = columns.size(1) - 1;
  for (Index c = 0; c < total; ++c) {
    const double* column = columns.data + c * (width + 1);
    const Index last = std::min(width + 1, total - c);
    for (Index s = 0; s < x.size(); ++s) {
      double* to = x.data + s * total + c;
      const double own = to[0] /= column[0];
      Index b = 1;
      for (; b + group_size <= last; b += group_size) {
        matrices::group(to + b) -= own * *reinterpret_cast<const Group<double>*>(column + b);
      }
      for (; b < last; ++b) to[b] -= own * column[b];
    }
  }
}

// Replaces vectors x (S, T n) by L'^-1 x.
HMT_WIDE inline void solve_band_transposed(const Matrix& columns, const Matrix& x) {
  expect_vectors(columns, x);
  const Index total = columns.size(), width = columns.size(1) - 1;
  for (Index c = total - 1; c >= 0; --c) {
    const double* column = columns.data + c * (width + 1);
    const Index last = std::min(width, total - 1 - c);
    for (Index s = 0; s < x.size(); ++s) {
      double* to = x.data + s * total + c;
      to[0] = (to[0] - dot(column + 1, to + 1, last)) / column[0];
    }
  }
}

// Replaces vectors x (S, T n) by L' x.
HMT_WIDE inline void multiply_band_transposed(const Matrix& columns, const Matrix& x) {
  expect_vectors(columns, x);
  const Index total = columns.size(), width = columns.size(1) - 1;
  for (Index c = 0; c < total; ++c) {
    const double* column = columns.data + c * (width + 1);
    const Index last = std::min(width + 1, total - c);
    for (Index s = 0; s < x.size(); ++s) {
      double* to = x.data + s * total + c;
      to[0] = dot<double>(column, to, last);
    }
  }
}

// Writes the inverse of the lower triangle of rows into rows that are 0.
HMT_WIDE inline void invert_lower(matrices::Rows l, Index n, matrices::Rows result) {
  for (Index i = 0; i < n; ++i) {
    double* row = result[i];
    row[i] = 1.0;
    for (Index j = 0; j < i; ++j) matrices::subtract(row, l[i][j], result[j], 0, j + 1);
    matrices::divide(row, l[i][i], 0, i + 1);
  }
}

// The diagonal block (n, n) of P^-1 at `place`, from the next diagonal block C of P^-1; the last
// block needs none. L is the diagonal block of the factor, B the block below L, and G = B L^-1:
//
//     result = (L L')^-1 + G' C G = L'^-1 L^-1 + G' (C G)
inline void invert_block(const Matrix& columns, Index place, const Table& after,
                         const Matrix& result) {
  using namespace matrices;
  const Index n = result.size(), width = columns.size(1) - 1;
  expect_shape("result", result, {n, n});
  expect(columns.size(1) > 0, "columns", "a diagonal");
  expect(n > 0 && columns.size() % n == 0, "columns", "whole blocks");
  expect(place >= 0 && place < columns.size() / n, "place", "that of a block");
  const Index first = place * n;
  const bool last = first + n == columns.size();
  expect_shape("after", after, {last ? 0 : n, n});
  const Index side = in_whole_lanes(n), rows = last ? n : 2 * n;
  const Scratch<double, 2> own(n, side), below(n, side), left(rows, side), right(rows, side);
  const Scratch<double, 1> room((rows + 1) * lanes);
  for (Index b = 0; b < n; ++b) {
    const double* column = columns[first + b].data;
    for (Index a = b; a < n && a - b <= width; ++a) own(a, b) = column[a - b];
    for (Index a = 0; !last && a < n && n + a - b <= width; ++a) below(a, b) = column[n + a - b];
  }
  invert_lower({own[0].data, side}, n, {left[0].data, side});
  std::copy_n(left[0].data, n * side, right[0].data);
  const auto matrix = [](double* data, Index stride, bool turned = false) {
    const Index down = stride * Index(sizeof(double)), across = sizeof(double);
    char* bytes = reinterpret_cast<char*>(data);
    return turned ? Strided<double>{bytes, across, down} : Strided<double>{bytes, down, across};
  };
  if (!last) {
    double *gain = left[n].data, *carried = right[n].data;
    multiply(matrix(below[0].data, side), matrix(left[0].data, side), matrix(gain, side), n, n, n,
             room.view().data);
    multiply(matrix(const_cast<double*>(after.data), n), matrix(gain, side), matrix(carried, side),
             n, n, n, room.view().data);
  }
  multiply(matrix(left[0].data, side, true), matrix(right[0].data, side), matrix(result.data, n), n,
           rows, n, room.view().data);
  for (Index a = 0; a < n; ++a) {
    for (Index b = 0; b < a; ++b) {
      result(a, b) = result(b, a) = 0.5 * (result(a, b) + result(b, a));
    }
  }
}

}  // namespace hmt
