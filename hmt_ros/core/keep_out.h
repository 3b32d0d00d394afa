// Capsules inside of larger ones; see hmt_ros/body/keep_out.py.
#pragma once

#include "lanes.h"

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

// Marks which points, by coordinate (3, stride), are no more outside of a capsule; how many are.
HMT_WIDE inline Index leave_outside(const Axis& axis, double limit, const double* points,
                                    Index stride, double* outside) {
  double rest = 0.0;  // of numbers 0 and 1
#pragma omp simd reduction(+ : rest)
  for (Index p = 0; p < stride; ++p) {
    const double x = points[p] - axis.start[0], y = points[stride + p] - axis.start[1],
                 z = points[2 * stride + p] - axis.start[2];
    const double dots = x * axis.way[0] + y * axis.way[1] + z * axis.way[2];
    const double share = dots / axis.squared;
    const double low = share > 0.0 ? share : 0.0, along = low < 1.0 ? low : 1.0;
    const double dx = x - along * axis.way[0], dy = y - along * axis.way[1],
                 dz = z - along * axis.way[2];
    outside[p] = dx * dx + dy * dy + dz * dz > limit ? outside[p] : 0.0;
    rest += outside[p];
  }
  return Index(rest);
}

// Fills whether each of N capsules, largest first, has points (N, P, 3) outside of those before.
inline void find_not_held(const Table& starts, const Table& ends, const Numbers& radii,
                          const Tables& points, const Array<bool, 1>& kept) {
  const Index n = radii.size(), count = points.size(1);
  expect_shape("starts", starts, {n, 3});
  expect_shape("ends", ends, {n, 3});
  expect_shape("points", points, {n, count, 3});
  expect_shape("kept", kept, {n});
  kept.fill(false);
  const Index stride = in_whole_lanes(count);
  const Scratch<double, 2> outside(n, stride);
  const Scratch<double, 3> by_coordinate(n, 3, stride);
  const Scratch<Index, 1> left(n);
  left.fill(count);
  for (Index j = 0; j < n; ++j) {
    for (Index p = 0; p < count; ++p) {
      outside(j, p) = 1.0;
      for (int k = 0; k < 3; ++k) by_coordinate(j, k, p) = points(j, p, k);
    }
  }
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
    const double* middle = middles[i].data;
    for (Index j = i + 1; j < n; ++j) {
      if (left[j] == 0) continue;
      const double* other = middles[j].data;
      const double away[3] = {other[0] - middle[0], other[1] - middle[1], other[2] - middle[2]};
      if (dot(away, away) > square(sizes[i] + sizes[j])) continue;
      if (axis.distance_squared(other) > square(radii[i] + sizes[j])) continue;
      left[j] = leave_outside(axis, limit, by_coordinate[j].data, stride, outside[j].data);
    }
  }
}

}  // namespace hmt
