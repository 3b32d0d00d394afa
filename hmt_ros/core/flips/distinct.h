// Poses that differ from every earlier one; see hmt_ros/flips/interpretation_tree.py.
#pragma once

#include "../arrays.h"

namespace hmt {

// Fills kept (N,) with the indices of at most `limit` distinct poses (N, 3 J), and owner (N,) with
// the place in `kept` of the pose that represents each pose; -1: none. Returns the number of kept
// poses. The distance of two poses is the largest distance between their joints.
inline Index keep_distinct(const Table& points, double apart, Index limit,
                           const Array<Index, 1>& kept, const Array<Index, 1>& owner) {
  const Index n = points.size(), width = points.size(1);
  expect(width % 3 == 0, "points", "coordinates of joints, three each");
  expect_shape("kept", kept, {n});
  expect_shape("owner", owner, {n});
  Index count = 0;
  for (Index i = 0; i < n; ++i) {
    const double* own = points[i].data;
    double nearest = apart * apart;
    owner[i] = -1;
    for (Index place = 0; place < count; ++place) {
      const double* other = points[kept[place]].data;
      double gap = 0.0;
      for (Index j = 0; j < width; j += 3) {
        const double x = other[j] - own[j];
        const double y = other[j + 1] - own[j + 1];
        const double z = other[j + 2] - own[j + 2];
        gap = most(gap, x * x + y * y + z * z);
        if (gap >= nearest) break;
      }
      if (gap < nearest) {
        owner[i] = place;
        nearest = gap;
      }
    }
    if (owner[i] < 0 && count < limit) {
      kept[count] = i;
      owner[i] = count++;
    }
  }
  return count;
}

}  // namespace hmt
