// Frames of the segments of poses; see hmt_ros/body/kinematics.py.
#pragma once

#include "arrays.h"

namespace hmt {

// The skeleton: S segments, d degrees of freedom.
struct Placing {
  Places parents;     // (S,) segment above; -1: none
  Places first_dofs;  // (S + 1,) the degrees of freedom of segment s start here
  Places dof_axes;    // (d,) 0, 1 or 2
  Mask dof_is_rotation;
  Tables mounts;  // (S, 3, 3) of the segments on their parents
  Table offsets;  // (S, 3)

  Index segments() const { return parents.size(); }
  Index dimension() const { return dof_axes.size(); }
  void check() const {
    const Index s = segments(), d = dimension();
    expect_range("parents", parents, -1, s);
    for (Index i = 0; i < s; ++i) expect(parents[i] < i, "parents", "parents before children");
    expect_shape("first_dofs", first_dofs, {s + 1});
    expect_range("first_dofs", first_dofs, 0, d + 1);
    expect_range("dof_axes", dof_axes, 0, 3);
    expect_shape("dof_is_rotation", dof_is_rotation, {d});
    expect_shape("mounts", mounts, {s, 3, 3});
    expect_shape("offsets", offsets, {s, 3});
  }
};

// Frames of one pose: columns(s, i) is axis i of segment s, origins(s) its origin.
struct Frames {
  Tensor columns;  // (S, 3, 3)
  Matrix origins;  // (S, 3)
};

// What a term reads of one pose: frames of the segments, and the axes of the degrees of freedom.
inline void expect_frames(Index segments, Index d, const Tables& columns, const Table& origins,
                          const Table& axes, const Table& dof_origins) {
  expect_shape("columns", columns, {segments, 3, 3});
  expect_shape("origins", origins, {segments, 3});
  expect_shape("axes", axes, {d, 3});
  expect_shape("dof_origins", dof_origins, {d, 3});
}

// Fills the frame of segment s of a pose (d,) whose parent is placed; see `place_pose`.
inline void place_segment(const Placing& tree, Index s, const Numbers& pose, const Tensor& columns,
                          const Matrix& origins, const Matrix& axes, const Matrix& dof_origins) {
  const Index parent = tree.parents[s];
  for (int k = 0; k < 3; ++k) origins(s, k) = tree.offsets(s, k);
  if (parent >= 0) {
    for (int k = 0; k < 3; ++k) {
      origins(s, k) = origins(parent, k);
      for (int i = 0; i < 3; ++i) origins(s, k) += tree.offsets(s, i) * columns(parent, i, k);
    }
  }
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k) {
      if (parent >= 0) {
        double total = 0.0;
        for (int j = 0; j < 3; ++j) total += tree.mounts(s, j, i) * columns(parent, j, k);
        columns(s, i, k) = total;
      } else {
        columns(s, i, k) = tree.mounts(s, k, i);
      }
    }
  }
  for (Index d = tree.first_dofs[s]; d < tree.first_dofs[s + 1]; ++d) {
    const Index axis = tree.dof_axes[d];
    const double value = pose[d];
    if (tree.dof_is_rotation[d]) {
      const double cosine = std::cos(value), sine = std::sin(value);
      const Index i = (axis + 1) % 3, j = (axis + 2) % 3;
      for (int k = 0; k < 3; ++k) {
        axes(d, k) = columns(s, axis, k);
        dof_origins(d, k) = origins(s, k);
        const double a = columns(s, i, k), b = columns(s, j, k);
        columns(s, i, k) = cosine * a + sine * b;
        columns(s, j, k) = cosine * b - sine * a;
      }
    } else {
      for (int k = 0; k < 3; ++k) {
        double along = k == axis ? 1.0 : 0.0;
        if (parent >= 0) along = columns(parent, axis, k);
        axes(d, k) = along;
        origins(s, k) += along * value;
      }
    }
  }
}

// Fills the frames of one pose (d,): columns (S, 3, 3), origins (S, 3), and for each degree of
// freedom its unit vector and a point on the axis of a rotation (d, 3), which translations leave.
inline void place_pose(const Placing& tree, const Numbers& pose, const Tensor& columns,
                       const Matrix& origins, const Matrix& axes, const Matrix& dof_origins) {
  for (Index s = 0; s < tree.segments(); ++s) {
    place_segment(tree, s, pose, columns, origins, axes, dof_origins);
  }
}

