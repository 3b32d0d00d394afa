// Energies of keypoints for all exchanges of sides; see hmt_ros/image/terms/keypoints.py.
//
//     E(x) = -log sum_e p_e exp(-sum_g E_g,e(x))          e: exchange, g: group of landmarks
//     E_g,e(x) = w_g sum_k f_s(k) rho(k, e)
//
// Given an exchange of sides, the energies of groups add; over the exchanges, likelihoods add. The
// energy of the whole pose under a mixture over depths is added to the energies of the groups. s(k)
// is the segment of keypoint k without exchange.
#pragma once

#include "../camera.h"
#include "../kinematics.h"
#include "../log_sum_exp.h"
#include "../residuals.h"

namespace hmt {

// Error of a joint behind the camera, in standard deviations.
inline constexpr double error_behind = 1e3;
// A landmark whose weight is below this adds nothing to the derivatives.
inline constexpr double least_share = 1e-6;

// Keypoints (P,), each with its landmark without and with exchanged sides.
struct Points {
  Array<const Index, 2> segments;  // (P, 2) segments that carry the landmarks
  Tables offsets;                  // (P, 2, 3) in the frames of the segments, m
  Table pixels;                    // (P, 2)
  Tables whiteners;                // (P, 2, 2) W, W' W is the precision
  Places groups;                   // (P,) group of keypoints exchanged together

  Index size() const { return groups.size(); }
  void check() const {
    const Index p = size();
    expect_shape("segments", segments, {p, 2});
    expect_shape("offsets", offsets, {p, 2, 3});
    expect_shape("pixels", pixels, {p, 2});
    expect_shape("whiteners", whiteners, {p, 2, 2});
  }
};

// Depths of joints (J,) behind the middle of the hips, a mixture of C components.
struct Lifted {
  Places segments;      // (J,) segments that carry the joints
  Table offsets;        // (J, 3) in the frames of the segments, m
  Numbers middle;       // (3,) middle of the hips in the frame of the root, m
  Numbers ray;          // (3,) line of sight, unit vector
  Numbers log_weights;  // (C,) including the normalisers of the components
  Tables depths;        // (2, C, J) along the ray, m, without and with exchanged sides
  Tables precisions;    // (2, C, J) square roots, 1/m
  Places readings;      // (E,) 0 or 1: first index of `depths` for each exchange of sides
  double weight;        // factor on the energy; 0 without a mixture
  double scale;         // of the kernel, in standard deviations

  Index joints() const { return segments.size(); }
  Index components() const { return log_weights.size(); }
  void check() const {
    const Index j = joints(), c = components();
    expect_shape("offsets", offsets, {j, 3});
    expect_shape("middle", middle, {3});
    expect_shape("ray", ray, {3});
    expect_shape("depths", depths, {2, c, j});
    expect_shape("precisions", precisions, {2, c, j});
    expect_range("readings", readings, 0, 2);
  }
};

struct KeypointInputs {
  Points points;
  Lifted lifted;
  Tree tree;
  Lens lens;
  double scale;                     // of the kernel, in standard deviations
  Numbers weights;                  // (G,) factors on the energies of the groups
  Numbers factors;                  // (S,) factors for keypoints of each segment; none: 1
  Array<const Index, 2> exchanged;  // (E, G) 1 where an exchange exchanges a group
  Table log_priors;                 // (R, E) of the exchanges, one row per problem or one for all

  Index exchanges() const { return exchanged.size(); }
  Index groups() const { return weights.size(); }
  void check() const {
    const Index s = tree.segments();
    expect_range("points.segments", points.segments, 0, s);
    expect_range("points.groups", points.groups, 0, groups());
    expect_range("lifted.segments", lifted.segments, 0, s);
    expect(s > 0, "tree.parents", "one segment at least");
    expect_factors("factors", factors, s);
    expect(exchanges() > 0, "exchanged", "one exchange at least");
    expect_shape("exchanged", exchanged, {-1, groups()});
    expect_range("exchanged", exchanged, 0, 2);
    expect(lifted.readings.size() >= exchanges(), "lifted.readings", "one of each exchange");
    expect(log_priors.size() > 0, "log_priors", "one row at least");
    expect_shape("log_priors", log_priors, {-1, exchanges()});
  }
  // Factor on the energy of keypoint k.
  double factor(Index k) const { return factor_of(factors, points.segments(k, 0)); }
  // Checks that frames (N, S, 3, 3), (N, S, 3) of the segments exist for all poses.
  void check_frames(const Array<const double, 4>& columns, const Tables& origins) const {
    expect_shape("columns", columns, {-1, tree.segments(), 3, 3});
    expect_shape("origins", origins, {columns.size(), tree.segments(), 3});
  }
};

// Working space, reused for all poses.
struct KeypointRoom {
  explicit KeypointRoom(const KeypointInputs& inputs)
      : posterior(inputs.exchanges()),
        energies(inputs.groups(), 2),
        shares(inputs.groups(), 2),
        behind(inputs.lifted.joints()),
        by_joint(2, in_whole_lanes(inputs.lifted.joints())),
        places(1 + inputs.lifted.joints(), 3),
        responsibilities(2, inputs.lifted.components()),
        segments(inputs.tree.segments()),
        axes(inputs.tree.dimension(), 3),
        dof_origins(inputs.tree.dimension(), 3) {}

