// Joint estimation of poses and the shape of a person; equations in
// hmt_ros/tracking/shape_estimation.py. For K modes with d variables and a shape with P variables,
// `mixed` (K, P, d) are the second derivatives by shape and pose, `covariances` (K, d, d) the
// covariances of the poses.
#pragma once

#include "small_matrix.h"

namespace hmt {

// A row-major matrix, or its transpose.
inline matrices::Strided<double> strided(const Table& matrix) {
  return {reinterpret_cast<char*>(const_cast<double*>(matrix.data)),
          matrix.size(1) * Index(sizeof(double)), sizeof(double)};
}
inline matrices::Strided<double> transposed(const Table& matrix) {
  const auto plain = strided(matrix);
  return {plain.data, plain.column, plain.row};
}
inline double mean(double a, double b) { return 0.5 * (a + b); }
inline void make_symmetric(const Matrix& matrix) {
  for (Index i = 0; i < matrix.size(); ++i) {
    for (Index j = 0; j < i; ++j) matrix(i, j) = matrix(j, i) = mean(matrix(i, j), matrix(j, i));
  }
}

inline void expect_modes(const Tables& mixed, const Tables& covariances) {
  const Index k = mixed.size(), d = mixed.size(2);
  expect_shape("covariances", covariances, {k, d, d});
}

// The variables of the shape with nonzero derivatives (P, d) by a pose. The others, such as the
// flesh without contours, add zero and are skipped.
inline std::vector<Index> coupled(const Table& mixed) {
  std::vector<Index> rows;
  for (Index p = 0; p < mixed.size(); ++p) {
    const Numbers row = mixed[p];
    if (std::any_of(row.begin(), row.end(), [](double x) { return x != 0.0; })) rows.push_back(p);
  }
  return rows;
}
inline Scratch<double, 2> rows_of(const Table& matrix, const std::vector<Index>& rows) {
  Scratch<double, 2> result(rows.size(), matrix.size(1));
  for (std::size_t i = 0; i < rows.size(); ++i) result[i].copy_from(matrix[rows[i]]);
  return result;
}

// Fills the covariances (K, d, d) of modes due to the covariance of the shape (P, P).
inline void consider_shape(const Tables& mixed, const Tables& covariances, const Table& of_shape,
                           const Tensor& result) {
  const Index k = mixed.size(), p = mixed.size(1), d = mixed.size(2);
  expect_modes(mixed, covariances);
  expect_shape("of_shape", of_shape, {p, p});
  expect_shape("result", result, {k, d, d});
  const Scratch<double, 1> room((std::max(p, d) + 1) * lanes);
  for (Index i = 0; i < k; ++i) {
    const std::vector<Index> rows = coupled(mixed[i]);
    const Index n = static_cast<Index>(rows.size());
    const Scratch<double, 2> own = rows_of(mixed[i], rows), moved(d, n), spread(d, n), known(n, n);
    for (Index a = 0; a < n; ++a) {
      for (Index b = 0; b < n; ++b) known(a, b) = of_shape(rows[a], rows[b]);
    }
    matrices::multiply(strided(covariances[i]), transposed(own), strided(moved), d, d, n,
                       room.view().data);
    matrices::multiply(strided(moved), strided(known), strided(spread), d, n, n, room.view().data);
    matrices::multiply(strided(spread), transposed(moved), strided(result[i]), d, n, d,
                       room.view().data);
    make_symmetric(result[i]);
  }
}

// Limits a shift (d,) of a pose: its angles, marked by `turns`, change by at most `most_turn`. The
// root moves to its conditional optimum: an image does not separate the size of a person from the
// distance, but a limited root would. Angles that rest on a limit have no variance. False if the
// covariance of the angles is singular.
inline bool limit_shift(const Table& covariance, const Mask& turns, double most_turn,
                        const Vector& shift) {
  const Index d = shift.size();
  double largest = 0.0, furthest = most_turn;
  std::vector<Index> free;
  for (Index i = 0; i < d; ++i) {
    largest = most(largest, std::abs(shift[i]));
    if (turns[i]) furthest = most(furthest, std::abs(shift[i]));
    if (turns[i] && covariance(i, i) > 0.0) free.push_back(i);
  }
  if (largest <= most_turn) return true;
  const Index n = static_cast<Index>(free.size()), right = in_whole_lanes(n);
  const Scratch<double, 2> room(n, right + lanes);
  const matrices::Rows rows{room.view().data, right + lanes};
  const double held_back = 1.0 - most_turn / furthest;
  for (Index i = 0; i < n; ++i) {
    for (Index j = 0; j < n; ++j) rows[i][j] = covariance(free[i], free[j]);
    rows[i][right] = shift[free[i]] * held_back;
  }
  if (n > 0 && matrices::eliminate(rows, n) == 0.0) return false;
  matrices::solve_upper(rows, n, right);
  for (Index i = 0; i < d; ++i) {
    if (turns[i]) {
      shift[i] -= shift[i] * held_back;
      continue;
    }
    double carried = 0.0;
    for (Index j = 0; j < n; ++j) carried += covariance(i, free[j]) * rows[j][right];
    shift[i] -= carried;
  }
  return true;
}

// Sets the information (P, P) and the pull (P,) on the shape from modes with weights (K,), with
// poses eliminated: S and g of the equations. `by_shape` (K, P) and `curvature` (K, P, P) are the
// derivatives by the shape, `gradients` (K, d) by the pose; for `turns` and `most_turn` see
// `limit_shift`. False if a covariance is singular.
inline bool inform_shape(const Table& by_shape, const Tables& curvature, const Tables& mixed,
                         const Numbers& weights, const Table& gradients, const Tables& covariances,
                         const Mask& turns, double most_turn, const Matrix& information,
                         const Vector& pull) {
  const Index k = mixed.size(), p = mixed.size(1), d = mixed.size(2);
  expect_modes(mixed, covariances);
  expect_shape("by_shape", by_shape, {k, p});
  expect_shape("curvature", curvature, {k, p, p});
  expect_shape("weights", weights, {k});
  expect_shape("gradients", gradients, {k, d});
  expect_shape("turns", turns, {d});
  expect_shape("information", information, {p, p});
  expect_shape("pull", pull, {p});
  const Scratch<double, 2> given(p, p);
  const Scratch<double, 1> shift(d), room((d + 1) * lanes);
  information.fill(0.0);
  pull.fill(0.0);
  for (Index i = 0; i < k; ++i) {
    for (Index j = 0; j < d; ++j) {
      shift[j] = dot(covariances[i][j].data, gradients[i].data, d);
    }
    if (!limit_shift(covariances[i], turns, most_turn, shift)) return false;
    const std::vector<Index> rows = coupled(mixed[i]);
    const Index n = static_cast<Index>(rows.size());
    const Scratch<double, 2> own = rows_of(mixed[i], rows), moved(d, n), lost(n, n);
    matrices::multiply(strided(covariances[i]), transposed(own), strided(moved), d, d, n,
                       room.view().data);
    matrices::multiply(strided(own), strided(moved), strided(lost), n, d, n, room.view().data);
    given.fill(0.0);
    for (Index a = 0; a < n; ++a) {
      for (Index b = 0; b < n; ++b) given(rows[a], rows[b]) = lost(a, b);
    }
    for (Index a = 0; a < p; ++a) {
      const double moved_along = dot(mixed[i][a].data, shift.view().data, d);
      pull[a] += weights[i] * (by_shape(i, a) - moved_along);
      for (Index b = 0; b < p; ++b) {
        information(a, b) += weights[i] * (curvature(i, a, b) - given(a, b));
      }
    }
  }
  make_symmetric(information);
  return true;
}

}  // namespace hmt
