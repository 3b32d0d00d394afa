// Capsules inside larger ones; see hmt_ros/body/keep_out.py.
#pragma once

#include "small_matrix.h"

namespace hmt {

// The axis of a capsule, a line segment.
struct Axis {
  double start[3], way[3];  // way: from start to end
  double squared;

  Axis(const double* from, const double* to)
      : start{from[0], from[1], from[2]},
        way{to[0] - from[0], to[1] - from[1], to[2] - from[2]},
        squared(most(dot(way, way), 1e-18)) {}
};

// Squared distances of a group of points from an axis; coordinates are a stride apart.
HMT_INLINE void square_distances(const Axis& axis, const double* points, Index stride,
                                 Group<double>& squares) {
  const auto at = [&](int k) {
    return reinterpret_cast<const Group<double>*>(points + k * stride);
  };
  const Group<double> x = *at(0) - axis.start[0], y = *at(1) - axis.start[1],
                      z = *at(2) - axis.start[2], zero{};
  const Group<double> dots = x * axis.way[0] + y * axis.way[1] + z * axis.way[2];
  const Group<double> share = dots / axis.squared, low = share > zero ? share : zero;
  const Group<double> one = zero + 1.0, along = low < one ? low : one;
  const Group<double> dx = x - along * axis.way[0], dy = y - along * axis.way[1],
                      dz = z - along * axis.way[2];
  squares = dx * dx + dy * dy + dz * dz;
}

// Marks points inside a capsule by 0, in whole groups; returns whether a point is still outside.
HMT_WIDE inline bool leave_outside(Axis axis, double radius, const double* points, Index stride,
                                   double* outside) {
  const Group<double> zero{}, limit = zero + radius * radius;
  Group<double> rest{}, squares;
  for (Index p = 0; p < stride; p += group_size) {
    Group<double>& own = matrices::group(outside + p);
    square_distances(axis, points + p, stride, squares);
    own = squares > limit ? own : zero;
    rest += own;
  }
  return rest[0] + rest[1] + rest[2] + rest[3] > 0.0;
}

// Lists the balls from `first` on that touch a capsule; balls with a size of NaN do not. Centres
// come in whole groups. Returns the number of listed balls.
HMT_WIDE inline Index find_touched(Axis axis, double radius, const Matrix& middles,
                                   const double* sizes, Index first, Index* touched) {
  Index count = 0;
  Group<double> squares;
  for (Index j = first / group_size * group_size; j < middles.size(1); j += group_size) {
    const Group<double> reach = *reinterpret_cast<const Group<double>*>(sizes + j) + radius;
    square_distances(axis, middles.data + j, middles.size(1), squares);
    const auto near = squares <= reach * reach;
    if (!(near[0] | near[1] | near[2] | near[3])) continue;
    for (Index k = std::max(first - j, Index(0)); k < group_size; ++k) {
      if (near[k]) touched[count++] = j + k;
    }
  }
  return count;
}

inline Index in_whole_groups(Index count) {
  return (count + group_size - 1) / group_size * group_size;
}

// Points (3, stride) on the surface of a capsule: around three places of the axis, by a ring (2, A)
// of cosines and sines, and at both tips.
inline void fill_around(const Axis& axis, const double* end, double radius, const Table& ring,
                        double* points, Index stride) {
  const double length = std::sqrt(dot(axis.way, axis.way));
  double along[3] = {0.0, 0.0, 1.0}, side[3] = {}, unit[3] = {};
  for (int k = 0; length > 1e-9 && k < 3; ++k) along[k] = axis.way[k] / length;
  int least_along = 0;
  for (int k = 1; k < 3; ++k) {
    if (std::abs(along[k]) < std::abs(along[least_along])) least_along = k;
  }
  unit[least_along] = 1.0;
  const auto across = cross(along, unit);
  const double norm = std::sqrt(dot(across.data(), across.data()));
  for (int k = 0; k < 3; ++k) side[k] = across[k] / norm;
  const auto other = cross(along, side);
  const Index angles = ring.size(1);
  for (int k = 0; k < 3; ++k) {
    double* point = points + k * stride;
    for (double share : {0.0, 0.5, 1.0}) {
      const double place = axis.start[k] + share * axis.way[k];
      for (Index a = 0; a < angles; ++a) {
        *point++ = place + (ring(0, a) * side[k] + ring(1, a) * other[k]) * radius;
      }
    }
    *point++ = axis.start[k] - radius * along[k];
    *point++ = end[k] + radius * along[k];
  }
}

// Fills whether each of N capsules, largest first, has surface points outside all previous
// capsules. Surface points are given by a ring (2, A) of cosines and sines around the axis.
inline void find_not_held(const Table& starts, const Table& ends, const Numbers& radii,
                          const Table& ring, const Array<bool, 1>& kept) {
  const Index n = radii.size(), count = 3 * ring.size(1) + 2;
  expect_shape("starts", starts, {n, 3});
  expect_shape("ends", ends, {n, 3});
  expect_shape("ring", ring, {2, -1});
  expect_shape("kept", kept, {n});
  kept.fill(false);
  const Index stride = in_whole_groups(count), whole = in_whole_groups(n);
  const Scratch<double, 2> outside(n, stride), points(n, 3 * stride);
  // Compare enclosing balls first, because most pairs are far apart.
  const Scratch<double, 2> middles(3, whole);
  const Scratch<double, 1> sizes(whole);
  const Scratch<Index, 1> touched(whole);
  const Scratch<bool, 1> held(n);
  sizes.fill(nan);
  for (Index j = 0; j < n; ++j) {
    std::fill_n(outside[j].data, count, 1.0);
    const Axis axis(starts[j].data, ends[j].data);
    fill_around(axis, ends[j].data, radii[j], ring, points[j].data, stride);
    double half = 0.0;
    for (int k = 0; k < 3; ++k) {
      middles(k, j) = 0.5 * (starts(j, k) + ends(j, k));
      half += square(0.5 * (ends(j, k) - starts(j, k)));
    }
    sizes[j] = std::sqrt(half) + radii[j];
  }
  for (Index i = 0; i < n; ++i) {
    if (held[i]) continue;
    kept[i] = true;
    const Axis axis(starts[i].data, ends[i].data);
    const Index near =
        find_touched(axis, radii[i], middles, sizes.view().data, i + 1, touched.view().data);
    for (Index k = 0; k < near; ++k) {
      const Index j = touched[k];
      if (leave_outside(axis, radii[i], points[j].data, stride, outside[j].data)) continue;
      held[j] = true;
      sizes[j] = nan;
    }
  }
}

}  // namespace hmt
