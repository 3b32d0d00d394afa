// Bilinear values and gradients of image maps; see hmt_ros/image/sampling.py.
#pragma once

#include "arrays.h"

namespace hmt {

// Values on a window of the pixel grid, of one or several channels.
struct ImageMap {
  Array<const float, 3> values;  // (C, h, w)
  Index left, top;               // the window's first pixel in the whole image

  void check() const {
    expect(values.size(1) >= 2 && values.size(2) >= 2, "values", "two rows and columns at least");
  }
};

// A value of a map, and its derivatives by column and row.
struct Sample {
  double value, slope_u, slope_v;
};

// A coordinate that is no number counts as 0, so that it reads inside the map.
inline Index pixel_before(double x) { return x > 0.0 ? static_cast<Index>(x) : 0; }

// At a pixel of the whole image. Outside the window the nearest value is continued.
inline Sample sample(const ImageMap& map, Index channel, double u, double v) {
  const Index h = map.values.size(1), w = map.values.size(2);
  const double x = u - double(map.left), y = v - double(map.top);
  const double cx = between(x, 0.0, double(w) - 1.001), cy = between(y, 0.0, double(h) - 1.001);
  const Index i = pixel_before(cy), j = pixel_before(cx);
  const double dv = cy - double(i), du = cx - double(j);
  const float* row = map.values.data + (channel * h + i) * w + j;
  const float a = row[0], b = row[1], p = row[w], q = row[w + 1];
  const double upper = a + (b - a) * du;
  const double lower = p + (q - p) * du;
  Sample result{upper + (lower - upper) * dv, (b - a) * (1.0 - dv) + (q - p) * dv, lower - upper};
  if (x < 0.0 || x > double(w) - 1.0) result.slope_u = 0.0;
  if (y < 0.0 || y > double(h) - 1.0) result.slope_v = 0.0;
  return result;
}

// `sample` of a map of distances, continued outside its window by the way to the window.
inline Sample sample_distance(const ImageMap& map, Index channel, double u, double v) {
  Sample result = sample(map, channel, u, v);
  const double h = double(map.values.size(1)), w = double(map.values.size(2));
  const double x = u - double(map.left), y = v - double(map.top);
  if (x < 0.0) {
    result.value -= x;
    result.slope_u = -1.0;
  } else if (x > w - 1.0) {
    result.value += x - w + 1.0;
    result.slope_u = 1.0;
  }
  if (y < 0.0) {
    result.value -= y;
    result.slope_v = -1.0;
  } else if (y > h - 1.0) {
    result.value += y - h + 1.0;
    result.slope_v = 1.0;
  }
  return result;
}

}  // namespace hmt
