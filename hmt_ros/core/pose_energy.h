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

// The terms; one that is not there counts 0. R rows of the motion: one a problem, or one for all.
struct Terms {
  Placing placing;
  Model model;
  TermInputs inputs;  // of the terms of the image
  bool image;         // whether one of these is on
  bool contour;       // whether one that is on needs the contour
  KeypointInputs keypoints;
  PriorModel prior;
  Overlaps overlaps;
  GroundConstants ground;
  FlowTerm flow;
  Table centres;      // (R, f) of the motion prior; no rows: none
  Tables precisions;  // (R, f, f)
  double tails;       // degrees of freedom of the motion; 0: it is Gaussian

  // Number of problems that the terms know; they know any where each has one row for all.
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
  Index most;  // evaluations per problem after the first one
  double damping, tolerance;
  Numbers scale;  // (d,) length of a moderate step of each variable: W = diag(scale^-2)
};

// Energies (n, 3) and Hessians (n, 3, d, d) of image, keypoints and all other terms; of no point:
// not wanted. They are those of the last evaluation, all variables are free, and Hessians only
// where derivatives are.
using ByCue = std::tuple<Matrix, Array<double, 4>>;

// As `Status` of hmt_ros/inference/bounded_newton.py.
enum class Status : std::int8_t { converged, iteration_limit, stalled, not_finite };

// Energies at the points `first` to `last` - 1, or minima from there.
//
// `point`, `free`, `rows`, `exact` are as for `PoseEnergy.energy`; without rows point i belongs to
// problem i. `limits` (2, d) are the lower and the upper ones. Value (n,), gradient (n, f), hessian
// (n, f, f), status (n,) and iterations (n,) are results; no gradients: no derivatives are wanted.
// `moving` (n, f) become the variables that do not rest on a limit, and the points x (n, f) minima
// between the limits; without `moving` they stay.
void solve(Index first, Index last, const Terms& terms, const Numbers& point, const Places& free,
           const Places& rows, bool exact, const Table& limits, const Descent& descent,
           const Matrix& x, const Vector& value, const Matrix& gradient, const Tensor& hessian,
           const ByCue& by_cue, const Array<std::int8_t, 1>& status,
           const Array<std::int32_t, 1>& iterations, const Array<bool, 2>& moving);

}  // namespace hmt
