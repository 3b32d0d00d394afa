// Samples on the outline of a silhouette; see hmt_ros/image/terms/silhouette.py.
#pragma once

#include "../elementary.h"
#include "../terms/coverage.h"
#include "../wide.h"
#include "images.h"

namespace hmt {

// Belief in a sample of the outline if the person may continue beyond it; distance of this test,
// px.
inline constexpr double unsure_belief = 0.3, belief_distance = 4.0;
// Minimum length of a gradient that has a direction.
inline constexpr double least_gradient = 1e-3;

// Weights of the pixels around a point in the gradient of a mask blurred by a Gaussian, by column;
// by row they are transposed. They are integers, so that sums do not depend on the order.
struct GradientWeights {
  static constexpr double sigma = 2.0, scale = 0x1p24;
  static constexpr Index reach = 9, width = 2 * reach + 1;
  std::array<std::int32_t, width * width> by_column, by_row;

  GradientWeights() {
    std::array<double, width + 2> gaussian{};  // 0 at both ends
    double sum = 0.0;
    for (Index i = 0; i < width; ++i) {
      const double x = double(i - reach) / sigma;
      if (i > 0 && i < width - 1) gaussian[i + 1] = elementary::exp(-0.5 * x * x);
      sum += gaussian[i + 1];
    }
    const auto at = [&](Index i) { return gaussian[i + 1] / sum; };
    for (Index i = 0; i < width; ++i) {
      for (Index j = 0; j < width; ++j) {
        const double smooth = at(i - 1) + 2.0 * at(i) + at(i + 1), slope = at(j - 1) - at(j + 1);
        by_column[i * width + j] = by_row[j * width + i] =
            std::int32_t(std::lround(scale * smooth * slope));
      }
    }
  }
};

// The gradient of the blurred mask at a pixel; beyond its sides the mask is mirrored.
HMT_WIDE inline std::array<double, 2> mask_gradient(const Bytes& mask,
                                                    const GradientWeights& weights, Index row,
                                                    Index column) {
  constexpr Index reach = GradientWeights::reach, width = GradientWeights::width;
  const Index h = mask.size(), w = mask.size(1);
  const bool inside = column >= reach && column + reach < w;
  std::int32_t x = 0, y = 0;
  for (Index i = 0; i < width; ++i) {
    const std::uint8_t* line = mask.data + mirrored(row + i - reach, h) * w;
    const std::int32_t *own_x = weights.by_column.data() + i * width,
                       *own_y = weights.by_row.data() + i * width;
    for (Index j = 0; j < width; ++j) {
      const Index at = inside ? column + j - reach : mirrored(column + j - reach, w);
      const std::int32_t on = -std::int32_t(line[at] != 0);
      x += own_x[j] & on;
      y += own_y[j] & on;
    }
  }
  return {x / GradientWeights::scale, y / GradientWeights::scale};
}

// A pixel of a mask that is not empty; beyond its sides, the nearest pixel inside.
inline bool has_pixel(const Bytes& mask, double column, double row) {
  const auto at = [](double x, Index size) {
    return static_cast<Index>(between(std::nearbyint(x), 0.0, double(size - 1)));
  };
  return mask.size() > 0 && mask(at(row, mask.size()), at(column, mask.size(1)));
}

// Fills the rows of an outline with about `count` samples, evenly along all outlines of a mask (h,
// w); returns their number. An outline is a closed part of the pixels (P, 2), column and row, up to
// one of `ends`. Pixels are relative to (left, top). `unsure` and `others` have no rows if they are
// not used.
inline Index sample_outline(const Array<const std::int32_t, 2>& pixels, const Places& ends,
                            const Bytes& mask, const Bytes& unsure, const Bytes& others,
                            Index count, Index left, Index top, const Matrix& places,
                            const Matrix& normals, const Vector& beliefs) {
  const Index h = mask.size(), w = mask.size(1), most = places.size();
  expect_shape("pixels", pixels, {-1, 2});
  for (Index i = 0; i < pixels.size(); ++i) {
    const Index column = pixels(i, 0), row = pixels(i, 1);
    expect(0 <= row && row < h && 0 <= column && column < w, "pixels", "pixels of the mask");
  }
  for (Index c = 0; c < ends.size(); ++c) {
    expect((c ? ends[c - 1] : 0) < ends[c] && ends[c] <= pixels.size(), "ends", "rising rows");
  }
  if (unsure.size() > 0) expect_shape("unsure", unsure, {h, w});
  if (others.size() > 0) expect_shape("others", others, {h, w});
  expect_shape("places", places, {-1, 2});
  expect_shape("normals", normals, {most, 2});
  expect_shape("beliefs", beliefs, {most});
  static const GradientWeights weights;
  const Index all = ends.size() > 0 ? ends[ends.size() - 1] : 0;
  std::vector<double> along(all + ends.size());  // from the first pixel of each outline to the next
  const auto next = [&](Index i, Index first, Index end) { return i + 1 < end ? i + 1 : first; };
  double total = 0.0;
  for (Index c = 0; c < ends.size(); ++c) {
    const Index first = c ? ends[c - 1] : 0;
    double way = 0.0;
    for (Index i = first; i < ends[c]; ++i) {
      const Index then = next(i, first, ends[c]);
      const double x = pixels(then, 0) - pixels(i, 0), y = pixels(then, 1) - pixels(i, 1);
      way += std::sqrt(x * x + y * y);
      along[i + c + 1] = way;
    }
    total += way;
  }
  Index used = 0;
  for (Index c = 0; c < ends.size(); ++c) {
    const Index first = c ? ends[c - 1] : 0;
    const double* ways = along.data() + first + c;
    const double length = ways[ends[c] - first];
    const Index own = std::max<Index>(std::lrint(double(count) * length / total), 3);
    Index i = first;
    for (Index k = 0; k < own; ++k) {
      const double at = (double(k) + 0.5) / double(own) * length;
      while (i + 1 < ends[c] && ways[i + 1 - first] <= at) ++i;
      const Index then = next(i, first, ends[c]);
      const double step = ways[i + 1 - first] - ways[i - first];
      const double share = step > 0.0 ? (at - ways[i - first]) / step : 0.0;
      double place[2];
      for (int axis = 0; axis < 2; ++axis) {
        place[axis] = pixels(i, axis) + share * (pixels(then, axis) - pixels(i, axis));
      }
      const auto gradient =
          mask_gradient(mask, weights, std::lrint(place[1]), std::lrint(place[0]));
      const double size = std::sqrt(gradient[0] * gradient[0] + gradient[1] * gradient[1]);
      if (size <= least_gradient) continue;
      expect(used < most, "places", "room for all samples");
      // The outward direction is opposite to the gradient.
      const double x = -gradient[0] / size, y = -gradient[1] / size;
      const double column = place[0] + belief_distance * x, row = place[1] + belief_distance * y;
      beliefs[used] = has_pixel(others, column, row)   ? 0.0
                      : has_pixel(unsure, column, row) ? unsure_belief
                                                       : 1.0;
      // The outline lies half a pixel outside the last pixels of the silhouette.
      places(used, 0) = place[0] + 0.5 * x + double(left);
      places(used, 1) = place[1] + 0.5 * y + double(top);
      normals(used, 0) = x;
      normals(used, 1) = y;
      ++used;
    }
  }
  return used;
}

}  // namespace hmt
