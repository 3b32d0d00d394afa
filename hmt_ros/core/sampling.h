// Bilinear values and gradients of image maps; see hmt_ros/image/sampling.py.
#pragma once

#include "arrays.h"

namespace hmt {

// Values on a window of the pixel grid, of one or several channels.
struct ImageMap {
  Array<const float, 3> values;  // (C, h, w)
  Index left, top;               // first pixel of the window in the whole image

  void check() const {
    expect(values.size(1) >= 2 && values.size(2) >= 2, "values", "two rows and columns at least");
  }
};

// A value of a map, and its derivatives by column and row.
struct Sample {
  double value, slope_u, slope_v;
};

// A coordinate of NaN counts as 0, so that it reads inside the map.
inline Index pixel_before(double x) { return x > 0.0 ? static_cast<Index>(x) : 0; }

// Clamps a coordinate to a window of `extent` pixels, with a pixel after it.
inline double inside(double x, Index extent) { return between(x, 0.0, double(extent) - 1.001); }

// The values of four pixels around a place: a, b above, p, q below.
struct Cell {
  double a, b, p, q;
};

inline Sample bilinear(const Cell& cell, double du, double dv) {
  const auto [a, b, p, q] = cell;
  const double upper = a + (b - a) * du;
  const double lower = p + (q - p) * du;
  return {upper + (lower - upper) * dv, (b - a) * (1.0 - dv) + (q - p) * dv, lower - upper};
}

// Samples a map at a pixel of the whole image; outside the window, at the nearest place inside.
inline Sample sample(const ImageMap& map, Index channel, double u, double v) {
  const Index h = map.values.size(1), w = map.values.size(2);
  const double x = u - double(map.left), y = v - double(map.top);
  const double cx = inside(x, w), cy = inside(y, h);
  const Index i = pixel_before(cy), j = pixel_before(cx);
  const float* row = map.values.data + (channel * h + i) * w + j;
  Sample result = bilinear({row[0], row[1], row[w], row[w + 1]}, cx - double(j), cy - double(i));
  if (x < 0.0 || x > double(w) - 1.0) result.slope_u = 0.0;
  if (y < 0.0 || y > double(h) - 1.0) result.slope_v = 0.0;
  return result;
}

// Distance of a coordinate beyond the last of `extent` pixels or, negative, before the first.
inline double outside(double x, double extent) {
  return x < 0.0 ? x : x > extent - 1.0 ? x - extent + 1.0 : 0.0;
}

// The interpolated value of a map of distances at a pixel of the whole image. Outside the window,
// the distance to the window is added.
inline Sample distance_between(const Cell& cell, const ImageMap& map, double u, double v) {
  const Index h = map.values.size(1), w = map.values.size(2);
  const double x = u - double(map.left), y = v - double(map.top);
  const double cx = inside(x, w), cy = inside(y, h);
  const Sample found = bilinear(cell, cx - double(static_cast<std::int32_t>(cx)),
                                cy - double(static_cast<std::int32_t>(cy)));
  const double beside = outside(x, double(w)), above = outside(y, double(h));
  return {found.value + std::abs(beside) + std::abs(above),
          beside < 0.0   ? -1.0
          : beside > 0.0 ? 1.0
                         : found.slope_u,
          above < 0.0   ? -1.0
          : above > 0.0 ? 1.0
                        : found.slope_v};
}

}  // namespace hmt
