// Cross-sections and meshes of the flesh; see hmt_ros/body/flesh.py, also for the equations.
#pragma once

#include "elementary.h"

namespace hmt {

// Parts (P,): centres, radii (P, 3), and exponents, tapers and bends (P, 2).
struct Superquadrics {
  Table centres, radii, exponents, tapers, bends;

  Index count() const { return centres.size(); }
  void check() const {
    expect_shape("centres", centres, {-1, 3});
    expect_shape("radii", radii, {count(), 3});
    expect_shape("exponents", exponents, {count(), 2});
    expect_shape("tapers", tapers, {count(), 2});
    expect_shape("bends", bends, {count(), 2});
  }
};

struct Section {
  double centre[3], radius[2], slope[2], lean[2];
};

// The cross-section of a part at height s in (-1, 1).
inline Section section_of(const Superquadrics& parts, Index part, double s) {
  const double *centre = parts.centres[part].data, *radii = parts.radii[part].data;
  const double power = 2.0 / parts.exponents(part, 0), size = std::abs(s);
  const double inside = 1.0 - elementary::pow(size, power);
  const double profile = elementary::pow(inside, 1.0 / power);
  const double steep = -sign(s) * elementary::pow(size, power - 1.0) / inside;
  Section result;
  for (int k = 0; k < 2; ++k) {
    const double taper = parts.tapers(part, k), bend = parts.bends(part, k);
    const double widening = 1.0 + taper * s;
    result.centre[k] = centre[k] + bend * (1.0 - s * s);
    result.radius[k] = radii[k] * profile * widening;
    result.slope[k] = -(steep + taper / widening) / radii[2];
    result.lean[k] = 2.0 * bend * s / radii[2];
  }
  result.centre[2] = centre[2] - radii[2] * s;
  return result;
}

// Fills rings (R,) at heights of parts: centres (R, 3), radii, slopes and leans (R, 2).
inline void fill_rings(const Superquadrics& parts, const Places& ring_parts, const Numbers& heights,
                       const Matrix& centre, const Matrix& radius, const Matrix& slope,
                       const Matrix& lean) {
  const Index rings = ring_parts.size();
  expect_range("ring_parts", ring_parts, 0, parts.count());
  expect_shape("heights", heights, {rings});
  expect_shape("centre", centre, {rings, 3});
  expect_shape("radius", radius, {rings, 2});
  expect_shape("slope", slope, {rings, 2});
  expect_shape("lean", lean, {rings, 2});
  for (Index r = 0; r < rings; ++r) {
    const Section section = section_of(parts, ring_parts[r], heights[r]);
    std::copy_n(section.centre, 3, centre[r].data);
    std::copy_n(section.radius, 2, radius[r].data);
    std::copy_n(section.slope, 2, slope[r].data);
    std::copy_n(section.lean, 2, lean[r].data);
  }
}

// Fills points and outward unit normals (P, G + 2, 3) of each part: at G heights and angles, given
// by cosines and sines, and at the two tips. Powers are computed once for consecutive equal heights
// and for repeated angles.
inline void fill_surface(const Superquadrics& parts, const Numbers& heights, const Numbers& cosines,
                         const Numbers& sines, const Tensor& points, const Tensor& normals) {
  const Index count = heights.size();
  expect_shape("cosines", cosines, {count});
  expect_shape("sines", sines, {count});
  expect_shape("points", points, {parts.count(), count + 2, 3});
  expect_shape("normals", normals, {parts.count(), count + 2, 3});
  const Index round =
      std::find_if(heights.begin(), heights.end(), [&](double s) { return s != heights[0]; }) -
      heights.begin();
  const Scratch<double, 2> powers(count, 4);
  for (Index p = 0; p < parts.count(); ++p) {
    const double exponent = parts.exponents(p, 1);
    Section section{};
    const auto raised = [](double x, double power) {
      return sign(x) * elementary::pow(std::abs(x), power);
    };
    for (Index g = 0; g < count; ++g) {
      if (g == 0 || heights[g] != heights[g - 1]) section = section_of(parts, p, heights[g]);
      const double around[2] = {cosines[g], sines[g]};
      const Index before = std::max(g - round, Index(0));
      const bool known = g >= round && cosines[before] == around[0] && sines[before] == around[1];
      double* power = powers[g].data;
      for (int k = 0; k < 2; ++k) {
        power[k] = known ? powers(before, k) : raised(around[k], exponent);
        power[2 + k] = known ? powers(before, 2 + k) : raised(around[k], 2.0 - exponent);
      }
      double *point = points[p][g].data, *normal = normals[p][g].data, along[2];
      for (int k = 0; k < 2; ++k) {
        point[k] = section.centre[k] + section.radius[k] * power[k];
        normal[k] = power[2 + k] / section.radius[k];
        along[k] = section.slope[k] * around[k] * around[k] + normal[k] * section.lean[k];
      }
      point[2] = section.centre[2];
      normal[2] = -(along[0] + along[1]);
      const double length = std::sqrt(dot(normal, normal));
      for (int k = 0; k < 3; ++k) normal[k] /= length;
    }
    for (Index tip = 0; tip < 2; ++tip) {
      const double up = tip == 0 ? 1.0 : -1.0;
      for (int k = 0; k < 3; ++k) {
        normals(p, count + tip, k) = k == 2 ? up : 0.0;
        points(p, count + tip, k) = parts.centres(p, k) + (k == 2 ? parts.radii(p, 2) * up : 0.0);
      }
    }
  }
}

}  // namespace hmt
