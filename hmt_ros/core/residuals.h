// Robust residuals at points of the body, and their gradient and Hessian over the pose.
//
//     rho(r) = 1/2 w r^2 / (1 + r^2 / c^2)                                   Geman-McClure (KJS 2)
//
// A residual at the point p of a segment has a derivative a with respect to the point. A small
// motion of the segment is a twist (v, w) that moves p by v + w x p, so the residual adds g b and
// k b b^T to its segment, b = (a, p x a), g the derivative and k the curvature of rho. Sums over
// the segments that a degree of freedom moves give its row of the gradient and of the Hessian.
#pragma once

#include "arrays.h"

namespace hmt {

// The skeleton: S segments, d degrees of freedom.
struct Tree {
  Places parents;       // (S,) segment above; -1: none
  Places dof_segments;  // (d,) segment of each degree of freedom
  Places dof_parents;   // (d,) the one before it on the path from the root; -1: none
  Mask dof_is_rotation;

  Index segments() const { return parents.size(); }
  Index dimension() const { return dof_segments.size(); }
  void check() const {
    const Index s = segments(), d = dimension();
    expect_range("parents", parents, -1, s);
    for (Index i = 0; i < s; ++i) expect(parents[i] < i, "parents", "parents before children");
    expect_range("dof_segments", dof_segments, 0, s);
    expect_shape("dof_parents", dof_parents, {d});
    expect_range("dof_parents", dof_parents, -1, d);
    for (Index i = 0; i < d; ++i) {
      expect(dof_parents[i] < i, "dof_parents", "degrees of freedom in their order");
    }
    expect_shape("dof_is_rotation", dof_is_rotation, {d});
  }
};

struct Robust {
  double value, pull, curvature;
};

// Geman-McClure kernel: value, derivative, and the curvature rho'(r) / r of iteratively reweighted
// least squares. Quadratic near zero, at most w c^2 / 2.
inline Robust geman_mcclure(double residual, double scale, double weight) {
  const double squared = residual * residual;
  const double shrink = 1.0 / (1.0 + squared / (scale * scale));
  const double curvature = weight * shrink * shrink;
  return {0.5 * weight * squared * shrink, curvature * residual, curvature};
}

// Adds g J to the gradient (d,) and k J J^T to the Hessian (d, d) for the derivative J (d,) of a
// residual over the pose.
inline void add_row(const Vector& row, double pull, double curvature, const Vector& gradient,
                    const Matrix& hessian) {
  const double* slopes = row.data;
  const Index d = row.size();
  for (Index i = 0; i < d; ++i) {
    if (slopes[i] == 0.0) continue;
    gradient[i] += pull * slopes[i];
    const double scaled = curvature * slopes[i];
    double* curve = hessian[i].data;
    for (Index j = 0; j < d; ++j) curve[j] += scaled * slopes[j];
  }
}

// Sums of the residuals of one pose by segment, or a list of them; nothing: no derivatives.
struct Sums {
  // Columns of a list: segment, point (3), derivative (3), pull, curvature.
  static constexpr int recorded = 9;

  Matrix wrenches;     // (S, 6) sums of g b
  Tensor stiffnesses;  // (S, 6, 6) sums of k b b^T, upper triangle
  Matrix list;         // (1 + M, recorded); entry (0, 0) counts them

  bool wanted() const { return wrenches.data != nullptr || list.data != nullptr; }
  // Adds a residual at the point p (3,) with derivative a (3,) to segment s.
  void add(Index s, const double* p, double a0, double a1, double a2, double pull,
           double curvature) const {
    if (list.data) {
      const Index n = static_cast<Index>(list(0, 0)) + 1;
      if (n < list.size()) {
        list(0, 0) = static_cast<double>(n);
        const double row[recorded] = {double(s), p[0], p[1], p[2], a0, a1, a2, pull, curvature};
        std::copy(row, row + recorded, list[n].data);
      }
      return;
    }
    if (!wrenches.data) return;
    const double b[6] = {
        a0, a1, a2, p[1] * a2 - p[2] * a1, p[2] * a0 - p[0] * a2, p[0] * a1 - p[1] * a0};
    double* wrench = wrenches.data + 6 * s;
    double* stiffness = stiffnesses.data + 36 * s;
    for (int i = 0; i < 6; ++i) {
      wrench[i] += pull * b[i];
      const double c = curvature * b[i];
      for (int j = i; j < 6; ++j) stiffness[6 * i + j] += c * b[j];
    }
  }
};

// Adds the gradient (d,) and the Hessian (d, d) of one pose; overwrites the sums of the segments.
// Axes and origins (d, 3) are those of the degrees of freedom, camera frame.
inline void assemble_pose(const Tree& tree, const Table& axes, const Table& dof_origins,
                          const Matrix& wrenches, const Tensor& stiffnesses, const Vector& gradient,
                          const Matrix& hessian) {
  const Index count = tree.segments(), d = tree.dimension();
  for (Index s = count - 1; s > 0; --s) {
    const Index parent = tree.parents[s];
    if (parent < 0) continue;
    for (int i = 0; i < 6; ++i) {
      wrenches(parent, i) += wrenches(s, i);
      for (int j = i; j < 6; ++j) stiffnesses(parent, i, j) += stiffnesses(s, i, j);
    }
  }
  for (Index s = 0; s < count; ++s) {
    for (int i = 0; i < 6; ++i) {
      for (int j = 0; j < i; ++j) stiffnesses(s, i, j) = stiffnesses(s, j, i);
    }
  }
  Scratch<double, 2> twists(d, 6);
  for (Index j = 0; j < d; ++j) {
    double* twist = twists[j].data;
    if (tree.dof_is_rotation[j]) {
      const double *o = dof_origins[j].data, *w = axes[j].data;
      twist[0] = o[1] * w[2] - o[2] * w[1];
      twist[1] = o[2] * w[0] - o[0] * w[2];
      twist[2] = o[0] * w[1] - o[1] * w[0];
      for (int i = 0; i < 3; ++i) twist[3 + i] = w[i];
    } else {
      for (int i = 0; i < 3; ++i) twist[i] = axes(j, i);
    }
  }
  for (Index j = 0; j < d; ++j) {
    const Index s = tree.dof_segments[j];
    const double* twist = twists[j].data;
    double pushed[6];
    for (int i = 0; i < 6; ++i) {
      double total = 0.0;
      for (int k = 0; k < 6; ++k) total += stiffnesses(s, i, k) * twist[k];
      pushed[i] = total;
      gradient[j] += wrenches(s, i) * twist[i];
    }
    for (Index i = j; i >= 0; i = tree.dof_parents[i]) {
      double total = 0.0;
      for (int k = 0; k < 6; ++k) total += twists(i, k) * pushed[k];
      hessian(i, j) += total;
      if (i != j) hessian(j, i) += total;
    }
  }
}

}  // namespace hmt
