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

// Components whose log density is this far below the largest are left out: less than rounding.
inline constexpr double negligible = 40.0;
// Responsibility below which a component adds nothing to the derivatives.
inline constexpr double faint = 1e-12;

// C components over n angles; rows have m >= n numbers, whole lanes, which are 0 beyond n.
struct PriorModel {
  Tables whitening;   // (C, n, m) inverse Cholesky factors W of the covariances, lower triangular
  Tables columns;     // (C, n, m) the transposed W
  Table centres;      // (C, n) W m
  Numbers constants;  // (C,) log of weight times normalisation, minus highest log density
  Tables precisions;  // (C, n, n)
  Places places;      // (n,) degrees of freedom that the mixture covers
  Numbers means;      // (d,)
  Numbers rest;       // (d,) precisions of degrees of freedom missing in the mixture
  double weight;      // factor on the energy

  Index components() const { return centres.size(); }
  Index angles() const { return places.size(); }
  Index width() const { return whitening.size(2); }
  Index dimension() const { return means.size(); }
  void check() const {
    const Index c = components(), n = angles();
    expect_shape("whitening", whitening, {c, n, in_whole_lanes(n)});
    expect_shape("columns", columns, {c, n, in_whole_lanes(n)});
    expect_shape("centres", centres, {c, n});
    expect_shape("constants", constants, {c});
    expect_shape("precisions", precisions, {c, n, n});
    expect_range("places", places, 0, dimension());
    expect_shape("rest", rest, {dimension()});
  }
};

// Working space, reused for all poses.
struct PriorRoom {
  explicit PriorRoom(const PriorModel& model)
      : angles(model.angles()),
        whitened(model.components(), model.angles()),
        log(model.components()),
        pull(model.width()),
        pulls(model.angles()),
        curvature(model.angles(), model.angles()) {
    for (Index i = 0; i < model.angles(); ++i) {
      const Index place = model.places[i];
      if (i == 0 || place != model.places[i - 1] + 1) runs.push_back({i, place, 0});
      ++runs.back().length;
    }
  }

  // Consecutive angles with consecutive degrees of freedom.
  struct Run {
    Index first, place, length;
  };
  std::vector<Run> runs;

  Scratch<double, 1> angles;
  Scratch<double, 2> whitened;  // W (a - m)
  Scratch<double, 1> log;       // densities of the components, then relative to the largest
  Scratch<double, 1> pull, pulls;
  Scratch<double, 2> curvature;
};

// Sets sums of one group of lanes over rows `first` to `end` - 1 of a table, weighted by factors.
HMT_INLINE void add_rows(const double* table, Index width, const double* factors, Index first,
                         Index end, double* sums) {
  Group<double> low{}, high{};
  for (Index i = first; i < end; ++i) {
    const auto* row = reinterpret_cast<const Group<double>*>(table + i * width);
    low += row[0] * factors[i];
    high += row[1] * factors[i];
  }
  auto* result = reinterpret_cast<Group<double>*>(sums);
  result[0] = low;
  result[1] = high;
}

// The log density of component c at the angles in the room, or -inf if far below the best so far.
inline double component_log_density(const PriorModel& model, Index c, double best,
                                    const PriorRoom& room) {
  const Index n = model.angles();
  const double limit = 2.0 * (model.constants[c] - best + negligible);
  const double *centre = model.centres[c].data, *angles = room.angles.view().data;
  double* z = room.whitened[c].data;
  double distance = 0.0;
  for (Index first = 0; first < n; first += lanes) {
    const Index end = std::min(first + lanes, n);
    double sums[lanes];
    add_rows(model.columns[c].data + first, model.width(), angles, 0, end, sums);
    for (Index i = first; i < end; ++i) {
      z[i] = sums[i - first] - centre[i];
      distance += z[i] * z[i];
      if (distance > limit) return -infinity;  // the distance only grows
    }
  }
  return model.constants[c] - 0.5 * distance;
}

// Adds a share of the derivatives of component c to `pulls` and `curvature` of the room.
inline void add_component(const PriorModel& model, Index c, double share, bool exact,
                          const PriorRoom& room) {
  const Index n = model.angles();
  double *pull = room.pull.view().data, *pulls = room.pulls.view().data;
  const double *precision = model.precisions[c].data, *z = room.whitened[c].data;
  for (Index j = 0; j < n; j += lanes) {  // 0 above the diagonal
    add_rows(model.whitening[c].data + j, model.width(), z, j, n, pull + j);
  }
  double* curve = room.curvature.view().data;
  add_scaled(share, pull, pulls, n);
  add_scaled(share, precision, curve, n * n);
  if (!exact) return;
  for (Index i = 0; i < n; ++i, curve += n) {
    for (Index j = 0; j < n; ++j) curve[j] -= share * pull[i] * pull[j];
  }
}

// The energy of a pose (d,); gradient (d,) and Hessian (d, d) become its derivatives if wanted.
// `exact`: the exact Hessian instead of the positive definite one.
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
    for (const auto& run : room.runs) {
      const double* curve = room.curvature[i].data + run.first;
      for (Index j = 0; j < run.length; ++j) row[run.place + j] = weight * curve[j];
    }
    for (Index j = 0; j < n && exact; ++j) {
      row[model.places[j]] += weight * room.pulls[i] * room.pulls[j];
    }
  }
  return weight * energy;
}

// Energies (N,) of poses (N, d), and their gradients (N, d) and positive definite Hessians
// (N, d, d).
void evaluate_prior_at(const PriorModel& model, const Table& poses, const Vector& value,
                       const Matrix& gradient, const Tensor& hessian);

}  // namespace hmt
