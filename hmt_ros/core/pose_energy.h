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
  Table centres;      // (R, f) of the motion; no rows: there is none
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
    flow.check_segments(placing.segments());
  }
};

// Settings of the minimiser; see `minimise` of hmt_ros/inference/bounded_newton.py.
struct Descent {
  Index most;  // evaluations per problem after the first one
  double damping, tolerance;
  Numbers metric;  // (f,) diagonal of W
};

// Energies (n, 3) and Hessians (n, 3, d, d) of image, keypoints and all other terms; of no point:
// not wanted. They are those of the last evaluation, all variables are free, and Hessians only
// where derivatives are.
using ByCue = std::tuple<Matrix, Array<double, 4>>;

// Working space for one pose after the other.
class PoseEnergy {
 public:
  // `point` (d,) holds the values of the variables that are not free (f,); `apart`: whether cues
  // are summed apart.
  PoseEnergy(const Terms& terms, const Numbers& point, const Places& free, bool apart)
      : terms_(terms),
        free_(free),
        cues_(apart ? 3 : 1),
        pose_(point.size()),
        axes_(point.size(), 3),
        dof_origins_(point.size(), 3),
        view_(terms.model),
        wrenches_(terms.placing.segments(), 6),
        stiffnesses_(terms.placing.segments(), 6, 6),
        energies_(term_count),
        values_(cues_),
        gradients_(cues_, point.size()),
        hessians_(cues_, point.size(), point.size()),
        prior_room_(terms.prior),
        keypoint_room_(terms.keypoints),
        overlap_room_(terms.overlaps),
        pulled_(free.size()) {
    pose_.view().copy_from(point);
  }

  const Vector& values() const { return values_; }
  const Tensor& hessians() const { return hessians_; }

  // Energy at x (f,) of point `number` of a call, which belongs to the problem `row`; slope (f,)
  // and curve (f, f) become its derivatives, where they are wanted. `exact`: the Hessian of the
  // prior is the exact one.
  double at(Index number, Index row, const Numbers& x, bool exact, bool wanted, const Vector& slope,
            const Matrix& curve) {
    const Index f = free_.size();
    for (Index i = 0; i < f; ++i) pose_[free_[i]] = x[i];
    double value = add_terms(number, row, exact, wanted);
    if (wanted) {
      for (Index i = 0; i < f; ++i) slope[i] = gradients_(0, free_[i]);
      for (Index i = 0; i < f; ++i) {
        for (Index j = 0; j < f; ++j) curve(i, j) = hessians_(0, free_[i], free_[j]);
      }
      for (Index cue = 1; cue < cues_; ++cue) {
        for (Index i = 0; i < f; ++i) {
          slope[i] += gradients_(cue, free_[i]);
          for (Index j = 0; j < f; ++j) curve(i, j) += hessians_(cue, free_[i], free_[j]);
        }
      }
    }
    if (terms_.centres.size() > 0) {
      const Index own = terms_.centres.size() > 1 ? row : 0;
      value += add_motion(terms_.centres[own], terms_.precisions[own], x, wanted, slope, curve);
    }
    return value;
  }

