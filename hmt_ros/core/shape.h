// Sums over residuals of derivatives by the shape of a person and by the pose; see
// hmt_ros/body/shape.py.
//
// A residual on the flesh has the derivative a by its point, r = B' f by the shape, and q = T' b by
// the pose. Here f = (R' a, u R' a, a) (9,), and B (9, P) are the derivatives of centre, radii and
// origin, which are the same for all points of a segment; b = (a, p x a), and T (6, d) are twists.
// So sums of f f' and f b' over the residuals of a segment suffice.
#pragma once

#include "kinematics.h"
#include "residuals.h"

namespace hmt {

// The shape: S segments, B parts, J joints, P variables, of which L lengths come first.
struct ShapeTable {
  Places part_of;                   // (S,) part on each segment; -1: none
  Table centres, radii;             // (B, 3)
  Tables by_centre, by_radius;      // (B, 3, P) derivatives of these by the variables
  Tables joint_basis;               // (J, 3, L)
  Array<const Index, 2> variables;  // (S, V) variables that move the flesh of a segment
  Places counts;                    // (S,) number of these variables

  Index segments() const { return part_of.size(); }
  Index lengths() const { return joint_basis.size(2); }
  Index size() const { return by_centre.size(2); }
  void check() const {
    const Index parts = centres.size();
    expect_range("part_of", part_of, -1, parts);
    expect_shape("centres", centres, {parts, 3});
    expect_shape("radii", radii, {parts, 3});
    expect_shape("by_centre", by_centre, {parts, 3, -1});
    expect_shape("by_radius", by_radius, {parts, 3, size()});
    expect_shape("joint_basis", joint_basis, {-1, 3, -1});
    expect(lengths() <= size(), "joint_basis", "no more lengths than variables");
    expect_shape("variables", variables, {segments(), -1});
    expect_range("variables", variables, 0, size());
    expect_shape("counts", counts, {segments()});
    expect_range("counts", counts, 0, variables.size(1) + 1);
  }
};

// Checks lists of residuals (N, 1 + M, recorded): the counts of rows, and indices below `places`.
inline void expect_residuals(const char* name, const Tables& lists, Index poses, Index places) {
  expect_shape(name, lists, {poses, -1, Sums::recorded});
  for (Index n = 0; n < poses; ++n) {
    expect(lists.size(1) > 0 && lists(n, 0, 0) >= 0.0 &&
               lists(n, 0, 0) < static_cast<double>(lists.size(1)),
           name, "the number of its rows first");
    for (Index m = 1; m < 1 + static_cast<Index>(lists(n, 0, 0)); ++m) {
      expect(lists(n, m, 0) >= 0.0 && lists(n, m, 0) < static_cast<double>(places), name,
             "segments or joints of the body");
    }
  }
}

// (a, p x a).
inline std::array<double, 6> wrench_of(const double* p, const double* a) {
  const auto turned = cross(p, a);
  return {a[0], a[1], a[2], turned[0], turned[1], turned[2]};
}

// The sums of one pose, reused for all poses.
class ShapeSums {
 public:
  explicit ShapeSums(const ShapeTable& table)
      : table_(table),
        pulls_(table.segments(), 9),
        squares_(table.segments(), 9, 9),
        products_(table.segments(), 9, 6),
        carried_(table.segments(), table.size(), 6),
        rates_(9, table.variables.size(1)),
        totals_(table.variables.size(1)),
        row_(table.lengths()),
        seen_(table.segments()) {}

  void clear() {
    pulls_.fill(0.0);
    squares_.fill(0.0);
    products_.fill(0.0);
    carried_.fill(0.0);
    seen_.fill(false);
  }

