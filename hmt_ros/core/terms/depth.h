// Visible points of the surface lie where a depth image sees one; see hmt_ros/image/terms/depth.py.
//
//     E(x) = w / V sum_i f_s(i) rho((D(u_i(x)) - z_i(x)) / sigma_i)
//     sigma_i^2 = sigma^2 + (growth D^2)^2 + (noise_i / cos a_i)^2
//
// over the V visible points i of the flesh: on every ring, two points to either side of the place
// that faces the camera. D is the depth image, z_i the depth of the point, a_i the angle between
// its normal and its ray, f_s the factor of segment s.
#pragma once

#include "../elementary.h"
#include "../pose_view.h"
#include "../sampling.h"

namespace hmt {

// Angle around a ring between the place that faces the camera and a point, rad.
inline constexpr double aside = pi / 4.0;
inline const double aside_cosine = elementary::cos(aside), aside_sine = elementary::sin(aside);
// Minimum cosine between the normal and the ray of a point that is compared.
inline constexpr double least_cosine = 0.3;
// Relative difference above which neighbouring depths belong to two surfaces.
inline constexpr double depth_jump = 0.03;

struct DepthInputs {
  Weighting term;
  ImageMap depths;  // m, 0 if not measured

  void check() const {
    if (term.weight > 0.0) expect(depths.values.size() > 0, "depths.values", "a channel");
  }
};

// Depth at a pixel and its derivatives; 0 if not measured. Four depths of one surface are
// interpolated bilinearly; otherwise the nearest pixel is used.
inline Sample sample_depth(const ImageMap& map, double u, double v) {
  const Index h = map.values.size(1), w = map.values.size(2);
  const double x = u - double(map.left), y = v - double(map.top);
  if (!(0.0 <= x && x <= double(w) - 1.0 && 0.0 <= y && y <= double(h) - 1.0)) return {0, 0, 0};
  const Index i = std::min(Index(y), h - 2), j = std::min(Index(x), w - 2);
  const double dv = y - double(i), du = x - double(j);
  const float* row = map.values.data + i * w + j;
  const double a = row[0], b = row[1], p = row[w], q = row[w + 1];
  const double nearest = least(least(a, b), least(p, q));
  const double furthest = most(most(a, b), most(p, q));
  if (nearest <= 0.0 || furthest - nearest > depth_jump * nearest) {
    const bool upper = dv < 0.5, left = du < 0.5;
    return {upper ? (left ? a : b) : (left ? p : q), 0.0, 0.0};
  }
  const double upper = a + (b - a) * du;
  const double lower = p + (q - p) * du;
  return {upper + (lower - upper) * dv, (b - a) * (1.0 - dv) + (q - p) * dv, lower - upper};
}

// Sets the points that face the camera, two on each ring, of the pose in a view; their noise
// becomes the noise along the ray.
inline void trace_front(const PoseView& view, const Contour& front) {
  const Index n = view.rings.count();
  const double c = aside_cosine, s = aside_sine;
#pragma omp simd
  for (Index i = 0; i < n; ++i) {
    const Turned turned = turned_ring(view.rings, view.frames_of_rings, i);
    const double size = most(std::sqrt(turned.x * turned.x + turned.y * turned.y), 1e-12);
    const double fx = -turned.x / size, fy = -turned.y / size;
    front.cosine[i] = fx * c + fy * s;
    front.sine[i] = fy * c - fx * s;
    front.cosine[n + i] = fx * c - fy * s;
    front.sine[n + i] = fy * c + fx * s;
    front.valid[i] = front.valid[n + i] = view.rings.traced()[i];
  }
  place_on_rings(view.rings, view.frames_of_rings, front);
  project_points(view.model.lens, front);
#pragma omp simd
  for (Index i = 0; i < front.count; ++i) {
    const double x = front.x[i], y = front.y[i], z = front.z[i];
    const double nx = front.nx[i], ny = front.ny[i], nz = front.nz[i];
    const double sizes = std::sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + z * z));
    const double cosine = -(nx * x + ny * y + nz * z) / most(sizes, 1e-12);
    front.noise[i] /= cosine;
    front.valid[i] = cosine > least_cosine ? front.valid[i] : 0.0;
  }
}

// Adds the residuals of the pose in a view, and returns its energy.
HMT_WIDE inline double add_term(const PoseView& view, const DepthInputs& inputs, const Sums& sums) {
  const Weighting& term = inputs.term;
  const Contour& front = view.front;
  trace_front(view, front);
  mark_points(view, front);
  const double each = weight_of_each(term.weight, view.model.contour_points * 5 / 10, front);
  const double unknown = geman_mcclure(1.0, term.scale, each).value;
  double energy = 0.0;
  for (Index i = 0; i < front.count; ++i) {
    if (!front.shows(i)) continue;
    const Sample depth = sample_depth(inputs.depths, front.u[i], front.v[i]);
    const double factor = view.factor(term, front.parts[i]);
    if (depth.value <= 0.0) {
      energy += factor * unknown;
      continue;
    }
    const double noise = front.noise[i], own = term.growth * depth.value * depth.value;
    const double inverse = 1.0 / std::sqrt(term.sigma * term.sigma + own * own + noise * noise);
    const Robust robust =
        geman_mcclure((depth.value - front.z[i]) * inverse, term.scale, factor * each);
    energy += robust.value;
    const auto by = [&](int k) {
      return depth.slope_u * front.by[k][i] + depth.slope_v * front.by[3 + k][i];
    };
    sums.add(view.owner(front.parts[i]), front.point(i).data(), by(0) * inverse, by(1) * inverse,
             (by(2) - 1.0) * inverse, robust.pull, robust.curvature);
  }
  return energy;
}

}  // namespace hmt
