// All terms of the image likelihood, pose by pose; see hmt_ros/image/terms/registry.py.
//
//     E_image(x) = sum_t E_t(x)        over the terms t
//
// A new term is a header in terms/, with its inputs and its `add_term`, and a line in TermInputs.
#pragma once

#include <tuple>

#include "terms/coverage.h"
#include "terms/depth.h"
#include "terms/edges.h"

namespace hmt {

// Inputs of the terms, in the order of TERMS; each starts with its weighting, `term`.
using TermInputs = std::tuple<CoverageInputs,  //
                              EdgeInputs,      //
                              DepthInputs>;
inline constexpr Index term_count = std::tuple_size_v<TermInputs>;

// Checks that the inputs, an argument of this name, fit the number of segments, and have room for
// the results of all poses.
inline void check_inputs(const char* name, const TermInputs& inputs, Index segments,
                         Index poses) try {
  const auto one = [&](const auto& own) {
    expect_factors("term.segments", own.term.segments, segments);
    if constexpr (requires { own.check_poses(poses); }) own.check_poses(poses);
  };
  std::apply([&](const auto&... own) { (one(own), ...); }, inputs);
} catch (const Misfit& error) {
  throw Misfit(std::string(name) + "." + error.what());
}

// Evaluates the active terms for the pose in a view; sets their energies (terms,).
inline void run_terms(const PoseView& view, const TermInputs& inputs, const Vector& energies,
                      const Sums& sums) {
  double* energy = energies.data;
  const auto one = [&](const auto& own) {
    if (own.term.weight > 0.0) *energy = add_term(view, own, sums);
    ++energy;
  };
  std::apply([&](const auto&... own) { (one(own), ...); }, inputs);
  if (sums.segments.data) lift_pixel_sums(view, sums);
}

// Lists the residuals (N, M, Sums::recorded) of N poses with frames (N, S, 3, 3), (N, S, 3),
// instead of summing them. Entries (n, 0, 0) must be 0 and become the number of residuals of pose
// n.
void record_residuals(const Model& model, const TermInputs& inputs,
                      const Array<const double, 4>& columns, const Tables& origins,
                      const Tensor& residuals);

}  // namespace hmt