  // Sums up a list (1 + M, recorded) of residuals on the flesh, by segment.
  void add_flesh(const Table& list, const Tables& columns, const Table& origins) {
    for (Index m = 1; m < 1 + static_cast<Index>(list(0, 0)); ++m) {
      const double* entry = list[m].data;
      const Index s = static_cast<Index>(entry[0]), part = table_.part_of[s];
      if (part < 0) continue;
      seen_[s] = true;
      const double *point = entry + 1, *a = entry + 4, pull = entry[7], c = entry[8];
      const double *column = columns[s].data, *origin = origins[s].data;
      double f[9];
      for (int i = 0; i < 3; ++i) {
        double turned = 0.0, local = 0.0;
        for (int k = 0; k < 3; ++k) {
          turned += column[3 * i + k] * a[k];
          local += column[3 * i + k] * (point[k] - origin[k]);
        }
        f[i] = turned;
        f[3 + i] = turned * (local - table_.centres(part, i)) / table_.radii(part, i);
        f[6 + i] = a[i];
      }
      const auto b = wrench_of(point, a);
      for (int i = 0; i < 9; ++i) {
        const double scaled = c * f[i];
        double *squares = squares_[s][i].data, *products = products_[s][i].data;
        pulls_(s, i) += pull * f[i];
        for (int k = 0; k < 9; ++k) squares[k] += scaled * f[k];
        for (int k = 0; k < 6; ++k) products[k] += scaled * b[k];
      }
    }
  }

  // Converts the sums of the flesh to derivatives by the shape: adds to the gradient (P,) and to
  // the curvature (P, P). The lift (S, 3, L) is the derivative of the origins by the lengths.
  void spread_flesh(const Tables& lift, const Vector& gradient, const Matrix& curvature) {
    for (Index s = 0; s < table_.segments(); ++s) {
      if (seen_[s]) spread_segment(s, lift, gradient, curvature);
    }
  }

  // Adds a list (1 + M, recorded) of residuals at joints, which only the lengths (L,) move.
  void add_joints(const Table& list, const Tables& columns, const Places& joint_segments,
                  const Tables& lift, const Vector& gradient, const Matrix& curvature) {
    const Index lengths = table_.lengths();
    double* row = row_.view().data;
    for (Index m = 1; m < 1 + static_cast<Index>(list(0, 0)); ++m) {
      const double* entry = list[m].data;
      const Index joint = static_cast<Index>(entry[0]), s = joint_segments[joint];
      const double *point = entry + 1, *a = entry + 4, pull = entry[7], c = entry[8];
      const double* column = columns[s].data;
      const Table basis = table_.joint_basis[joint];
      row_.fill(0.0);
      for (int k = 0; k < 3; ++k) {
        for (Index p = 0; p < lengths; ++p) {
          double rate = lift(s, k, p);
          for (int i = 0; i < 3; ++i) rate += column[3 * i + k] * basis(i, p);
          row[p] += a[k] * rate;
        }
      }
      const auto b = wrench_of(point, a);
      for (Index p = 0; p < lengths; ++p) {
        const double scaled = c * row[p];
        double *own = curvature[p].data, *carried = carried_[s][p].data;
        gradient[p] += pull * row[p];
        for (Index q = 0; q < lengths; ++q) own[q] += scaled * row[q];
        for (int k = 0; k < 6; ++k) carried[k] += scaled * b[k];
      }
    }
  }

  // Sets the second derivatives (P, d) by shape and pose, after all residuals.
  void mix(const Places& parents, const Places& dof_segments, const Mask& is_rotation,
           const Table& axes, const Table& dof_origins, const Matrix& mixed) {
    for (Index s = table_.segments() - 1; s > 0; --s) {
      if (parents[s] < 0) continue;
      const Matrix above = carried_[parents[s]], own = carried_[s];
      for (Index i = 0; i < own.count(); ++i) above.data[i] += own.data[i];
    }
    for (Index j = 0; j < is_rotation.size(); ++j) {
      const double *w = axes[j].data, *carried = carried_[dof_segments[j]].data;
      double twist[6] = {w[0], w[1], w[2], 0.0, 0.0, 0.0};
      if (is_rotation[j]) {  // (o x w, w)
        const auto turned = cross(dof_origins[j].data, w);
        for (int k = 0; k < 3; ++k) {
          twist[k] = turned[k];
          twist[3 + k] = w[k];
        }
      }
      for (Index p = 0; p < table_.size(); ++p) {
        double total = 0.0;
        for (int k = 0; k < 6; ++k) total += carried[6 * p + k] * twist[k];
        mixed(p, j) = total;
      }
    }
  }

