// Soft prior against parts of the body that intersect (KJS 2).
//
//     E(x) = sum_pairs 1/2 ([r_p + r_q - |p - q| - tolerance]+ / sigma)^2
//
// p and q are the nearest points of the axes of two parts, r_p and r_q the extents of the parts
// from p and q along the connecting line; see hmt_ros/body/self_intersection.py.
#pragma once

#include "../kinematics.h"
#include "../residuals.h"

namespace hmt {

// Parts as capsules with elliptic cross-sections.
struct Capsules {
  Places segments;  // (B,) segments that carry the parts
  Table centres;    // (B, 3) centres of the axes in the segments' frames, m
  Numbers halves;   // (B,) half lengths of the axes, m
  Table radii;      // (B, 3) along x, y and, for the caps, z, m
  Numbers reaches;  // (B,) distances from the centre to the farthest point, m

  Index size() const { return segments.size(); }
  void check() const {
    expect_shape("centres", centres, {size(), 3});
    expect_shape("halves", halves, {size()});
    expect_shape("radii", radii, {size(), 3});
    expect_shape("reaches", reaches, {size()});
  }
};

struct Overlaps {
  Capsules parts;
  Places first, second;        // (Q,) the pairs that may overlap
  Mask dof_is_rotation;        // (d,)
  Array<const bool, 2> moves;  // (S, d) whether a degree of freedom moves a segment
  double sigma;                // overlap with energy 1/2, m; inf: no cost
  double tolerance;            // overlap without cost, m

  void check() const {
    expect_range("parts.segments", parts.segments, 0, moves.size());
    expect_range("first", first, 0, parts.size());
    expect_shape("second", second, {first.size()});
    expect_range("second", second, 0, parts.size());
    expect_shape("moves", moves, {-1, dof_is_rotation.size()});
  }
};

// Working space for overlaps, reused for all poses.
struct OverlapRoom {
  explicit OverlapRoom(const Overlaps& overlaps)
      : centres(overlaps.parts.size(), 3), row(overlaps.dof_is_rotation.size()) {}