 private:
  // Energy of the pose without the motion; derivatives become those by the pose.
  double add_terms(Index number, Index row, bool exact, bool wanted) {
    const Index keypoints = std::min<Index>(1, cues_ - 1), others = cues_ - 1;
    const Tensor& columns = view_.columns;
    const Matrix& origins = view_.origins;
    const Vector slope = gradients_[others];
    const Matrix curve = hessians_[others];
    values_.fill(0.0);
    if (wanted) {
      gradients_.fill(0.0);
      hessians_.fill(0.0);
    }
    place_pose(terms_.placing, pose_, columns, origins, axes_, dof_origins_);
    values_[others] = evaluate_prior(terms_.prior, pose_, exact, wanted, slope, curve, prior_room_);
    if (terms_.image) {
      look(view_, number, terms_.contour);
      if (wanted) {
        wrenches_.fill(0.0);
        stiffnesses_.fill(0.0);
      }
      energies_.fill(0.0);
      run_terms(view_, terms_.inputs, energies_, sums(wanted));
      double energy = 0.0;
      for (Index term = 0; term < term_count; ++term) energy += energies_[term];
      values_[0] += energy;
      if (wanted) {
        assemble_pose(terms_.model.tree, axes_, dof_origins_, wrenches_, stiffnesses_,
                      gradients_[0], hessians_[0]);
      }
    }
    const KeypointInputs& seen = terms_.keypoints;
    if (seen.points.groups.size() > 0 || seen.lifted.weight > 0.0) {
      const Numbers log_prior = seen.log_priors[seen.log_priors.size() > 1 ? row : 0];
      values_[keypoints] +=
          add_keypoints(seen, log_prior, columns, origins, axes_, dof_origins_, wanted,
                        gradients_[keypoints], hessians_[keypoints], keypoint_room_);
    }
    double& known = values_[others];
    if (terms_.overlaps.sigma < infinity) {
      add_overlaps(terms_.overlaps, columns, origins, axes_, dof_origins_, wanted, known, slope,
                   curve, overlap_room_);
    }
    if (terms_.ground.on()) {
      known += add_ground_energy(terms_.ground, columns, origins, axes_, dof_origins_, wanted,
                                 slope, curve);
    }
    if (terms_.flow.weight > 0.0) {
      add_flow(terms_.flow, terms_.model.tree, terms_.model.lens, row, view_.frames(), axes_,
               dof_origins_, sums(wanted), known, slope, curve);
    }
    double total = 0.0;
    for (Index cue = 0; cue < cues_; ++cue) total += values_[cue];
    return total;
  }

  // Room for sums over the segments; none where no derivatives are wanted.
  Sums sums(bool wanted) const {
    return wanted ? Sums{wrenches_.view(), stiffnesses_.view(), {}} : Sums{};
  }

  // Energy of the motion at x (f,); adds its derivatives where they are wanted.
  double add_motion(const Numbers& centre, const Table& precision, const Numbers& x, bool wanted,
                    const Vector& slope, const Matrix& curve) {
    const Index f = x.size();
    const double nu = terms_.tails;
    pulled_.fill(0.0);
    for (Index j = 0; j < f; ++j) {  // along rows of a symmetric matrix, many entries at once
      const double moved = x[j] - centre[j];
      const double* line = precision[j].data;
      for (Index i = 0; i < f; ++i) pulled_[i] += line[i] * moved;
    }
    double distance = 0.0;
    for (Index i = 0; i < f; ++i) distance += pulled_[i] * (x[i] - centre[i]);
    double value = 0.5 * distance, shrinkage = 1.0;
    if (nu > 0.0) {
      value = 0.5 * (nu + f) * std::log1p(distance / nu);
      shrinkage = (nu + f) / (nu + distance);
    }
    if (!wanted) return value;
    for (Index i = 0; i < f; ++i) {
      slope[i] += shrinkage * pulled_[i];
      const double* line = precision[i].data;
      double* own = curve[i].data;
      for (Index j = 0; j < f; ++j) own[j] += shrinkage * line[j];
    }
    return value;
  }

  const Terms& terms_;
  const Places free_;
  const Index cues_;
  Scratch<double, 1> pose_;
  Scratch<double, 2> axes_, dof_origins_;
  PoseView view_;
  Scratch<double, 2> wrenches_;
  Scratch<double, 3> stiffnesses_;
  Scratch<double, 1> energies_, values_;
  Scratch<double, 2> gradients_;
  Scratch<double, 3> hessians_;
  PriorRoom prior_room_;
  KeypointRoom keypoint_room_;
  OverlapRoom overlap_room_;
  Scratch<double, 1> pulled_;
};

// As `Status` of hmt_ros/inference/bounded_newton.py.
enum class Status : std::int8_t { converged, iteration_limit, stalled, not_finite };

// Energies at the points `first` to `last` - 1, or minima from there.
//
// `point`, `free`, `rows`, `exact` are as for `PoseEnergy.energy`, `limits` (2, f) the lower and
// the upper ones. The points x (n, f) become minima, where evaluations after the first are asked
// for; value (n,), gradient (n, f), hessian (n, f, f), status (n,) and iterations (n,) are results;
// no gradients: no derivatives are wanted, and no minima.
void solve(Index first, Index last, const Terms& terms, const Numbers& point, const Places& free,
           const Places& rows, bool exact, const Table& limits, const Descent& descent,
           const Matrix& x, const Vector& value, const Matrix& gradient, const Tensor& hessian,
           const ByCue& by_cue, const Array<std::int8_t, 1>& status,
           const Array<std::int32_t, 1>& iterations);

}  // namespace hmt
