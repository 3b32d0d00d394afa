// Points in the image of a camera with distortion; see hmt_ros/body/camera.py.
#pragma once

#include "arrays.h"
#include "elementary.h"

namespace hmt {

struct Lens {
  std::array<double, 2> focal;   // fx, fy, px
  std::array<double, 2> centre;  // cx, cy, px
  Index model;                   // -1: no distortion, 0: plumb_bob or rational, 1: equidistant
  std::array<double, 8> coefficients;
  double near;  // least depth of a point that has a pixel, m
};

// Where a lens bends the ray through (a, b, 1), and the derivatives of u and v by a and b.
struct Bent {
  double u, v, da, db, ea, eb;
};

inline constexpr auto unbent = [](const auto&, double a, double b) {
  return Bent{a, b, 1.0, 0.0, 0.0, 1.0};
};

inline constexpr auto bent_by_polynomials = [](const auto& k, double a, double b) {
  const double p1 = k[2], p2 = k[3];
  const double s = a * a + b * b;
  const double top = 1.0 + s * (k[0] + s * (k[1] + s * k[4]));
  const double bottom = 1.0 + s * (k[5] + s * (k[6] + s * k[7]));
  const double radial = top / bottom;
  const double slope = (k[0] + s * (2.0 * k[1] + s * 3.0 * k[4]) -
                        radial * (k[5] + s * (2.0 * k[6] + s * 3.0 * k[7]))) /
                       bottom;
  const double mixed = 2.0 * a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b;
  return Bent{a * radial + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a),
              b * radial + p1 * (s + 2.0 * b * b) + 2.0 * p2 * a * b,
              radial + 2.0 * a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a,
              mixed,
              mixed,
              radial + 2.0 * b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a};
};

inline constexpr auto bent_by_angle = [](const auto& k, double a, double b) {
  const double r = std::sqrt(a * a + b * b), theta = elementary::atan(r), t = theta * theta;
  const double bent = theta * (1.0 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))));
  const double d_bent =
      1.0 + t * (3.0 * k[0] + t * (5.0 * k[1] + t * (7.0 * k[2] + t * 9.0 * k[3])));
  const double scale = r > 1e-8 ? bent / r : 1.0;
  const double slope =
      r > 1e-4 ? (d_bent / (1.0 + r * r) - scale) / (r * r) : 2.0 * (k[0] - 1.0 / 3.0);
  return Bent{a * scale,     b * scale,     scale + a * a * slope,
              a * b * slope, a * b * slope, scale + b * b * slope};
};

// Sets the pixel (2,) and its derivative (2, 3) by the point (a z, b z, z) whose ray is bent.
inline void set_pixel(const Lens& lens, const Bent& bent, double a, double b, double z,
                      double* pixel, double* projection) {
  const double fx = lens.focal[0] / z, fy = lens.focal[1] / z;
  pixel[0] = lens.focal[0] * bent.u + lens.centre[0];
  pixel[1] = lens.focal[1] * bent.v + lens.centre[1];
  projection[0] = fx * bent.da;
  projection[1] = fx * bent.db;
  projection[2] = -fx * (bent.da * a + bent.db * b);
  projection[3] = fy * bent.ea;
  projection[4] = fy * bent.eb;
  projection[5] = -fy * (bent.ea * a + bent.eb * b);
}

// Pixel (2,) and its derivative (2, 3) by the point; false behind the camera.
inline bool project(const Lens& lens, double x, double y, double z, double* pixel,
                    double* projection) {
  if (!(z > lens.near)) return false;
  const double a = x / z, b = y / z;
  const Bent bent = lens.model < 0    ? unbent(lens.coefficients, a, b)
                    : lens.model == 0 ? bent_by_polynomials(lens.coefficients, a, b)
                                      : bent_by_angle(lens.coefficients, a, b);
  set_pixel(lens, bent, a, b, z, pixel, projection);
  return true;
}

}  // namespace hmt