  Scratch<double, 1> posterior;         // log probabilities of the exchanges
  Scratch<double, 2> energies;          // of the groups, without and with exchange
  Scratch<double, 2> shares;            // probabilities that groups are exchanged or not
  Scratch<double, 1> behind;            // depths of the joints behind the middle of the hips
  Scratch<double, 2> by_joint;          // numbers of the joints, padded with 0 to whole lanes
  Scratch<double, 2> places;            // the middle of the hips and the joints
  Scratch<double, 2> responsibilities;  // of the components, without and with exchange
  Scratch<SegmentSums, 1> segments;
  Scratch<double, 2> axes, dof_origins;  // with the middle of the hips at rest

  // Sums over the segments, zero.
  Sums no_sums() const {
    const Sums sums{segments.view(), {}};
    sums.clear();
    return sums;
  }
};

// The landmark of a keypoint at a pose.
struct Landmark {
  double place[3], pixel[2], projection[6];
  bool shown;        // whether it has a pixel
  double errors[2];  // of the keypoint, whitened

  Landmark(const KeypointInputs& inputs, Index k, Index exchanged, const Tables& columns,
           const Table& origins) {
    const Points& points = inputs.points;
    place_point(columns, origins, points.segments(k, exchanged),
                points.offsets.data + 3 * (2 * k + exchanged), place);
    shown = project(inputs.lens, place[0], place[1], place[2], pixel, projection);
    if (!shown) return;
    const double *seen = points.pixels[k].data, *whitener = points.whiteners.data + 4 * k;
    for (int i = 0; i < 2; ++i) {
      const double across = whitener[2 * i] * (pixel[0] - seen[0]);
      errors[i] = across + whitener[2 * i + 1] * (pixel[1] - seen[1]);
    }
  }