// Fills the frames of N poses (N, d), pose by pose.
inline void place_poses(const Placing& tree, const Table& poses, const Array<double, 4>& columns,
                        const Tensor& origins, const Tensor& axes, const Tensor& dof_origins) {
  const Index n = poses.size(), s = tree.segments(), d = tree.dimension();
  expect_shape("poses", poses, {n, d});
  expect_shape("columns", columns, {n, s, 3, 3});
  expect_shape("origins", origins, {n, s, 3});
  expect_shape("axes", axes, {n, d, 3});
  expect_shape("dof_origins", dof_origins, {n, d, 3});
  for (Index i = 0; i < n; ++i) {
    place_pose(tree, poses[i], columns[i], origins[i], axes[i], dof_origins[i]);
  }
}

// Fills the joints (N, J, 3) of poses (N, d); they are given by segments (J,) and by places there
// (J, 3).
inline void place_joints(const Placing& tree, const Table& poses, const Places& joint_segments,
                         const Table& joint_offsets, const Tensor& joints) {
  const Index n = poses.size(), s = tree.segments(), d = tree.dimension();
  const Index count = joint_segments.size();
  expect_shape("poses", poses, {n, d});
  expect_range("joint_segments", joint_segments, 0, s);
  expect_shape("joint_offsets", joint_offsets, {count, 3});
  expect_shape("joints", joints, {n, count, 3});
  const Scratch<double, 3> columns(s, 3, 3);
  const Scratch<double, 2> origins(s, 3), axes(d, 3), dof_origins(d, 3);
  for (Index i = 0; i < n; ++i) {
    place_pose(tree, poses[i], columns, origins, axes, dof_origins);
    for (Index j = 0; j < count; ++j) {
      const double* column = columns[joint_segments[j]].data;
      const double *origin = origins[joint_segments[j]].data, *offset = joint_offsets[j].data;
      for (int x = 0; x < 3; ++x) {
        joints(i, j, x) = column[x] * offset[0] + column[3 + x] * offset[1] +
                          column[6 + x] * offset[2] + origin[x];
      }
    }
  }
}

// Fills a . dp / dx (M, d) for points p and directions a (M, 3) on segments (M,) of one pose; zero
// where a degree of freedom does not move the point.
inline void derive_along(const Array<const bool, 2>& moves, const Mask& is_rotation,
                         const Table& axes, const Table& dof_origins, const Places& segments,
                         const Table& points, const Table& directions, const Matrix& result) {
  const Index count = segments.size(), d = is_rotation.size();
  expect_shape("moves", moves, {-1, d});
  expect_shape("axes", axes, {d, 3});
  expect_shape("dof_origins", dof_origins, {d, 3});
  expect_range("segments", segments, 0, moves.size());
  expect_shape("points", points, {count, 3});
  expect_shape("directions", directions, {count, 3});
  expect_shape("result", result, {count, d});
  for (Index m = 0; m < count; ++m) {
    const bool* moved = moves[segments[m]].data;
    const double *p = points[m].data, *a = directions[m].data;
    for (Index j = 0; j < d; ++j) {
      const double *axis = axes[j].data, *o = dof_origins[j].data;
      if (!moved[j]) {
        result(m, j) = 0.0;
      } else if (is_rotation[j]) {
        // a . (axis x arm) = axis . (arm x a)
        const double r[3] = {p[0] - o[0], p[1] - o[1], p[2] - o[2]};
        result(m, j) = dot(axis, cross(r, a).data());
      } else {
        result(m, j) = dot(axis, a);
      }
    }
  }
}

// Fills the derivatives (S, 3, L, N) of the origins by the lengths: of those on the segments, the
// basis (S, 3, L), and of the parents. Columns are (S, 3, 3, N).
inline void lift_origins(const Places& parents, const Tables& basis,
                         const Array<const double, 4>& columns, const Array<double, 4>& result) {
  const Index count = parents.size(), lengths = basis.size(2), poses = columns.size(3);
  expect_range("parents", parents, -1, count);
  expect_shape("basis", basis, {count, 3, lengths});
  expect_shape("columns", columns, {count, 3, 3, poses});
  expect_shape("result", result, {count, 3, lengths, poses});
  for (Index s = 0; s < count; ++s) {
    const Index parent = parents[s];
    expect(parent < s, "parents", "parents before children");
    for (int x = 0; x < 3; ++x) {
      for (Index k = 0; k < lengths; ++k) {
        double* lift = result[s][x][k].data;
        if (parent < 0) {
          std::fill(lift, lift + poses, basis(s, x, k));
          continue;
        }
        const double* above = result[parent][x][k].data;
        const double *first = columns[parent][0][x].data, *second = columns[parent][1][x].data;
        const double* third = columns[parent][2][x].data;
        const double a = basis(s, 0, k), b = basis(s, 1, k), c = basis(s, 2, k);
        for (Index n = 0; n < poses; ++n) {
          lift[n] = above[n] + first[n] * a + second[n] * b + third[n] * c;
        }
      }
    }
  }
}

}  // namespace hmt
