// Distances and overlaps of pairs of Gaussians; see hmt_ros/inference/gaussian_pairs.py.
//
//     D = (a - b)' C^-1 (a - b),     log |C|,     C = s A + t B
#pragma once

#include "arrays.h"
#include "elementary.h"
#include "wide.h"

namespace hmt {

// Number of pairs whose covariances are factorised side by side; one number of each pair.
inline constexpr int pair_lanes = 4;
using PairLanes [[gnu::vector_size(pair_lanes * sizeof(double))]] = double;

// Replaces the lower triangles of covariances (d, d) by Cholesky factors, with inverses on the
// diagonal, and the offset in row d by the whitened offset (forward substitution). Two columns are
// processed at a time.
HMT_WIDE inline void whiten(PairLanes* factor, Index d) {
  for (Index i = 0; i <= d; ++i) {
    PairLanes* row = factor + i * d;
    Index j = 0;
    for (; j + 1 < i; j += 2) {
      const PairLanes *one = factor + j * d, *two = one + d;
      PairLanes p = row[j], q = row[j + 1];
      for (Index k = 0; k < j; ++k) {
        p -= row[k] * one[k];
        q -= row[k] * two[k];
      }
      p *= one[j];
      row[j] = p;
      row[j + 1] = (q - p * two[j]) * two[j + 1];
    }
    if (j < i) {
      const PairLanes* one = factor + j * d;
      PairLanes p = row[j];
      for (Index k = 0; k < j; ++k) p -= row[k] * one[k];
      row[j] = p * one[j];
    }
    if (i == d) return;
    PairLanes square = row[i];
    for (Index k = 0; k < i; ++k) square -= row[k] * row[k];
    for (int lane = 0; lane < pair_lanes; ++lane) row[i][lane] = 1.0 / std::sqrt(square[lane]);
  }
}

// Fills D (P,) and log |C| (P,) of pairs (P, 2) from two sets of means (N, d) and covariances
// (N, d, d), with factors (P, 2) on the two covariances.
inline void whiten_pairs(const Table& means_a, const Tables& covariances_a, const Table& means_b,
                         const Tables& covariances_b, const Array<const Index, 2>& pairs,
                         const Table& scales, const Vector& squares,
                         const Vector& log_determinants) {
  const Index d = means_a.size(1), count = pairs.size();
  expect_shape("covariances_a", covariances_a, {means_a.size(), d, d});
  expect_shape("means_b", means_b, {-1, d});
  expect_shape("covariances_b", covariances_b, {means_b.size(), d, d});
  expect_shape("pairs", pairs, {-1, 2});
  for (Index p = 0; p < count; ++p) {
    expect(pairs(p, 0) >= 0 && pairs(p, 0) < means_a.size() && pairs(p, 1) >= 0 &&
               pairs(p, 1) < means_b.size(),
           "pairs", "places in the two sets");
  }
  expect_shape("scales", scales, {count, 2});
  expect_shape("squares", squares, {count});
  expect_shape("log_determinants", log_determinants, {count});
  Scratch<PairLanes, 2> factor(d + 1, d);
  for (Index first = 0; first < count; first += pair_lanes) {
    const Index last = std::min<Index>(first + pair_lanes, count) - 1;
    for (int lane = 0; lane < pair_lanes; ++lane) {
      const Index p = std::min(first + lane, last), i = pairs(p, 0), j = pairs(p, 1);
      const double s = scales(p, 0), t = scales(p, 1);
      for (Index a = 0; a < d; ++a) {
        const double *one = covariances_a[i][a].data, *two = covariances_b[j][a].data;
        PairLanes* row = factor[a].data;
        for (Index b = 0; b <= a; ++b) row[b][lane] = s * one[b] + t * two[b];
        factor(d, a)[lane] = means_a(i, a) - means_b(j, a);
      }
    }
    whiten(factor.view().data, d);
    for (Index p = first; p <= last; ++p) {
      double squared = 0.0, log_determinant = 0.0;
      for (Index a = 0; a < d; ++a) {
        squared += square(factor(d, a)[p - first]);
        log_determinant -= 2.0 * elementary::log(factor(a, a)[p - first]);
      }
      squares[p] = squared;
      log_determinants[p] = log_determinant;
    }
  }
}

}  // namespace hmt
