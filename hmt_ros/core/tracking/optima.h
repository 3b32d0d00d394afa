// Gaussians around optima with some variables on limits; see
// hmt_ros/tracking/posterior.py and laplace_approximation.py.
#pragma once

#include "../arrays.h"
#include "../small_matrix.h"

namespace hmt {

// Fills the inverses S (K, d, d) of sums of Hessians (K, C, d, d), weighted by shares (C,), on the
// free variables (K, d), and log |S| (K,); NaN if a sum is not positive definite. A variable on a
// limit has the precision `resting`; all variables get the precision `least` in addition.
inline void free_covariances(const Array<const double, 4>& hessians, const Numbers& shares,
                             const Array<const bool, 2>& free, double resting, double least,
                             const Tensor& covariances, const Vector& log_determinants) {
  const Index n = hessians.size(), cues = hessians.size(1), d = hessians.size(2);
  expect_shape("hessians", hessians, {n, cues, d, d});
  expect_shape("shares", shares, {cues});
  expect_shape("free", free, {n, d});
  expect_shape("covariances", covariances, {n, d, d});
  expect_shape("log_determinants", log_determinants, {n});
  const Index width = in_whole_lanes(d);
  Scratch<double, 2> sum(d, d), room(d, width), other(d, width);
  const matrices::Rows rows{room.view().data, width}, inverse{other.view().data, width};
  for (Index k = 0; k < n; ++k) {
    sum.fill(0.0);
    for (Index c = 0; c < cues; ++c) {
      const double* hessian = hessians[k][c].data;
      double* total = sum.view().data;
      for (Index e = 0; e < d * d; ++e) total[e] += shares[c] * hessian[e];
    }
    const bool* moves = free[k].data;
    room.fill(0.0);
    for (Index i = 0; i < d; ++i) {
      for (Index j = i; j < d; ++j) {
        if (moves[i] && moves[j]) rows[i][j] = 0.5 * (sum(i, j) + sum(j, i));
      }
      rows[i][i] += least + (moves[i] ? 0.0 : resting);
    }
    const bool good = matrices::invert_positive(rows, d, inverse, log_determinants[k]);
    log_determinants[k] = good ? -log_determinants[k] : nan;
    for (Index i = 0; i < d; ++i) {
      for (Index j = 0; j < d; ++j) covariances(k, i, j) = good ? rows[i][j] : nan;
    }
  }
}

// Fills the optima (K, d) of the likelihood alone, by parabolas around modes of the posterior: x -
// S g, within limits and at most `most_deviations` standard deviations of the posterior away.
//
// poses: (K, d) modes
// gradient: (K, d) of the energy of the likelihood
// free: (K, d) variables that the gradient moves
// covariances, spreads: (K, d, d) of the likelihood, and of the posterior
// limits: (2, d) lower and upper
inline void shift_modes(const Table& poses, const Table& gradient, const Array<const bool, 2>& free,
                        const Tables& covariances, const Tables& spreads, double most_deviations,
                        const Table& limits, const Matrix& means) {
  const Index n = poses.size(), d = poses.size(1);
  expect_shape("gradient", gradient, {n, d});
  expect_shape("free", free, {n, d});
  expect_shape("covariances", covariances, {n, d, d});
  expect_shape("spreads", spreads, {n, d, d});
  expect_shape("limits", limits, {2, d});
  expect_shape("means", means, {n, d});
  for (Index k = 0; k < n; ++k) {
    for (Index i = 0; i < d; ++i) {
      const double* row = covariances[k][i].data;
      double step = 0.0;
      for (Index j = 0; j < d; ++j) step -= free(k, j) ? row[j] * gradient(k, j) : 0.0;
      const double furthest = most_deviations * std::sqrt(spreads(k, i, i));
      means(k, i) =
          between(poses(k, i) + between(step, -furthest, furthest), limits(0, i), limits(1, i));
    }
  }
}

// Fills the effective number (C,) of variables that each cue determines, tr(S H_c), averaged over K
// modes.
//
// weights, covariances: (K,), (K, d, d) of the modes
// hessians: (K, C, d, d)
inline void determined(const Numbers& weights, const Tables& covariances,
                       const Array<const double, 4>& hessians, const Vector& amounts) {
  const Index n = covariances.size(), cues = hessians.size(1), d = covariances.size(1);
  expect_shape("weights", weights, {n});
  expect_shape("covariances", covariances, {n, d, d});
  expect_shape("hessians", hessians, {n, cues, d, d});
  expect_shape("amounts", amounts, {cues});
  amounts.fill(0.0);
  for (Index k = 0; k < n; ++k) {
    for (Index c = 0; c < cues; ++c) {
      // Both are symmetric.
      const double trace = dot(covariances[k].data, hessians[k][c].data, d * d);
      amounts[c] += weights[k] * trace;
    }
  }
}

}  // namespace hmt
