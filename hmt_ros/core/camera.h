// Points in the image of a camera with distortion; see hmt_ros/body/camera.py.
#pragma once

#include "arrays.h"

namespace hmt {

struct Lens {
  std::array<double, 2> focal;   // fx, fy, px
  std::array<double, 2> centre;  // cx, cy, px
  Index model;                   // -1: no distortion, 0: plumb_bob or rational, 1: equidistant
  std::array<double, 8> coefficients;
  double near;  // least depth of a point that has a pixel, m
};

// Pixel (2,) and its derivative (2, 3) by the point; false behind the camera.
inline bool project(const Lens& lens, double x, double y, double z, double* pixel,
                    double* projection) {
  if (!(z > lens.near)) return false;
  const double a = x / z, b = y / z;
  const auto& k = lens.coefficients;
  double u = a, v = b, da = 1.0, db = 0.0, ea = 0.0, eb = 1.0;
  if (lens.model == 0) {
    const double p1 = k[2], p2 = k[3];
    const double s = a * a + b * b;
    const double top = 1.0 + s * (k[0] + s * (k[1] + s * k[4]));
    const double bottom = 1.0 + s * (k[5] + s * (k[6] + s * k[7]));
    const double radial = top / bottom;
    const double slope = (k[0] + s * (2.0 * k[1] + s * 3.0 * k[4]) -
                          radial * (k[5] + s * (2.0 * k[6] + s * 3.0 * k[7]))) /
                         bottom;
    u = a * radial + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a);
    v = b * radial + p1 * (s + 2.0 * b * b) + 2.0 * p2 * a * b;
    da = radial + 2.0 * a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a;
    db = 2.0 * a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b;
    ea = db;
    eb = radial + 2.0 * b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a;
  } else if (lens.model > 0) {
    const double r = std::sqrt(a * a + b * b), theta = std::atan(r), t = theta * theta;
    const double bent = theta * (1.0 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))));
    const double d_bent =
        1.0 + t * (3.0 * k[0] + t * (5.0 * k[1] + t * (7.0 * k[2] + t * 9.0 * k[3])));
    const double scale = r > 1e-8 ? bent / r : 1.0;
    const double slope =
        r > 1e-4 ? (d_bent / (1.0 + r * r) - scale) / (r * r) : 2.0 * (k[0] - 1.0 / 3.0);
    u = a * scale;
    v = b * scale;
    da = scale + a * a * slope;
    db = a * b * slope;
    ea = db;
    eb = scale + b * b * slope;
  }
  const double fx = lens.focal[0] / z, fy = lens.focal[1] / z;
  pixel[0] = lens.focal[0] * u + lens.centre[0];
  pixel[1] = lens.focal[1] * v + lens.centre[1];
  projection[0] = fx * da;
  projection[1] = fx * db;
  projection[2] = -fx * (da * a + db * b);
  projection[3] = fy * ea;
  projection[4] = fy * eb;
  projection[5] = -fy * (ea * a + eb * b);
  return true;
}

}  // namespace hmt
