// Distances to the nearest edges of some orientations; see hmt_ros/image/terms/edges.py.
//
// They are chamfer distances of a 3 x 3 mask [Borgefors, CVGIP 1986], as in
// `cv2.distanceTransform`, for all orientations at once.
#pragma once

#include "../terms/edges.h"
#include "../wide.h"
#include "images.h"

namespace hmt {

// Lengths of straight and diagonal steps, and maximum length of a path, in units of 2^-16 px.
inline constexpr std::int32_t beside_step = 62587, across_step = 89738, longest_way = 1 << 29;
inline constexpr float per_pixel = 1.0f / 65536.0f;
// Distance if there is no edge of an orientation, px.
inline constexpr float no_edge = 1000.0f;
// Edges within three quarters of a bin of a direction have its orientation: tan(3 pi / 16).
inline constexpr double widest_bin = 0.6681786379192989;

// The length of a path for each orientation.
using PixelLanes [[gnu::vector_size(orientations * sizeof(std::int32_t))]] = std::int32_t;
using Pixels [[gnu::vector_size(orientations * sizeof(float))]] = float;

HMT_INLINE PixelLanes shorter(PixelLanes a, PixelLanes b) { return a < b ? a : b; }

// 0 for each orientation of an edge with the normal (x, y), the maximum length for others.
inline PixelLanes ways_of(int x, int y) {
  const auto way = [](int along, int aside) {
    return std::abs(aside) <= widest_bin * std::abs(along) ? 0 : longest_way;
  };
  return PixelLanes{way(x, y), way(x + y, y - x), way(y, x), way(y - x, x + y)};
}

// Lengths of paths (h, w) from edges, from initial `ways` at the edges; with a border of a pixel.
HMT_WIDE inline void spread(PixelLanes* ways, Index h, Index w) {
  const Index stride = w + 2;
  const PixelLanes beside = PixelLanes{} + beside_step, across = PixelLanes{} + across_step;
  PixelLanes* pixel = ways + stride + 1;
  for (Index i = 0; i < h; ++i, pixel += 2) {
    PixelLanes last = pixel[-1];
    for (Index j = 0; j < w; ++j, ++pixel) {
      const PixelLanes* above = pixel - stride;
      PixelLanes way = shorter(*pixel, above[0] + beside);
      way = shorter(way, shorter(above[-1], above[1]) + across);
      *pixel = last = shorter(way, last + beside);
    }
  }
  for (Index i = 0; i < h; ++i) {
    pixel -= 2;
    PixelLanes last = *pixel;
    for (Index j = 0; j < w; ++j) {
      const PixelLanes* below = --pixel + stride;
      PixelLanes way = shorter(*pixel, below[0] + beside);
      way = shorter(way, shorter(below[-1], below[1]) + across);
      *pixel = last = shorter(way, last + beside);
    }
  }
}

// distances (C, h, w), px, to the nearest edge (h, w) of each orientation, by its normal (dx, dy).
// Only edges marked `near` and not `hidden` by another person are used; a mask without rows is not
// applied.
inline void edge_distances(const Bytes& edges, const Derivative& dx, const Derivative& dy,
                           const Bytes& near, const Bytes& others, double hidden,
                           const Array<float, 3>& distances) {
  const Index h = edges.size(), w = edges.size(1), pixels = h * w, stride = w + 2;
  expect_shape("dx", dx, {h, w});
  expect_shape("dy", dy, {h, w});
  if (near.size() > 0) expect_shape("near", near, {h, w});
  if (others.size() > 0) expect_shape("others", others, {h, w});
  expect_shape("distances", distances, {orientations, h, w});
  const PixelLanes far = PixelLanes{} + longest_way;
  std::vector<PixelLanes> ways((h + 2) * stride, far);
  PixelLanes seen = far;
  for (Index i = 0; i < h; ++i) {
    for (Index j = 0; j < w; ++j) {
      const Index at = i * w + j;
      if (!edges.data[at] || (near.size() > 0 && !near.data[at])) continue;
      if (others.size() > 0 && others.data[at]) continue;
      const PixelLanes own = ways_of(dx.data[at], dy.data[at]);
      ways[(i + 1) * stride + 1 + j] = own;
      seen = shorter(seen, own);
    }
  }
  spread(ways.data(), h, w);
  for (Index i = 0; i < h; ++i) {
    const PixelLanes* from = ways.data() + (i + 1) * stride + 1;
    float* result = distances.data + i * w;
    for (Index j = 0; j < w; ++j) {
      const Pixels found = __builtin_convertvector(from[j], Pixels) * per_pixel;
      for (Index k = 0; k < orientations; ++k) result[k * pixels + j] = found[k];
    }
  }
  for (Index k = 0; k < orientations; ++k) {
    if (seen[k]) distances[k].fill(no_edge);
    for (Index at = 0; at < others.count(); ++at) {
      if (others.data[at]) distances.data[k * pixels + at] = float(hidden);
    }
  }
}

}  // namespace hmt
