// Capsules inside of larger ones; see hmt_ros/body/keep_out.py.
#pragma once

#include "arrays.h"

namespace hmt {

// The axis of a capsule, a segment of a line.
struct Axis {
  double start[3], way[3];  // way: from start to end
  double squared;

  Axis(const double* from, const double* to)
      : start{from[0], from[1], from[2]},
        way{to[0] - from[0], to[1] - from[1], to[2] - from[2]},
        squared(most(dot(way, way), 1e-18)) {}

  // Squared distance of a point.
  double distance_squared(const double* p) const {
    double away[3] = {p[0] - start[0], p[1] - start[1], p[2] - start[2]};
    const double along = between(dot(away, way) / squared, 0.0, 1.0);
    for (int k = 0; k < 3; ++k) away[k] -= along * way[k];
    return dot(away, away);
  }
};

// Fills whether each of N capsules, largest first, has points (N, P, 3) outside of those before.
inline void find_not_held(const Table& starts, const Table& ends, const Numbers& radii,
                          const Tables& points, const Array<bool, 1>& kept) {
  const Index n = radii.size(), count = points.size(1);
  expect_shape("starts", starts, {n, 3});
  expect_shape("ends", ends, {n, 3});
  expect_shape("points", points, {n, count, 3});
  expect_shape("kept", kept, {n});
  kept.fill(false);
  const Scratch<bool, 2> outside(n, count);
  const Scratch<Index, 1> left(n);
  outside.fill(true);
  left.fill(count);
  // A ball around each: most pairs are far apart.
  const Scratch<double, 2> middles(n, 3);
  const Scratch<double, 1> sizes(n);
  for (Index j = 0; j < n; ++j) {
    double half = 0.0;
    for (int k = 0; k < 3; ++k) {
      middles(j, k) = 0.5 * (starts(j, k) + ends(j, k));
      half += square(0.5 * (ends(j, k) - starts(j, k)));
    }
    sizes[j] = std::sqrt(half) + radii[j];
  }
  for (Index i = 0; i < n; ++i) {
    if (left[i] == 0) continue;
    kept[i] = true;
    const Axis axis(starts[i].data, ends[i].data);
    const double limit = radii[i] * radii[i];
    for (Index j = i + 1; j < n; ++j) {
      if (left[j] == 0) continue;
      if (axis.distance_squared(middles[j].data) > square(radii[i] + sizes[j])) continue;
      const double* point = points[j].data;
      bool* own = outside[j].data;
      Index rest = left[j];
      for (Index p = 0; p < count; ++p) {
        if (own[p] && axis.distance_squared(point + 3 * p) <= limit) {
          own[p] = false;
          --rest;
        }
      }
      left[j] = rest;
    }
  }
}

}  // namespace hmt