  // Adds the residuals to a segment, or to a list.
  void add(const KeypointInputs& inputs, Index k, Index s, double share, const Sums& sums) const {
    const double* whitener = inputs.points.whiteners.data + 4 * k;
    for (int i = 0; i < 2; ++i) {
      const double w0 = whitener[2 * i], w1 = whitener[2 * i + 1], *j = projection;
      const Robust robust = geman_mcclure(errors[i], inputs.scale, share);
      sums.add(s, place, w0 * j[0] + w1 * j[3], w0 * j[1] + w1 * j[4], w0 * j[2] + w1 * j[5],
               robust.pull, robust.curvature);
    }
  }
};

// Fills the energies (G, 2) of the groups at one pose, without and with exchange.
inline void group_energies(const KeypointInputs& inputs, const Tables& columns,
                           const Table& origins, const Matrix& energies) {
  energies.fill(0.0);
  for (Index k = 0; k < inputs.points.size(); ++k) {
    const double factor = inputs.factor(k);
    for (int e = 0; e < 2; ++e) {
      const Landmark mark(inputs, k, e, columns, origins);
      double& energy = energies(inputs.points.groups[k], e);
      for (int i = 0; i < 2; ++i) {
        const double error = mark.shown ? mark.errors[i] : error_behind;
        energy += geman_mcclure(error, inputs.scale, factor).value;
      }
    }
  }
}

// Minus the log densities (2,) of the mixture at one pose, without and with exchanged sides; fills
// its part of the room.
inline void lifted_energies(const Lifted& lifted, const Tables& columns, const Table& origins,
                            const KeypointRoom& room, double* energies) {
  const Index joints = lifted.joints();
  const double *ray = lifted.ray.data, *behind = room.behind.view().data;
  const double* middle = room.places[0].data;
  place_point(columns, origins, 0, lifted.middle.data, room.places[0].data);
  for (Index k = 0; k < joints; ++k) {
    double* place = room.places[1 + k].data;
    place_point(columns, origins, lifted.segments[k], lifted.offsets[k].data, place);
    double depth = 0.0;
    for (int i = 0; i < 3; ++i) depth += (place[i] - middle[i]) * ray[i];
    room.behind[k] = depth;
  }
  for (int e = 0; e < 2; ++e) {
    const Vector shares = room.responsibilities[e];
    room.by_joint.fill(0.0);
    double top = -infinity;
    for (Index c = 0; c < lifted.components(); ++c) {
      const double *precision = lifted.precisions[e][c].data, *depth = lifted.depths[e][c].data;
      double* costs = room.by_joint[0].data;
#pragma omp simd
      for (Index k = 0; k < joints; ++k) {
        const double residual = precision[k] * (behind[k] - depth[k]);
        costs[k] = geman_mcclure(residual, lifted.scale, 1.0).value;
      }
      const double total = lifted.log_weights[c] - sum_of(costs, room.by_joint.size(1));
      shares[c] = total;
      top = most(top, total);
    }
    const double mass = exponentials(shares.data, top, shares.size());
    for (double& share : shares) share /= mass;
    energies[e] = -top - elementary::log(mass);
  }
}

// Adds the derivatives of the mixture at one pose, with the probabilities (2,) that sides are not
// exchanged, and exchanged.
//
// Depths are relative to the middle of the hips. So rotations of the root act about this middle,
// and its translations have no effect.
inline void add_lifted(const KeypointInputs& inputs, const double* readings, const Table& axes,
                       const Table& dof_origins, const Vector& gradient, const Matrix& hessian,
                       const KeypointRoom& room) {
  const Lifted& lifted = inputs.lifted;
  const Tree& tree = inputs.tree;
  room.axes.view().copy_from(axes);
  room.dof_origins.view().copy_from(dof_origins);
  for (Index j = 0; j < tree.dimension(); ++j) {
    if (tree.dof_segments[j] != 0) continue;
    if (tree.dof_is_rotation[j]) {
      room.dof_origins[j].copy_from(room.places[0]);
    } else {
      room.axes[j].fill(0.0);
    }
  }
  const Sums sums = room.no_sums();
  const double* ray = lifted.ray.data;
  room.by_joint.fill(0.0);
  double *pulls = room.by_joint[0].data, *curvatures = room.by_joint[1].data;
  const double* behind = room.behind.view().data;
  for (int e = 0; e < 2; ++e) {
    for (Index c = 0; c < lifted.components(); ++c) {
      const double *precision = lifted.precisions[e][c].data, *depth = lifted.depths[e][c].data;
      const double share = lifted.weight * readings[e] * room.responsibilities(e, c);
#pragma omp simd
      for (Index k = 0; k < lifted.joints(); ++k) {
        const double residual = precision[k] * (behind[k] - depth[k]);
        const Robust robust = geman_mcclure(residual, lifted.scale, share);
        pulls[k] += precision[k] * robust.pull;
        curvatures[k] += precision[k] * precision[k] * robust.curvature;
      }
    }
  }
  for (Index k = 0; k < lifted.joints(); ++k) {
    sums.add(lifted.segments[k], room.places[1 + k].data, ray[0], ray[1], ray[2], pulls[k],
             curvatures[k]);
  }
  assemble_pose(tree, room.axes, room.dof_origins, sums.segments, gradient, hessian);
}

// Log probabilities (E,) of exchanges at one pose, from log priors (E,); returns minus the log of
// the sum of their likelihoods.
inline double weigh_exchanges(const KeypointInputs& inputs, const Numbers& log_prior,
                              const Tables& columns, const Table& origins, const KeypointRoom& room,
                              const Vector& result) {
  const Lifted& lifted = inputs.lifted;
  double whole[2] = {0.0, 0.0};
  group_energies(inputs, columns, origins, room.energies);
  if (lifted.weight > 0.0) {
    lifted_energies(lifted, columns, origins, room, whole);
    for (double& energy : whole) energy *= lifted.weight;
  }
  double top = -infinity, mass = 0.0;
  for (Index e = 0; e < inputs.exchanges(); ++e) {
    double total = log_prior[e] - whole[lifted.readings[e]];
    for (Index g = 0; g < inputs.groups(); ++g) {
      total -= inputs.weights[g] * room.energies(g, inputs.exchanged(e, g));
    }
    result[e] = total;
    top = most(top, total);
  }
  for (double log : result) mass += elementary::exp(log - top);
  const double total = top + elementary::log(mass);
  for (double& log : result) log -= total;
  return -total;
}

// Log probabilities (N, E) of exchanges at N poses, from log priors (N, E).
inline void exchange_posteriors(const KeypointInputs& inputs, const Table& log_priors,
                                const Array<const double, 4>& columns, const Tables& origins,
                                const Matrix& result) {
  const Index n = columns.size();
  inputs.check_frames(columns, origins);
  expect_shape("log_priors", log_priors, {n, inputs.exchanges()});
  expect_shape("result", result, {n, inputs.exchanges()});
  const KeypointRoom room(inputs);
  for (Index i = 0; i < n; ++i) {
    weigh_exchanges(inputs, log_priors[i], columns[i], origins[i], room, result[i]);
  }
}

// Calls `visit(k, exchanged, landmark)` for all keypoints at one pose, with its most likely
// exchange by the first row of priors.
template <class Visit>
void visit_keypoints(const KeypointInputs& inputs, const Tables& columns, const Table& origins,
                     const KeypointRoom& room, const Visit& visit) {
  weigh_exchanges(inputs, inputs.log_priors[0], columns, origins, room, room.posterior);
  const Places likeliest = inputs.exchanged[place_of_largest(room.posterior)];
  for (Index k = 0; k < inputs.points.size(); ++k) {
    const Index exchanged = likeliest[inputs.points.groups[k]];
    visit(k, exchanged, Landmark(inputs, k, exchanged, columns, origins));
  }
}

// Whitened errors (N, P, 2) of the keypoints at N poses, with the most likely exchange of each
// pose; NaN behind the camera.
inline void keypoint_errors(const KeypointInputs& inputs, const Array<const double, 4>& columns,
                            const Tables& origins, const Tensor& errors) {
  inputs.check_frames(columns, origins);
  expect_shape("errors", errors, {columns.size(), inputs.points.size(), 2});
  const KeypointRoom room(inputs);
  for (Index n = 0; n < columns.size(); ++n) {
    visit_keypoints(inputs, columns[n], origins[n], room,
                    [&](Index k, Index, const Landmark& mark) {
                      for (int i = 0; i < 2; ++i)
                        errors(n, k, i) = mark.shown ? mark.errors[i] : nan;
                    });
  }
}

// Lists (N, 1 + 2 P, recorded) the residuals of keypoints at N poses, as `Sums` does; joints (P, 2)
// of the skeleton, without and with exchange, replace the segments.
inline void record_keypoints(const KeypointInputs& inputs, const Array<const Index, 2>& joints,
                             const Array<const double, 4>& columns, const Tables& origins,
                             const Tensor& residuals) {
  const Index points = inputs.points.size();
  inputs.check_frames(columns, origins);
  expect_shape("joints", joints, {points, 2});
  expect_shape("residuals", residuals, {columns.size(), 1 + 2 * points, Sums::recorded});
  const KeypointRoom room(inputs);
  for (Index n = 0; n < columns.size(); ++n) {
    const Sums list{{}, residuals[n]};
    list.list(0, 0) = 0.0;
    visit_keypoints(inputs, columns[n], origins[n], room,
                    [&](Index k, Index exchanged, const Landmark& mark) {
                      if (!mark.shown) return;
                      const double weight = inputs.weights[inputs.points.groups[k]];
                      mark.add(inputs, k, joints(k, exchanged), inputs.factor(k) * weight, list);
                    });
  }
}

// The energy of one pose with log priors (E,) of the exchanges. If derivatives are wanted,
// residuals of keypoints are added to the sums, and those of depths to gradient (d,) and Hessian
// (d, d). Axes and origins (d, 3) belong to the degrees of freedom.
HMT_WIDE inline double add_keypoints(const KeypointInputs& inputs, const Numbers& log_prior,
                                     const Tables& columns, const Table& origins, const Table& axes,
                                     const Table& dof_origins, const Sums& sums,
                                     const Vector& gradient, const Matrix& hessian,
                                     const KeypointRoom& room) {
  const Vector& posterior = room.posterior;
  const double value = weigh_exchanges(inputs, log_prior, columns, origins, room, posterior);
  if (!sums.wanted()) return value;
  double readings[2] = {0.0, 0.0};
  room.shares.fill(0.0);
  for (Index e = 0; e < inputs.exchanges(); ++e) {
    const double probability = elementary::exp(posterior[e]);
    readings[inputs.lifted.readings[e]] += probability;
    for (Index g = 0; g < inputs.groups(); ++g) {
      room.shares(g, inputs.exchanged(e, g)) += probability;
    }
  }
  for (Index k = 0; k < inputs.points.size(); ++k) {
    const Index group = inputs.points.groups[k];
    const double weight = inputs.factor(k) * inputs.weights[group];
    for (int e = 0; e < 2; ++e) {
      const double share = weight * room.shares(group, e);
      if (share < least_share) continue;
      const Landmark mark(inputs, k, e, columns, origins);
      if (mark.shown) mark.add(inputs, k, inputs.points.segments(k, e), share, sums);
    }
  }
  if (inputs.lifted.weight > 0.0) {
    add_lifted(inputs, readings, axes, dof_origins, gradient, hessian, room);
  }
  return value;
}

}  // namespace hmt
