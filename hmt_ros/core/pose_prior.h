// The soft prior of the poses of a body; see hmt_ros/body/pose_prior.py.
//
//     E(x) = max log p - log p(a(x)) + 1/2 sum_j ((x_j - mean_j) / sigma_j)^2
//
// p is a mixture over the angles a of a pose. With the responsibilities r_c of its components,
// their precisions P_c and g_c = P_c (a - m_c):
//
//     dE = sum_c r_c g_c,     H = sum_c r_c P_c,     d2E = H - sum_c r_c g_c g_c' + dE dE'
#pragma once

#include "lanes.h"
#include "log_sum_exp.h"
#include "wide.h"

namespace hmt {

// Components whose density is this much below the largest are left out, nats: below rounding.
inline constexpr double negligible = 40.0;
// Responsibility below which a component adds nothing to the derivatives.
inline constexpr double faint = 1e-12;

// C components over n angles.
struct PriorModel {
  Tables whitening;   // (C, n, n) inverse Cholesky factors W of the covariances, lower triangular
  Table centres;      // (C, n) W m
  Numbers constants;  // (C,) log of the weight times the normalisation, over the highest density
  Tables precisions;  // (C, n, n)
  Places places;      // (n,) degrees of freedom that the mixture covers
  Numbers means;      // (d,)
  Numbers rest;       // (d,) precisions of the degrees of freedom beside the mixture
  double weight;      // factor on the energy

  Index components() const { return centres.size(); }
  Index angles() const { return places.size(); }
  Index dimension() const { return means.size(); }
  void check() const {
    const Index c = components(), n = angles();
    expect_shape("whitening", whitening, {c, n, n});
    expect_shape("centres", centres, {c, n});
    expect_shape("constants", constants, {c});
    expect_shape("precisions", precisions, {c, n, n});
    expect_range("places", places, 0, dimension());
    expect_shape("rest", rest, {dimension()});
  }
};

// Room for one pose after the other.
struct PriorRoom {
  explicit PriorRoom(const PriorModel& model)
      : angles(model.angles()),
        whitened(model.components(), model.angles()),
        log(model.components()),
        pull(model.angles()),
        pulls(model.angles()),
        curvature(model.angles(), model.angles()) {}

  Scratch<double, 1> angles;
  Scratch<double, 2> whitened;  // W (a - m)
  Scratch<double, 1> log;       // densities of the components, then relative to the largest
  Scratch<double, 1> pull, pulls;
  Scratch<double, 2> curvature;
};

// The log density of component c at the angles in the room, or -inf far below the best before.
inline double component_log_density(const PriorModel& model, Index c, double best,
                                    const PriorRoom& room) {
  const Index n = model.angles();
  const double limit = 2.0 * (model.constants[c] - best + negligible);
  const double *row = model.whitening[c].data, *centre = model.centres[c].data;
  const double* angles = room.angles.view().data;
  double* z = room.whitened[c].data;
  double distance = 0.0;
  for (Index i = 0; i < n; ++i, row += n) {
    double s = 0.0;
    for (Index j = 0; j <= i; ++j) s += row[j] * angles[j];
    s -= centre[i];
    z[i] = s;
    distance += s * s;
    if (distance > limit) return -infinity;  // it only grows
  }
  return model.constants[c] - 0.5 * distance;
}

// Adds a share of the derivatives of component c to `pulls` and `curvature` of the room.
inline void add_component(const PriorModel& model, Index c, double share, bool exact,
                          const PriorRoom& room) {
  const Index n = model.angles();
  double *pull = room.pull.view().data, *pulls = room.pulls.view().data;
  const double *w = model.whitening[c].data, *precision = model.precisions[c].data;
  const double* z = room.whitened[c].data;
  room.pull.fill(0.0);
  for (Index i = 0; i < n; ++i, w += n) add_scaled(z[i], w, pull, n);  // 0 above the diagonal
  double* curve = room.curvature.view().data;
  add_scaled(share, pull, pulls, n);
  add_scaled(share, precision, curve, n * n);
  if (!exact) return;
  for (Index i = 0; i < n; ++i, curve += n) {
    for (Index j = 0; j < n; ++j) curve[j] -= share * pull[i] * pull[j];
  }
}

// The energy of a pose (d,); gradient (d,) and Hessian (d, d) become its derivatives, where they
// are wanted. `exact`: the Hessian is the exact one, not the positive definite one.
HMT_WIDE inline double evaluate_prior(const PriorModel& model, const Numbers& pose, bool exact,
                                      bool wanted, const Vector& gradient, const Matrix& hessian,
                                      const PriorRoom& room) {
  const Index count = model.components(), n = model.angles(), d = model.dimension();
  const double weight = model.weight;
  const Vector& log = room.log;
  for (Index i = 0; i < n; ++i) room.angles[i] = pose[model.places[i]];
  double best = -infinity;
  for (Index c = 0; c < count; ++c) {
    log[c] = component_log_density(model, c, best, room);
    best = most(best, log[c]);
  }
  const double total = exponentials(log.data, best, count);
  double energy = -best - elementary::log(total);
  for (Index i = 0; i < d; ++i) {
    const double offset = pose[i] - model.means[i];
    energy += 0.5 * model.rest[i] * offset * offset;
  }
  if (!wanted) return weight * energy;
  room.pulls.fill(0.0);
  room.curvature.fill(0.0);
  for (Index c = 0; c < count; ++c) {
    const double share = log[c] / total;
    if (!(share < faint)) add_component(model, c, share, exact, room);
  }
  hessian.fill(0.0);
  for (Index i = 0; i < d; ++i) {
    gradient[i] = weight * model.rest[i] * (pose[i] - model.means[i]);
    hessian(i, i) = weight * model.rest[i];
  }
  for (Index i = 0; i < n; ++i) {
    gradient[model.places[i]] += weight * room.pulls[i];
    double* row = hessian[model.places[i]].data;
    for (Index j = 0; j < n; ++j) {
      double& entry = row[model.places[j]];
      entry = weight * room.curvature(i, j);
      if (exact) entry += weight * room.pulls[i] * room.pulls[j];
    }
  }
  return weight * energy;
}

// Energies (N,) of poses (N, d), and their gradients (N, d) and positive definite Hessians
// (N, d, d).
void evaluate_prior_at(const PriorModel& model, const Table& poses, const Vector& value,
                       const Matrix& gradient, const Tensor& hessian);

}  // namespace hmt
