// Visible points of the surface lie where a depth image sees one; see hmt_ros/image/terms/depth.py.
//
//     E(x) = w / V sum_i rho((D(u_i(x)) - z_i(x)) / sigma_i)
//     sigma_i^2 = sigma^2 + (growth D^2)^2 + (noise_i / cos a_i)^2
//
// over the V visible points i of the flesh: on every ring the two on either side of the part that
// faces the camera. D is the depth image, z_i the depth of the point, a_i the angle between its
// normal and its ray.
#pragma once

#include "../pose_view.h"
#include "../sampling.h"

namespace hmt {

// Angle around a ring between the part that faces the camera and a point, rad.
inline constexpr double aside = pi / 4.0;
inline const double aside_cosine = std::cos(aside), aside_sine = std::sin(aside);
// Points whose normal is further from the ray than this are not compared, as a cosine.
inline constexpr double least_cosine = 0.3;
// Neighbouring depths that differ by more, as a share of the depth, lie on two surfaces.
inline constexpr double depth_jump = 0.03;

struct DepthInputs {
  Weighting term;
  ImageMap depths;  // m, 0 where nothing was measured

  void check() const {
    if (term.weight > 0.0) expect(depths.values.size() > 0, "depths.values", "a channel");
  }
};

// Depth at a pixel and its derivatives; 0 where nothing was measured. Between four depths of one
// surface it is bilinear, else that of the nearest pixel.
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

// Fills in the points of the pose in a view that face the camera, two on each ring; their noise
// becomes that along the ray.
inline void trace_front(const PoseView& view, const Contour& front) {
  const FleshTable& flesh = view.model.flesh;
  const Index rings = flesh.rings();
  for (Index r = 0; r < rings; ++r) {
    const Index part = flesh.ring_parts[r];
    front.parts[r] = front.parts[r + rings] = part;
    front.valid[r] = front.valid[r + rings] = false;
    if (!view.model.traced[part]) continue;
    const Ring ring = flesh.ring(r);
    const Index s = view.owner(part);
    const double *axes = view.columns[s].data, *origin = view.origins[s].data;
    double seen[3];
    ring_seen(ring, axes, origin, seen);
    double fx = -(seen[0] - seen[2] * ring.leans[0]) / ring.radii[0];
    double fy = -(seen[1] - seen[2] * ring.leans[1]) / ring.radii[1];
    const double size = most(std::sqrt(fx * fx + fy * fy), 1e-12);
    fx = fx / size;
    fy = fy / size;
    for (int side = 0; side < 2; ++side) {
      const Index i = r + side * rings;
      const double turn = side == 0 ? -aside_sine : aside_sine;
      const double c = fx * aside_cosine - fy * turn, sn = fy * aside_cosine + fx * turn;
      double *p = front.points[i].data, n[3];
      ring_point(ring, c, sn, axes, origin, p, n);
      const double sizes = std::sqrt((n[0] * n[0] + n[1] * n[1] + n[2] * n[2]) *
                                     (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]));
      const double cosine = -(n[0] * p[0] + n[1] * p[1] + n[2] * p[2]) / most(sizes, 1e-12);
      front.noise[i] = ring_deviation(ring, c, sn) / cosine;
      front.valid[i] =
          cosine > least_cosine && project(view.model.lens, p[0], p[1], p[2], front.pixels[i].data,
                                           front.projections[i].data);
    }
  }
}

// Adds the residuals of the pose in a view, returns its energy.
inline double add_term(const PoseView& view, const DepthInputs& inputs, const Sums& sums) {
  const Weighting& term = inputs.term;
  const Contour& front = view.front;
  trace_front(view, front);
  mark_points(view, front);
  const double each = weight_of_each(term.weight, view.model.contour_points * 5 / 10, front);
  const double unknown = geman_mcclure(1.0, term.scale, each).value;
  double energy = 0.0;
  for (Index i = 0; i < front.count(); ++i) {
    if (!front.valid[i] || front.hidden[i]) continue;
    const Sample depth = sample_depth(inputs.depths, front.pixels(i, 0), front.pixels(i, 1));
    if (depth.value <= 0.0) {
      energy += unknown;
      continue;
    }
    const double *p = front.points[i].data, noise = front.noise[i];
    const double own = term.growth * depth.value * depth.value;
    const double inverse = 1.0 / std::sqrt(term.sigma * term.sigma + own * own + noise * noise);
    const double error = (depth.value - p[2]) * inverse;
    const Robust robust = geman_mcclure(error, term.scale, each);
    energy += robust.value;
    const Gradient a = by_point(depth.slope_u, depth.slope_v, front.projections[i].data);
    sums.add(view.owner(front.parts[i]), p, a.x * inverse, a.y * inverse, (a.z - 1.0) * inverse,
             robust.pull, robust.curvature);
  }
  return energy;
}

}  // namespace hmt
