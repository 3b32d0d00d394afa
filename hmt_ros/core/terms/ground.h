// Energy of poses against gravity and a floor; see hmt_ros/body/ground_terms.py.
//
//     E(x) = w_u sum_s rho(lean_s) + w_f sum_p rho([-h_p]+ / sigma_f)
//     rho(r) = (nu + k) / 2 log(1 + r^2 / nu),     k the dimension of r
#pragma once

#include "../elementary.h"
#include "../kinematics.h"
#include "../residuals.h"

namespace hmt {

// Inputs that do not depend on the pose.
struct GroundConstants {
  Mask dof_is_rotation;            // (d,)
  Array<const bool, 2> moves;      // (S, d) whether a degree of freedom moves a segment
  Numbers weights;                 // (2,) of the terms: upright, floor; 0: off
  Numbers up;                      // (3,) against gravity
  double height;                   // height of the camera above the floor, m
  Places upright;                  // (U,) segments with a prior of being upright
  Tables axes;                     // (U, 3, 3) axes of these segments: to the side, ahead, up
  Table lean;                      // (U, 3) deviations of gravity along these axes, rad
  Places soles;                    // (P,) segments that carry the sole points
  Table local;                     // (P, 3) local positions of the sole points, m
  double per_floor;                // 1 / deviation of the height of the floor, 1/m
  double lean_tails, floor_tails;  // degrees of freedom nu of rho

  Index dimension() const { return dof_is_rotation.size(); }
  bool on() const { return weights[0] + weights[1] > 0.0; }
  void check() const {
    expect_shape("moves", moves, {-1, dimension()});
    expect_shape("weights", weights, {2});
    expect_shape("up", up, {3});
    expect_range("upright", upright, 0, moves.size());
    expect_shape("axes", axes, {upright.size(), 3, 3});
    expect_shape("lean", lean, {upright.size(), 3});
    expect_range("soles", soles, 0, moves.size());
    expect_shape("local", local, {soles.size(), 3});
  }
};

struct Student {
  double value;
  double factor;  // derivative over r; the curvature in reweighted least squares
};

inline Student student(double squared, double tails, double dimension) {
  return {0.5 * (tails + dimension) * elementary::log1p(squared / tails),
          (tails + dimension) / (tails + squared)};
}

inline double add_upright(const GroundConstants& ground, const Tables& columns, const Table& axes,
                          const Vector& row, bool wanted, const Vector& gradient,
                          const Matrix& hessian) {
  const double weight = ground.weights[0], *up = ground.up.data;
  double total = 0.0;
  for (Index u = 0; u < ground.upright.size(); ++u) {
    const Index s = ground.upright[u];
    const double *own = ground.axes[u].data, *column = columns[s].data, *lean = ground.lean[u].data;
    const bool* moves = ground.moves[s].data;
    double axis[3][3], residual[3], squared = 0.0;
    for (int i = 0; i < 3; ++i) {
      double along = 0.0;
      for (int k = 0; k < 3; ++k) {
        axis[i][k] = 0.0;
        for (int m = 0; m < 3; ++m) axis[i][k] += own[3 * i + m] * column[3 * m + k];
        along += axis[i][k] * up[k];
      }
      residual[i] = (along - (i == 2 ? 1.0 : 0.0)) / lean[i];
      squared += residual[i] * residual[i];
    }
    const auto [value, factor] = student(squared, ground.lean_tails, 2.0);
    total += weight * value;
    if (!wanted) continue;
    for (int i = 0; i < 3; ++i) {
      // An axis e that turns by w moves e . up by w . (e x up).
      const auto turned = cross(axis[i], up);
      for (Index j = 0; j < row.size(); ++j) {
        row[j] = 0.0;
        if (moves[j] && ground.dof_is_rotation[j]) {
          row[j] = dot(axes[j].data, turned.data()) / lean[i];
        }
      }
      const double k = weight * factor;
      add_row(row, k * residual[i], k, gradient, hessian);
    }
  }
  return total;
}

inline double add_floor(const GroundConstants& ground, const Tables& columns, const Table& origins,
                        const Table& axes, const Table& dof_origins, const Vector& row, bool wanted,
                        const Vector& gradient, const Matrix& hessian) {
  const double weight = ground.weights[1], *up = ground.up.data;
  double total = 0.0;
  for (Index p = 0; p < ground.soles.size(); ++p) {
    const Index s = ground.soles[p];
    const double *local = ground.local[p].data, *column = columns[s].data;
    const bool* moves = ground.moves[s].data;
    double place[3];
    for (int k = 0; k < 3; ++k) {
      place[k] = origins(s, k);
      for (int i = 0; i < 3; ++i) place[k] += local[i] * column[3 * i + k];
    }
    const double r =
        (up[0] * place[0] + up[1] * place[1] + up[2] * place[2] + ground.height) * ground.per_floor;
    if (r >= 0.0) continue;
    const auto [value, factor] = student(r * r, ground.floor_tails, 1.0);
    total += weight * value;
    if (!wanted) continue;
    for (Index j = 0; j < row.size(); ++j) {
      const double *axis = axes[j].data, *o = dof_origins[j].data;
      const double arm[3] = {place[0] - o[0], place[1] - o[1], place[2] - o[2]};
      const auto turned = cross(axis, arm);
      const double along = dot(up, ground.dof_is_rotation[j] ? turned.data() : axis);
      row[j] = moves[j] ? ground.per_floor * along : 0.0;
    }
    const double k = weight * factor;
    add_row(row, k * r, k, gradient, hessian);
  }
  return total;
}

// Energy of one pose; adds its gradient (d,) and Hessian (d, d) if wanted.
double add_ground_energy(const GroundConstants& ground, const Tables& columns, const Table& origins,
                         const Table& axes, const Table& dof_origins, bool wanted,
                         const Vector& gradient, const Matrix& hessian);

}  // namespace hmt