 private:
  void spread_segment(Index s, const Tables& lift, const Vector& gradient,
                      const Matrix& curvature) {
    const Index part = table_.part_of[s], lengths = table_.lengths();
    const Index* variables = table_.variables[s].data;
    const double* squares = squares_[s].data;
    double* totals = totals_.view().data;
    for (Index v = 0; v < table_.counts[s]; ++v) {
      const Index p = variables[v];
      for (int i = 0; i < 3; ++i) {
        rates_(i, v) = table_.by_centre(part, i, p);
        rates_(3 + i, v) = table_.by_radius(part, i, p);
        rates_(6 + i, v) = p < lengths ? lift(s, i, p) : 0.0;
      }
      double* carried = carried_[s][p].data;
      std::fill(totals, totals + v + 1, 0.0);
      for (int i = 0; i < 9; ++i) {
        const double *rates = rates_[i].data, *products = products_[s][i].data;
        double pushed = 0.0;
        for (int k = 0; k < 9; ++k) pushed += squares[9 * i + k] * rates_(k, v);
        gradient[p] += pulls_(s, i) * rates[v];
        for (int k = 0; k < 6; ++k) carried[k] += rates[v] * products[k];
        for (Index u = 0; u <= v; ++u) totals[u] += rates[u] * pushed;
      }
      for (Index u = 0; u <= v; ++u) {
        curvature(variables[u], p) += totals[u];
        if (u != v) curvature(p, variables[u]) += totals[u];
      }
    }
  }

  const ShapeTable& table_;
  Scratch<double, 2> pulls_;     // (S, 9) sums of g f
  Scratch<double, 3> squares_;   // (S, 9, 9) of c f f'
  Scratch<double, 3> products_;  // (S, 9, 6) of c f b'
  Scratch<double, 3> carried_;   // (S, P, 6) of c r b'
  Scratch<double, 2> rates_;     // (9, V) B of a segment
  Scratch<double, 1> totals_, row_;
  Scratch<bool, 1> seen_;  // (S,) segments with residuals on their flesh
};

// Adds sum g r (N, P) and sum c r r' (N, P, P) and sets sum c r q' (N, P, d) of residuals on the
// flesh and at joints (N, 1 + M, recorded) of N poses, whose frames are stored pose by pose. The
// lifts (N, S, 3, L) are the derivatives of the origins by the lengths.
inline void sum_shape_residuals(const ShapeTable& table, const Array<const double, 4>& lifts,
                                const Places& parents, const Places& dof_segments,
                                const Mask& is_rotation, const Places& joint_segments,
                                const Array<const double, 4>& columns, const Tables& origins,
                                const Tables& axes, const Tables& dof_origins,
                                const Tables& of_flesh, const Tables& of_joints,
                                const Matrix& gradient, const Tensor& curvature,
                                const Tensor& mixed) {
  const Index n = columns.size(), s = table.segments(), d = is_rotation.size();
  const Index size = table.size();
  expect_shape("lifts", lifts, {n, s, 3, table.lengths()});
  expect_shape("parents", parents, {s});
  expect_range("parents", parents, -1, s);
  expect_shape("dof_segments", dof_segments, {d});
  expect_range("dof_segments", dof_segments, 0, s);
  expect_shape("joint_segments", joint_segments, {table.joint_basis.size()});
  expect_range("joint_segments", joint_segments, 0, s);
  expect_shape("columns", columns, {n, s, 3, 3});
  expect_shape("origins", origins, {n, s, 3});
  expect_shape("axes", axes, {n, d, 3});
  expect_shape("dof_origins", dof_origins, {n, d, 3});
  expect_residuals("of_flesh", of_flesh, n, s);
  expect_residuals("of_joints", of_joints, n, joint_segments.size());
  expect_shape("gradient", gradient, {n, size});
  expect_shape("curvature", curvature, {n, size, size});
  expect_shape("mixed", mixed, {n, size, d});
  ShapeSums sums(table);
  for (Index i = 0; i < n; ++i) {
    sums.clear();
    sums.add_flesh(of_flesh[i], columns[i], origins[i]);
    sums.spread_flesh(lifts[i], gradient[i], curvature[i]);
    sums.add_joints(of_joints[i], columns[i], joint_segments, lifts[i], gradient[i], curvature[i]);
    sums.mix(parents, dof_segments, is_rotation, axes[i], dof_origins[i], mixed[i]);
  }
}

}  // namespace hmt
