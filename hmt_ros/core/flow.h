// Energy of poses against the optical flow from one image to the next (KJS 2); see
// hmt_ros/image/optical_flow.py.
//
//     E(x) = w / Q sum_q rho(|u_q(x) - p_q - f(p_q)| / (sigma + 0.15 |f(p_q)|))
//
// Q points of the surface were seen at pixels p_q of the previous image; the pose x moves them to
// u_q(x), and f is the flow.
#pragma once

#include "pose_view.h"
#include "sampling.h"
#include "surface_points.h"

namespace hmt {

// Standard deviation of the flow, px, and additional error relative to the displacement.
inline constexpr double flow_sigma = 1.5, flow_share = 0.15;
// Width of the Geman-McClure kernel, in standard deviations.
inline constexpr double flow_scale = 2.0;

struct FlowTerm {
  SurfacePoints points;  // of K poses in the previous image, one for each problem
  ImageMap flow;         // from the previous image to this one
  double weight;         // w, number of independent measurements; 0: off

  void check() const {
    if (weight > 0.0) expect_shape("flow.values", flow.values, {2, -1, -1});
  }
  // Checks that points lie on existing segments.
  void check_segments(Index count) const {
    expect_range("points.segments", points.segments, 0, count);
  }
};

// Adds the energy of a pose, and residuals to the sums; the problem is a row of the points.
inline void add_flow(const FlowTerm& term, const Lens& lens, Index row, const Frames& frames,
                     const Sums& sums, double& value) {
  expect(0 <= row && row < term.points.counts.size(), "rows", "a row of the points");
  const Index count = term.points.counts[row];
  const double each = term.weight / double(std::max(count, fewest));
  const auto segments = term.points.segments[row];
  const Table local = term.points.local[row], pixels = term.points.pixels[row];
  for (Index q = 0; q < count; ++q) {
    const Index s = segments[q];
    const double *x = local[q].data, *axis = frames.columns[s].data,
                 *origin = frames.origins[s].data;
    double p[3], pixel[2], projection[6];
    for (int k = 0; k < 3; ++k) {
      p[k] = origin[k] + axis[k] * x[0] + axis[3 + k] * x[1] + axis[6 + k] * x[2];
    }
    if (!project(lens, p[0], p[1], p[2], pixel, projection)) continue;
    const double u = pixels(q, 0), v = pixels(q, 1);
    const double fu = sample(term.flow, 0, u, v).value, fv = sample(term.flow, 1, u, v).value;
    if (std::isnan(fu)) {
      // Another person hides the point: it has a typical cost at any position.
      value += geman_mcclure(1.0, flow_scale, each).value;
      continue;
    }
    const double inverse = 1.0 / (flow_sigma + flow_share * std::sqrt(fu * fu + fv * fv));
    const double errors[2] = {(pixel[0] - u - fu) * inverse, (pixel[1] - v - fv) * inverse};
    const Robust robust =
        geman_mcclure(std::sqrt(errors[0] * errors[0] + errors[1] * errors[1]), flow_scale, each);
    value += robust.value;
    for (int a = 0; a < 2; ++a) {
      const double* j = projection + 3 * a;
      sums.add(s, p, j[0] * inverse, j[1] * inverse, j[2] * inverse, robust.curvature * errors[a],
               robust.curvature);
    }
  }
}

}  // namespace hmt
