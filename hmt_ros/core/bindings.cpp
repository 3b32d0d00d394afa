// What Python calls, and the names of its arguments; each function is described where it is.
#include "array_functions.h"
#include "block_tridiagonal.h"
#include "flips/distinct.h"
#include "flips/limb_products.h"
#include "flips/torso_flips.h"
#include "flips/tree_growth.h"
#include "flow.h"
#include "gaussian_pairs.h"
#include "keep_out.h"
#include "kinematics.h"
#include "newton.h"
#include "pose_energy.h"
#include "pose_prior.h"
#include "python.h"
#include "selection.h"
#include "shape.h"
#include "smoothing/component_overlaps.h"
#include "smoothing/mixture_energy.h"
#include "surface_points.h"
#include "terms.h"
#include "terms/ground.h"
#include "terms/keypoints.h"
#include "terms/self_intersection.h"

PYBIND11_MODULE(_compiled, m) {
  using namespace hmt;
  py::register_exception<Misfit>(m, "Misfit", PyExc_ValueError);

  auto elementary = m.def_submodule("elementary", "Elementary functions, as numpy's.");
  bind_elementary_functions(elementary);
  auto matrices = m.def_submodule("matrices", "What hmt_ros.inference.linear_algebra calls.");
  bind_matrix_functions(matrices);

  // body
  bind(m, "place_poses", place_poses, "tree poses columns origins axes dof_origins");
  bind(m, "evaluate_prior_at", evaluate_prior_at, "model poses value gradient hessian");

  // image
  bind(m, "solve", solve,
       "first last compiled point free rows exact limits descent x value gradient hessian by_cue "
       "status iterations");
  bind(m, "trace_contour", trace_contour, "flesh wanted lens columns origins contour");
  bind(m, "mark_visibility", mark_visibility,
       "flesh occluders columns origins parts points valid covered hidden");
  bind(m, "see_points", see_points,
       "flesh mesh scene columns origins counts segments local pixels");
  bind(m, "record_residuals", record_residuals, "model inputs columns origins residuals");
  bind(m, "exchange_posteriors", exchange_posteriors, "inputs log_priors columns origins result");
  bind(m, "keypoint_errors", keypoint_errors, "inputs columns origins errors");
  bind(m, "record_keypoints", record_keypoints, "inputs joints columns origins residuals");
  bind(m, "place_joints", place_joints, "tree poses joint_segments joint_offsets joints");
  bind(m, "derive_along", derive_along,
       "moves is_rotation axes dof_origins segments points directions result");
  bind(m, "lift_origins", lift_origins, "parents basis columns result");
  bind(m, "sum_shape_residuals", sum_shape_residuals,
       "table lifts parents dof_segments is_rotation joint_segments columns origins axes "
       "dof_origins of_flesh of_joints gradient curvature mixed");
  bind(m, "find_not_held", find_not_held, "starts ends radii points kept");
  m.attr("RECORDED") = int(Sums::recorded);
  m.attr("FEWEST") = fewest;
  m.attr("COVER") = cover;
  m.attr("BEHIND") = behind;
  m.attr("LEAST_FACING") = least_facing;
  m.attr("OUTLINE_TURN") = outline_turn;
  m.attr("OUTLINE_SPACING") = outline_spacing;
  m.attr("ORIENTATIONS") = orientations;
  m.attr("ASIDE") = aside;
  m.attr("LEAST_COSINE") = least_cosine;
  m.attr("DEPTH_JUMP") = depth_jump;
  m.attr("FLOW_SIGMA") = flow_sigma;
  m.attr("FLOW_SHARE") = flow_share;
  m.attr("FLOW_SCALE") = flow_scale;
  bind(m, "add_overlaps", add_overlaps_of_pose,
       "overlaps columns origins dof_axes dof_origins wanted value gradient hessian");
  bind(m, "overlap_depths", overlap_depths, "parts first second columns origins depths");
  bind(m, "add_ground_energy", add_ground_energy,
       "ground columns origins axes dof_origins wanted gradient hessian");
  // inference
  m.attr("DAMPING_LIMIT") = damping_limit;
  m.attr("LEAST_FACTOR") = least_factor;
  m.attr("LEAST_RATIO") = least_ratio;
  bind(m, "box_steps", box_steps, "x gradient hessian lower upper lam metric rows step predicted");
  bind(m, "add_diagonal", add_diagonal, "columns blocks n");
  bind(m, "fill_lower", fill_lower, "columns lower");
  bind(m, "add_band_product", add_band_product, "columns x result");
  bind(m, "hold", hold, "columns held");
  bind(m, "whiten_pairs", whiten_pairs,
       "means_a covariances_a means_b covariances_b pairs scales squares log_determinants");

  // smoothing
  bind(
      m, "add_component_overlaps", add_component_overlaps,
      "own samples noise log_weights log_scales means inflation bands near begin derivatives share "
      "log_density gradient mean_gradient inflation_gradient weight_gradient");
  bind(m, "add_mixture_energy", add_mixture_energy,
       "poses times first log_scales means whiteners precisions second exact value gradient "
       "hessian");

  // flips
  bind(m, "keep_distinct", keep_distinct, "points apart most kept owner");
  bind(m, "grow_leaves", grow_leaves,
       "chain columns origins poses targets slack given_stays angles valid");
  bind(m, "fill_torso_flips", fill_torso_flips, "tree torso poses result parents");
  bind(m, "fill_configurations", fill_configurations,
       "tree limbs modes found found_counts flipped price apart result");
  bind(m, "place_alone", place_alone, "limbs found poses");
  bind(m, "combine", combine,
       "limbs modes found energies log_weights trunk_weights share count poses parents values");
  // tracking
  bind(m, "choose_representatives", choose_representatives,
       "joints weights same cap first chosen owner");
}
