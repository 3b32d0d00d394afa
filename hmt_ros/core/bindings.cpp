// Functions for Python and the names of their arguments; headers describe the functions.
#include "array_functions.h"
#include "block_tridiagonal.h"
#include "camera.h"
#include "experts/bones.h"
#include "experts/window_inputs.h"
#include "flesh.h"
#include "flips/distinct.h"
#include "flips/limb_products.h"
#include "flips/torso_flips.h"
#include "flips/tree_growth.h"
#include "flow.h"
#include "gaussian_pairs.h"
#include "inference/markov_chain.h"
#include "inference/state_correction.h"
#include "keep_out.h"
#include "kinematics.h"
#include "newton.h"
#include "pose_energy.h"
#include "pose_prior.h"
#include "python.h"
#include "selection.h"
#include "shape.h"
#include "shape_estimation.h"
#include "smoothing/chain_states.h"
#include "smoothing/component_overlaps.h"
#include "smoothing/mixture_energy.h"
#include "surface_points.h"
#include "terms.h"
#include "terms/ground.h"
#include "terms/keypoints.h"
#include "terms/points.h"
#include "terms/self_intersection.h"
#include "tracking/continuity.h"
#include "tracking/facing.h"
#include "tracking/optima.h"
#include "vision/colours.h"
#include "vision/edge_distances.h"
#include "vision/line_directions.h"
#include "vision/outline.h"

