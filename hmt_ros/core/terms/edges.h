// Visible contour points lie on image edges of their direction; see hmt_ros/image/terms/edges.py.
//
//     E(x) = w / V sum_i rho(d_o(i)(u_i(x)) / sigma)
//
// over the V visible contour points u_i, d_o the distance to the nearest edge of orientation o.
#pragma once

#include "../pose_view.h"
#include "../sampling.h"

namespace hmt {

inline constexpr Index orientations = 4;
inline constexpr double half_bin = 0.41421356237309503;  // tan(pi / 8)

struct EdgeInputs {
  Weighting term;
  ImageMap distances;  // to the nearest edge of each orientation, px

  void check() const {
    if (term.weight > 0.0)
      expect_shape("distances.values", distances.values, {orientations, -1, -1});
  }
};

// The orientation that a normal is nearest to, of angle k pi / 4.
inline Index orientation(double x, double y) {
  if (std::abs(y) <= half_bin * std::abs(x)) return 0;
  if (std::abs(x) <= half_bin * std::abs(y)) return 2;
  return x * y > 0.0 ? 1 : 3;
}

// Adds the residuals of the pose in a view, returns its energy.
inline double add_term(const PoseView& view, const EdgeInputs& inputs, const Sums& sums) {
  const Weighting& term = inputs.term;
  const Contour& contour = view.contour;
  const double each = weight_of_each(term.weight, view.model.contour_points * 6 / 10, contour);
  double energy = 0.0;
  for (Index i = 0; i < contour.count(); ++i) {
    if (!contour.valid[i] || contour.hidden[i]) continue;
    const Index channel = orientation(contour.normals(i, 0), contour.normals(i, 1));
    const Sample distance =
        sample_distance(inputs.distances, channel, contour.pixels(i, 0), contour.pixels(i, 1));
    const double sigma = contour_sigma(term, contour.noise[i]);
    const Robust robust = geman_mcclure(distance.value / sigma, term.scale, each);
    energy += robust.value;
    const Gradient a =
        by_point(distance.slope_u / sigma, distance.slope_v / sigma, contour.projections[i].data);
    sums.add(view.owner(contour.parts[i]), contour.points[i].data, a.x, a.y, a.z, robust.pull,
             robust.curvature);
  }
  return energy;
}

}  // namespace hmt
