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
  double near;  // minimum depth of a point that has a pixel, m
};

// Distorted coordinates of the ray through (a, b, 1), and derivatives of u and v by a and b.
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

inline Bent bent_by(const Lens& lens, double a, double b) {
  return lens.model < 0    ? unbent(lens.coefficients, a, b)
         : lens.model == 0 ? bent_by_polynomials(lens.coefficients, a, b)
                           : bent_by_angle(lens.coefficients, a, b);
}

// Sets the pixel (2,), and its derivative (2, 3) by the point (a z, b z, z), of a distorted ray.
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
  set_pixel(lens, bent_by(lens, a, b), a, b, z, pixel, projection);
  return true;
}

// Pixels (N, 2) of points (N, 3); NaN behind the camera.
inline void find_pixels(const Lens& lens, const Table& points, const Matrix& pixels) {
  expect_shape("points", points, {pixels.size(), 3});
  expect_shape("pixels", pixels, {-1, 2});
  double projection[6];
  for (Index i = 0; i < points.size(); ++i) {
    const double* p = points[i].data;
    if (!project(lens, p[0], p[1], p[2], pixels[i].data, projection)) pixels[i].fill(nan);
  }
}

// Error of a ray at which the inversion of a distortion ends; maximum tangent of the ray.
inline constexpr double close_ray = 1e-14, steepest_ray = 1e3;

// Unit rays (N, 3) through pixels (N, 2). Newton's method inverts the distortion; if no ray has the
// pixel, the result is the ray after the last iteration.
inline void find_rays(const Lens& lens, const Table& pixels, const Matrix& rays) {
  expect_shape("pixels", pixels, {rays.size(), 2});
  expect_shape("rays", rays, {-1, 3});
  for (Index i = 0; i < rays.size(); ++i) {
    const double u = (pixels(i, 0) - lens.centre[0]) / lens.focal[0];
    const double v = (pixels(i, 1) - lens.centre[1]) / lens.focal[1];
    double a = u, b = v;
    for (int k = 0; k < 20 && lens.model >= 0; ++k) {
      const Bent bent = bent_by(lens, a, b);
      const double x = bent.u - u, y = bent.v - v;
      if (std::abs(x) < close_ray && std::abs(y) < close_ray) break;
      double det = bent.da * bent.eb - bent.db * bent.ea;
      if (!(std::abs(det) > 1e-9)) det = 1.0;
      // Keep the iterations bounded if there is no such ray.
      a = between(a - (bent.eb * x - bent.db * y) / det, -steepest_ray, steepest_ray);
      b = between(b - (bent.da * y - bent.ea * x) / det, -steepest_ray, steepest_ray);
    }
    const double length = std::sqrt(a * a + b * b + 1.0);
    rays(i, 0) = a / length;
    rays(i, 1) = b / length;
    rays(i, 2) = 1.0 / length;
  }
}

}  // namespace hmt