PYBIND11_MODULE(_compiled, m) {
  using namespace hmt;
  py::register_exception<Misfit>(m, "Misfit", PyExc_ValueError);

  auto elementary = m.def_submodule("elementary", "Elementary functions, as numpy's.");
  bind_elementary_functions({elementary.ptr(), ufunc_interface()});
  auto matrices = m.def_submodule("matrices", "What hmt_ros.inference.linear_algebra calls.");
  bind_matrix_functions({matrices.ptr(), ufunc_interface()});

  // body
  bind(m, "place_poses", place_poses, "tree poses columns origins axes dof_origins");
  bind(m, "place_points", place_points, "tree poses segments local relative points");
  bind(m, "find_pixels", find_pixels, "lens points pixels");
  bind(m, "find_rays", find_rays, "lens pixels rays");
  bind(m, "derive_along", derive_along,
       "moves is_rotation axes dof_origins segments points directions result");
  bind(m, "derive_points", derive_points,
       "moves is_rotation axes dof_origins segments points result");
  bind(m, "evaluate_points", evaluate_points,
       "tree columns origins axes dof_origins segments local targets across value gradient "
       "hessian");
  bind(m, "lift_origins", lift_origins, "parents basis columns result");
  bind(m, "fill_rings", fill_rings, "parts ring_parts heights centre radius slope lean");
  bind(m, "fill_surface", fill_surface, "parts heights cosines sines points normals");
  bind(m, "evaluate_prior_at", evaluate_prior_at, "model poses value gradient hessian");
  bind(m, "add_overlaps", add_overlaps_of_pose,
       "overlaps columns origins axes dof_origins wanted value gradient hessian");
  bind(m, "overlap_depths", overlap_depths, "parts first second columns origins depths");
  bind(m, "add_ground_energy", add_ground_energy,
       "ground columns origins axes dof_origins wanted gradient hessian");
  bind(m, "find_not_held", find_not_held, "starts ends radii ring kept");
  bind(m, "sum_shape_residuals", sum_shape_residuals,
       "table lifts parents dof_segments is_rotation joint_segments columns origins axes "
       "dof_origins of_flesh of_joints gradient curvature mixed");

  // image
  bind(m, "solve", solve,
       "first last compiled point free rows exact limits descent x value gradient hessian by_cue "
       "status iterations moving");
  bind(m, "record_residuals", record_residuals, "model inputs columns origins residuals");
  bind(m, "trace_contour", fill_contour, "flesh wanted lens columns origins contour");
  bind(m, "mark_visibility", mark_visibility,
       "flesh occluders columns origins parts points valid covered hidden");
  bind(m, "see_points", see_points,
       "flesh mesh scene columns origins counts segments local pixels");
  bind(m, "exchange_posteriors", exchange_posteriors, "inputs log_priors columns origins result");
  bind(m, "keypoint_errors", keypoint_errors, "inputs columns origins errors");
  bind(m, "record_keypoints", record_keypoints, "inputs joints columns origins residuals");
  bind(m, "edge_distances", edge_distances, "edges dx dy near others hidden distances");
  bind(m, "rate_lines", rate_lines, "directions normals middles deviations result");
  bind(m, "rate_frames", rate_frames, "densities vertical first second share result");
  bind(m, "gradient_lengths", gradient_lengths, "dx dy longest lengths");
  bind(m, "sample_outline", sample_outline,
       "pixels ends mask unsure others count left top places normals beliefs");
  bind(m, "bin_colours", bin_colours, "image count bins");
  bind(m, "count_colours", count_colours, "bins regions counts");

  // flips
  bind(m, "keep_distinct", keep_distinct, "points apart most kept owner");
  bind(m, "grow_leaves", grow_leaves,
       "chain columns origins poses targets slack given_stays angles valid");
  bind(m, "fill_torso_flips", fill_torso_flips, "tree torso poses result parents");
  bind(m, "fill_configurations", fill_configurations,
       "tree limbs modes found found_counts flipped price apart most result");
  bind(m, "place_alone", place_alone, "limbs found poses rows");
  bind(m, "combine", combine,
       "limbs modes found energies log_weights exchanged exchange flip share count poses parents "
       "values");

  // inference
  bind(m, "box_steps", box_steps, "x gradient hessian lower upper lam metric rows step predicted");
  bind(m, "add_diagonal", add_diagonal, "columns blocks n");
  bind(m, "fill_lower", fill_lower, "columns lower");
  bind(m, "add_band_product", add_band_product, "columns x result");
  bind(m, "hold", hold, "columns held");
  bind(m, "step_chains", step_chains, "rates dt joint");
  bind(m, "predict_damped", predict_damped, "a b noise means covariances moved result");
  bind(m, "correct_states", correct_states,
       "predicted ancestors jumped poses found velocities result");
  bind(m, "fuse", fuse, "a b result");
  bind(m, "widen_precisions", widen_precisions, "precisions ancestors jumped wandered result");
  bind(m, "whiten_pairs", whiten_pairs,
       "means_a covariances_a means_b covariances_b pairs scales squares log_determinants");

  // tracking
  bind(m, "choose_representatives", choose_representatives,
       "joints log_weights same cap first chosen owner groups");
  bind(m, "rate_transitions", rate_transitions, "first joints transition result");
  bind(m, "rate_histories", rate_histories, "log_weights transitions joints transition end result");
  bind(m, "point_left", point_left, "trunk joints result");
  bind(m, "face_back", face_back, "trunk joints reference neck sideways result");
  bind(m, "believed", believed, "evidence valid");
  bind(m, "weigh_ways", weigh_ways,
       "trunk ways first joints transitions log_weights evidence followed result facing turned");
  bind(m, "consider_shape", consider_shape, "mixed covariances of_shape result");
  bind(m, "inform_shape", inform_shape,
       "by_shape curvature mixed weights gradients covariances turns most_turn information pull");
  bind(m, "keep_apart", keep_apart, "joints order same kept");
  bind(m, "free_covariances", free_covariances,
       "hessians shares free resting least covariances log_determinants");
  bind(m, "shift_modes", shift_modes, "poses gradient free covariances spreads most limits means");
  bind(m, "determined", determined, "weights covariances hessians amounts");

  // smoothing
  bind(m, "condition_chain", condition_chain, "prior precisions means resting columns states");
  bind(
      m, "add_component_overlaps", add_component_overlaps,
      "own samples noise log_weights log_scales means inflation bands near begin derivatives share "
      "log_density gradient mean_gradient inflation_gradient weight_gradient");
  bind(m, "add_mixture_energy", add_mixture_energy,
       "poses times first log_scales means whiteners precisions second exact value gradient "
       "hessian");

  // experts
  bind(m, "window_middles", window_middles, "rays confidences trunk least_confidence middles");
  bind(m, "fill_window_inputs", fill_window_inputs,
       "rays confidences times wanted ups persons axes least_confidence values");
  bind(m, "resize_bones", resize_bones, "order factors joints result");

  // constants
  m.attr("LANES") = int(lanes);
  m.attr("RECORDED") = int(Sums::recorded);
  m.attr("MIN_POINTS") = fewest;
  m.attr("COVER") = cover;
  m.attr("BEHIND") = behind;
  m.attr("MIN_FACING") = least_facing;
  m.attr("OUTLINE_TURN") = outline_turn;
  m.attr("OUTLINE_SPACING") = outline_spacing;
  m.attr("ORIENTATIONS") = orientations;
  m.attr("ASIDE") = aside;
  m.attr("MIN_COSINE") = least_cosine;
  m.attr("DEPTH_JUMP") = depth_jump;
  m.attr("FLOW_SIGMA") = flow_sigma;
  m.attr("FLOW_SHARE") = flow_share;
  m.attr("FLOW_SCALE") = flow_scale;
  m.attr("DAMPING_LIMIT") = damping_limit;
  m.attr("MIN_FACTOR") = least_factor;
  m.attr("MIN_RATIO") = least_ratio;
  bind(m, "factorise_band", factorise_band, "columns");
  bind(m, "solve_band_lower", solve_band_lower, "columns x");
  bind(m, "solve_band_transposed", solve_band_transposed, "columns x");
  bind(m, "multiply_band_transposed", multiply_band_transposed, "columns x");
  bind(m, "invert_block", invert_block, "columns place after result");
}
