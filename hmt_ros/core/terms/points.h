// Energies of points of the body with observed or known positions.
#pragma once

#include "../kinematics.h"
#include "../residuals.h"

namespace hmt {

// Fills the energies (N,) 1/2 sum |A (p - t)|^2 of points p at local positions (P, 3) on segments
// (P,), for targets t (N, P, 3) and A of R rows (N, P, R, 3), their gradients (N, d) and
// Gauss-Newton Hessians (N, d, d).
inline void evaluate_points(const Tree& tree, const Array<const double, 4>& columns,
                            const Tables& origins, const Tables& axes, const Tables& dof_origins,
                            const Places& segments, const Table& local, const Tables& targets,
                            const Array<const double, 4>& across, const Vector& value,
                            const Matrix& gradient, const Tensor& hessian) {
  const Index n = value.size(), s = tree.segments(), d = tree.dimension(), count = segments.size(),
              residuals = across.size(2);
  expect_shape("columns", columns, {n, s, 3, 3});
  expect_shape("origins", origins, {n, s, 3});
  expect_shape("axes", axes, {n, d, 3});
  expect_shape("dof_origins", dof_origins, {n, d, 3});
  expect_range("segments", segments, 0, s);
  expect_shape("local", local, {count, 3});
  expect_shape("targets", targets, {n, count, 3});
  expect_shape("across", across, {n, count, residuals, 3});
  expect_shape("gradient", gradient, {n, d});
  expect_shape("hessian", hessian, {n, d, d});
  gradient.fill(0.0);
  hessian.fill(0.0);
  Scratch<SegmentSums, 1> room(s);
  const Sums sums{room.view(), {}};
  for (Index i = 0; i < n; ++i) {
    sums.clear();
    value[i] = 0.0;
    for (Index k = 0; k < count; ++k) {
      const double *target = targets[i][k].data, *row = across[i][k].data;
      double place[3];
      place_point(columns[i], origins[i], segments[k], local[k].data, place);
      const double off[3] = {place[0] - target[0], place[1] - target[1], place[2] - target[2]};
      for (Index r = 0; r < residuals; ++r, row += 3) {
        const double residual = dot(row, off);
        value[i] += 0.5 * residual * residual;
        sums.add(segments[k], place, row[0], row[1], row[2], residual, 1.0);
      }
    }
    assemble_pose(tree, axes[i], dof_origins[i], sums.segments, gradient[i], hessian[i]);
  }
}

}  // namespace hmt