  Scratch<double, 2> centres;  // (B, 3) middles of the parts, camera frame
  Scratch<double, 1> row;      // (d,)
};

// Fills the middles (B, 3) of the parts in the camera frame.
inline void place_centres(const Capsules& parts, const Tables& columns, const Table& origins,
                          const Matrix& centres) {
  for (Index i = 0; i < parts.size(); ++i) {
    const Index s = parts.segments[i];
    const double *column = columns[s].data, *local = parts.centres[i].data;
    for (int x = 0; x < 3; ++x) {
      double total = 0.0;
      for (int k = 0; k < 3; ++k) total += column[3 * k + x] * local[k];
      centres(i, x) = total + origins(s, x);
    }
  }
}

// Extent of a part from its axis along a unit vector.
inline double width_along(const Capsules& parts, Index i, const Tables& columns, const double* d) {
  const double *column = columns[parts.segments[i]].data, *radii = parts.radii[i].data;
  double total = 0.0;
  for (int k = 0; k < 3; ++k) total += square(dot(column + 3 * k, d) * radii[k]);
  return std::sqrt(total);
}

struct Overlap {
  double p[3], q[3];  // nearest points of the axes
  double d[3];        // direction from q to p
  double depth;       // sum of the extents minus the distance, m
};

// Overlap of two parts. The axes are middle + s axis, s in [-1, 1].
inline Overlap overlap_of(const Capsules& parts, Index i, Index j, const Tables& columns,
                          const Matrix& centres) {
  constexpr double small = 1e-9;
  const double *c = centres[i].data, *e = centres[j].data;
  const double *a = columns[parts.segments[i]].data, *b = columns[parts.segments[j]].data;
  const double h = parts.halves[i], g = parts.halves[j];
  const double u[3] = {a[6] * h, a[7] * h, a[8] * h}, v[3] = {b[6] * g, b[7] * g, b[8] * g};
  const double w[3] = {c[0] - e[0], c[1] - e[1], c[2] - e[2]};
  const double uu = dot(u, u), uv = dot(u, v), vv = dot(v, v), uw = dot(u, w), vw = dot(v, w);
  double s = between((uv * vw - vv * uw) / most(uu * vv - uv * uv, small), -1.0, 1.0);
  const double t = between((uv * s + vw) / most(vv, small), -1.0, 1.0);
  s = between((uv * t - uw) / most(uu, small), -1.0, 1.0);
  Overlap found;
  for (int k = 0; k < 3; ++k) {
    found.p[k] = c[k] + s * u[k];
    found.q[k] = e[k] + t * v[k];
    found.d[k] = found.p[k] - found.q[k];
  }
  const double distance = std::sqrt(dot(found.d, found.d)), away = most(distance, small);
  for (int k = 0; k < 3; ++k) found.d[k] /= away;
  const double reach =
      width_along(parts, i, columns, found.d) + width_along(parts, j, columns, found.d);
  found.depth = reach - distance;
  return found;
}

// Whether two parts are too far from each other to overlap by more than the tolerance.
inline bool far_apart(const Overlaps& overlaps, Index i, Index j, const Matrix& centres) {
  const double *a = centres[i].data, *b = centres[j].data;
  const double away[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
  const Numbers& reaches = overlaps.parts.reaches;
  return dot(away, away) > square(reaches[i] + reaches[j] - overlaps.tolerance);
}

// Fills the derivative (d,) of the overlap of parts on two segments, without its sign, over sigma.
inline void derive_overlap(const Overlaps& overlaps, const Overlap& found, Index first,
                           Index second, const Table& axes, const Table& dof_origins,
                           const Vector& row) {
  const bool *moves_first = overlaps.moves[first].data, *moves_second = overlaps.moves[second].data;
  const double* d = found.d;
  for (Index k = 0; k < row.size(); ++k) {
    const double *x = axes[k].data, *o = dof_origins[k].data;
    double moved = 0.0;
    if (!overlaps.dof_is_rotation[k]) {
      const double along = dot(x, d);
      if (moves_first[k]) moved += along;
      if (moves_second[k]) moved -= along;
    } else {
      // direction . (axis x arm) = axis . (arm x direction)
      if (moves_first[k]) {
        const double arm[3] = {found.p[0] - o[0], found.p[1] - o[1], found.p[2] - o[2]};
        const auto turned = cross(arm, d);
        moved += x[0] * turned[0] + x[1] * turned[1];
        moved += x[2] * turned[2];
      }
      if (moves_second[k]) {
        const double arm[3] = {found.q[0] - o[0], found.q[1] - o[1], found.q[2] - o[2]};
        const auto turned = cross(arm, d);
        moved -= x[0] * turned[0] + x[1] * turned[1];
        moved -= x[2] * turned[2];
      }
    }
    row[k] = -moved / overlaps.sigma;
  }
}

// Adds the energy of one pose and, if wanted, its gradient (d,) and Gauss-Newton Hessian (d, d).
// The derivatives neglect rotations of elliptic cross-sections.
HMT_WIDE inline void add_overlaps(const Overlaps& overlaps, const Tables& columns,
                                  const Table& origins, const Table& axes, const Table& dof_origins,
                                  bool wanted, double& value, const Vector& gradient,
                                  const Matrix& hessian, const OverlapRoom& room) {
  const Capsules& parts = overlaps.parts;
  place_centres(parts, columns, origins, room.centres);
  for (Index pair = 0; pair < overlaps.first.size(); ++pair) {
    const Index i = overlaps.first[pair], j = overlaps.second[pair];
    if (far_apart(overlaps, i, j, room.centres)) continue;
    const Overlap found = overlap_of(parts, i, j, columns, room.centres);
    const double overlap = (found.depth - overlaps.tolerance) / overlaps.sigma;
    if (overlap <= 0.0) continue;
    value += 0.5 * overlap * overlap;
    if (!wanted) continue;
    derive_overlap(overlaps, found, parts.segments[i], parts.segments[j], axes, dof_origins,
                   room.row);
    add_row(room.row, overlap, 1.0, gradient, hessian);
  }
}

// For Python: `add_overlaps` of one pose; value (1,) is added to.
void add_overlaps_of_pose(const Overlaps& overlaps, const Tables& columns, const Table& origins,
                          const Table& axes, const Table& dof_origins, bool wanted,
                          const Vector& value, const Vector& gradient, const Matrix& hessian);

// Fills the depths (Q,) of pairs of parts of a pose, m; negative: they are apart.
inline void overlap_depths(const Capsules& parts, const Places& first, const Places& second,
                           const Tables& columns, const Table& origins, const Vector& depths) {
  expect_range("parts.segments", parts.segments, 0, columns.size());
  expect_shape("columns", columns, {-1, 3, 3});
  expect_shape("origins", origins, {columns.size(), 3});
  expect_range("first", first, 0, parts.size());
  expect_shape("second", second, {first.size()});
  expect_range("second", second, 0, parts.size());
  expect_shape("depths", depths, {first.size()});
  const Scratch<double, 2> centres(parts.size(), 3);
  place_centres(parts, columns, origins, centres);
  for (Index pair = 0; pair < first.size(); ++pair) {
    depths[pair] = overlap_of(parts, first[pair], second[pair], columns, centres).depth;
  }
}

}  // namespace hmt
