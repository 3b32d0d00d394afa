// Robust residuals at points of the body, and their gradient and Hessian over the pose.
//
//     rho(r) = 1/2 w r^2 / (1 + r^2 / c^2)                                   Geman-McClure (KJS 2)
//
// A residual at the point p of a segment has a derivative a with respect to the point. A small
// motion of the segment is a twist (v, w) that moves p by v + w x p, so the residual adds g b and
// k b b^T to its segment, b = (a, p x a), g the derivative and k the curvature of rho. Sums over
// the segments that a degree of freedom moves give its row of the gradient and of the Hessian.
#pragma once

#include "lanes.h"
#include "wide.h"

namespace hmt {

// The skeleton: S segments, d degrees of freedom.
struct Tree {
  Places parents;       // (S,) parent of each segment; -1: none
  Places dof_segments;  // (d,) segment of each degree of freedom
  Places dof_parents;   // (d,) previous one on the path from the root; -1: none
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

// Checks that factors on the energies at segments are finite, one per segment or none.
inline void expect_factors(const char* name, const Numbers& factors, Index segments) {
  if (!factors.empty()) expect_shape(name, factors, {segments});
  for (double x : factors) expect(0.0 <= x && x < infinity, name, "finite factors, none below 0");
}

// The factor of a segment; 1 without factors.
inline double factor_of(const Numbers& factors, Index segment) {
  return factors.empty() ? 1.0 : factors[segment];
}

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

// Sums of one segment: of k b b^T (6, 6), then of g b (6,), in rows of whole lanes.
using SegmentSums = std::array<std::array<double, lanes>, 7>;

// Sums of the residuals of one pose by segment, or a list of the residuals; empty: no derivatives.
struct Sums {
  // Columns of a list: segment, point (3), derivative (3), pull, curvature.
  static constexpr int recorded = 9;

  Array<SegmentSums, 1> segments;  // (S,)
  Matrix list;                     // (1 + M, recorded); entry (0, 0) is the count

  bool wanted() const { return segments.data != nullptr || list.data != nullptr; }
  void clear() const {
    if (segments.data) segments.fill({});
  }
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
    if (!segments.data) return;
    const double b[lanes] = {
        a0, a1, a2, p[1] * a2 - p[2] * a1, p[2] * a0 - p[0] * a2, p[0] * a1 - p[1] * a0};
    SegmentSums& own = segments[s];
    for (int i = 0; i < 6; ++i) add_scaled(curvature * b[i], b, own[i].data(), lanes);
    add_scaled(pull, b, own[6].data(), lanes);
  }
};

// Adds the gradient (d,) and the Hessian (d, d) of one pose; overwrites the sums of the segments.
// Axes and origins (d, 3) are those of the degrees of freedom, camera frame.
HMT_WIDE inline void assemble_pose(const Tree& tree, const Table& axes, const Table& dof_origins,
                                   const Array<SegmentSums, 1>& segments, const Vector& gradient,
                                   const Matrix& hessian) {
  const Index d = tree.dimension();
  for (Index s = tree.segments() - 1; s > 0; --s) {
    if (tree.parents[s] < 0) continue;
    add_scaled(1.0, segments[s][0].data(), segments[tree.parents[s]][0].data(), 7 * lanes);
  }
  Scratch<double, 2> twists(d, lanes);
  for (Index j = 0; j < d; ++j) {
    double* twist = twists[j].data;
    const double *o = dof_origins[j].data, *w = axes[j].data;
    if (tree.dof_is_rotation[j]) {
      twist[0] = o[1] * w[2] - o[2] * w[1];
      twist[1] = o[2] * w[0] - o[0] * w[2];
      twist[2] = o[0] * w[1] - o[1] * w[0];
      for (int i = 0; i < 3; ++i) twist[3 + i] = w[i];
    } else {
      for (int i = 0; i < 3; ++i) twist[i] = w[i];
    }
  }
  const auto product = [](const double* x, const double* y) {
    double terms[lanes];
#pragma omp simd
    for (int k = 0; k < lanes; ++k) terms[k] = x[k] * y[k];
    return sum_lanes(terms);
  };
  for (Index j = 0; j < d; ++j) {
    const SegmentSums& own = segments[tree.dof_segments[j]];
    const double* twist = twists[j].data;
    double pushed[lanes] = {};
    for (int k = 0; k < 6; ++k) add_scaled(twist[k], own[k].data(), pushed, lanes);
    gradient[j] += product(own[6].data(), twist);
    double *row = hessian[j].data, *column = hessian.data + j;
    for (Index i = j; i >= 0; i = tree.dof_parents[i]) {
      const double total = product(twists[i].data, pushed);
      column[i * d] += total;
      if (i != j) row[i] += total;
    }
  }
}

}  // namespace hmt
