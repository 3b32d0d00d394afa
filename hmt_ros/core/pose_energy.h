// Energies of poses and their minima, all terms of one image in one pass; see
// hmt_ros/image/pose_energy.py.
//
//     E(x) = E_image(x) + E_keypoints(x) + E_prior(x) + E_intersection(x) + E_ground(x) + E_flow(x)
//            + E_motion(x)
#pragma once

#include <tuple>

#include "arrays.h"
#include "flow.h"
#include "kinematics.h"
#include "newton.h"
#include "pose_prior.h"
#include "residuals.h"
#include "terms.h"
#include "terms/ground.h"
#include "terms/keypoints.h"
#include "terms/self_intersection.h"

namespace hmt {

// The terms; missing terms add 0. The motion prior has R rows: one per problem, or one for all.
struct Terms {
  Placing placing;
  Model model;
  TermInputs inputs;  // of the terms of the image
  bool image;         // whether any of these is on
  bool contour;       // whether any active term needs the contour
  KeypointInputs keypoints;
  PriorModel prior;
  Overlaps overlaps;
  GroundConstants ground;
  FlowTerm flow;
  Table centres;      // (R, f) means of the motion prior; no rows: no prior
  Tables precisions;  // (R, f, f)
  double tails;       // degrees of freedom of the motion prior; 0: Gaussian

  // Number of problems of the terms; unlimited if each term has one row for all.
  Index problems() const {
    Index count = std::numeric_limits<Index>::max();
    if (flow.weight > 0.0) count = std::min(count, flow.points.counts.size());
    for (Index rows : {keypoints.log_priors.size(), centres.size()}) {
      if (rows > 1) count = std::min(count, rows);
    }
    return count;
  }
  void check() const {
    expect_shape("precisions", precisions, {centres.size(), centres.size(1), centres.size(1)});
    expect(placing.dimension() == model.tree.dimension() &&
               placing.segments() == model.tree.segments(),
           "model", "the skeleton of placing");
    expect(placing.dimension() == keypoints.tree.dimension() &&
               placing.segments() == keypoints.tree.segments(),
           "keypoints", "the skeleton of placing");
    flow.check_segments(placing.segments());
  }
};

// Settings of the minimiser; see `minimise` of hmt_ros/inference/bounded_newton.py.
struct Descent {
  Index most;  // maximum evaluations per problem after the first
  double damping, tolerance;
  Numbers scale;  // (d,) length of a moderate step of each variable: W = diag(scale^-2)
};

// Energies (n, 3) and Hessians (n, 3, d, d) of image, keypoints and all other terms; empty if not
// wanted. They are from the last evaluation. All variables must be free, and Hessians need
// derivatives.
using ByCue = std::tuple<Matrix, Array<double, 4>>;

// As `Status` of hmt_ros/inference/bounded_newton.py.
enum class Status : std::int8_t { converged, iteration_limit, stalled, not_finite };

// Energies at the points `first` to `last` - 1, or minima found from these points.
//
// `point`, `free`, `rows`, `exact` are as for `PoseEnergy.energy`; without rows point i belongs to
// problem i. `limits` (2, d) are the lower and upper limits. Value (n,), gradient (n, f), hessian
// (n, f, f), status (n,) and iterations (n,) are results; if gradients are empty, there are no
// derivatives. With `moving` (n, f) the points x (n, f) become minima within the limits, and
// `moving` marks variables that do not rest on a limit. Without `moving` the points stay.
void solve(Index first, Index last, const Terms& terms, const Numbers& point, const Places& free,
           const Places& rows, bool exact, const Table& limits, const Descent& descent,
           const Matrix& x, const Vector& value, const Matrix& gradient, const Tensor& hessian,
           const ByCue& by_cue, const Array<std::int8_t, 1>& status,
           const Array<std::int32_t, 1>& iterations, const Array<bool, 2>& moving);

}  // namespace hmt
