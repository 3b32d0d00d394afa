// Frames of the segments of poses; see hmt_ros/body/kinematics.py.
#pragma once

#include "elementary.h"

namespace hmt {

// The skeleton: S segments, d degrees of freedom.
struct Placing {
  Places parents;     // (S,) parent of each segment; -1: none
  Places first_dofs;  // (S + 1,) index of the first degree of freedom of each segment
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

// Results for a pose, or for several side by side in numbers of type T: columns (S, 3, 3) and
// origins (S, 3) of the segments, axes of the degrees of freedom and points on these axes (d, 3).
template <class T>
struct FramesOf {
  T *columns, *origins, *axes, *dof_origins;
};

// Places segment s of a pose (d,) whose parent is placed; see `place_pose`. `turn_of` gives the
// sine and cosine of an angle.
template <class T, class TurnOf>
HMT_INLINE void place_one(const Placing& tree, Index s, const T* pose, const TurnOf& turn_of,
                          const FramesOf<T>& placed) {
  const Index parent = tree.parents[s];
  const double *offset = tree.offsets[s].data, *mount = tree.mounts[s].data;
  T *columns = placed.columns + 9 * s, *origin = placed.origins + 3 * s;
  if (parent < 0) {
    for (int k = 0; k < 3; ++k) origin[k] = T{} + offset[k];
    for (int i = 0; i < 9; ++i) columns[i] = T{} + mount[i % 3 * 3 + i / 3];
  } else {
    const T *above = placed.columns + 9 * parent, *from = placed.origins + 3 * parent;
    for (int k = 0; k < 3; ++k) {
      origin[k] =
          from[k] + offset[0] * above[k] + offset[1] * above[3 + k] + offset[2] * above[6 + k];
      for (int i = 0; i < 3; ++i) {
        columns[3 * i + k] =
            mount[i] * above[k] + mount[3 + i] * above[3 + k] + mount[6 + i] * above[6 + k];
      }
    }
  }
  for (Index d = tree.first_dofs[s]; d < tree.first_dofs[s + 1]; ++d) {
    const Index axis = tree.dof_axes[d];
    T *own = placed.axes + 3 * d, *on_axis = placed.dof_origins + 3 * d;
    if (tree.dof_is_rotation[d]) {
      const auto [sine, cosine] = turn_of(d);
      T* const first = columns + 3 * ((axis + 1) % 3);
      T* const second = columns + 3 * ((axis + 2) % 3);
      for (int k = 0; k < 3; ++k) {
        own[k] = columns[3 * axis + k];
        on_axis[k] = origin[k];
        const T a = first[k], b = second[k];
        first[k] = cosine * a + sine * b;
        second[k] = cosine * b - sine * a;
      }
    } else {
      for (int k = 0; k < 3; ++k) {
        own[k] =
            parent < 0 ? T{} + (k == axis ? 1.0 : 0.0) : placed.columns[9 * parent + 3 * axis + k];
        origin[k] += own[k] * pose[d];
      }
    }
  }
}

// Fills the frame of segment s of a pose (d,) whose parent is placed; see `place_pose`.
inline void place_segment(const Placing& tree, Index s, const Numbers& pose, const Tensor& columns,
                          const Matrix& origins, const Matrix& axes, const Matrix& dof_origins) {
  const auto turn_of = [&](Index d) { return elementary::sincos(pose[d]); };
  place_one<double>(tree, s, pose.data, turn_of,
                    {columns.data, origins.data, axes.data, dof_origins.data});
}

// Fills the frames of one pose (d,): columns (S, 3, 3), origins (S, 3), and for each degree of
// freedom its unit vector and a point on the axis of a rotation (d, 3); translations do not set the
// point.
inline void place_pose(const Placing& tree, const Numbers& pose, const Tensor& columns,
                       const Matrix& origins, const Matrix& axes, const Matrix& dof_origins) {
  for (Index s = 0; s < tree.segments(); ++s) {
    place_segment(tree, s, pose, columns, origins, axes, dof_origins);
  }
}

// Place (3,) in the camera frame of a point of a segment.
inline void place_point(const Tables& columns, const Table& origins, Index segment,
                        const double* offset, double* place) {
  const double *column = columns[segment].data, *origin = origins[segment].data;
  for (int i = 0; i < 3; ++i) {
    place[i] = origin[i];
    for (int j = 0; j < 3; ++j) place[i] += column[3 * j + i] * offset[j];
  }
}

inline void expect_poses(const Table& poses, Index d) {
  expect_shape("poses", poses, {-1, d});
  for (double x : poses) expect(std::isfinite(x), "poses", "numbers, which must be finite");
}

// Fills the frames of N poses (N, d), pose by pose.
inline void place_poses(const Placing& tree, const Table& poses, const Array<double, 4>& columns,
                        const Tensor& origins, const Tensor& axes, const Tensor& dof_origins) {
  const Index n = poses.size(), s = tree.segments(), d = tree.dimension();
  expect_poses(poses, d);
  expect_shape("columns", columns, {n, s, 3, 3});
  expect_shape("origins", origins, {n, s, 3});
  expect_shape("axes", axes, {n, d, 3});
  expect_shape("dof_origins", dof_origins, {n, d, 3});
  for (Index i = 0; i < n; ++i) {
    place_pose(tree, poses[i], columns[i], origins[i], axes[i], dof_origins[i]);
  }
}

// Number of poses that are placed side by side.
inline constexpr Index abreast = 8;
typedef double Abreast __attribute__((vector_size(abreast * sizeof(double))));
// Room for poses side by side.
struct AbreastRoom {
  Scratch<Abreast, 2> pose, sines, cosines, columns, origins, axes, dof_origins;
  AbreastRoom(Index s, Index d)
      : pose(d, 1),
        sines(d, 1),
        cosines(d, 1),
        columns(s, 9),
        origins(s, 3),
        axes(d, 3),
        dof_origins(d, 3) {}
};

// Places points, given by segments (P,) and local positions (P, 3), at up to `abreast` poses (n,
// d).
HMT_WIDE inline void place_abreast(const Placing& tree, const Table& poses, const Places& segments,
                                   const Table& local, const AbreastRoom& room,
                                   const Tensor& points) {
  const Index n = poses.size(), d = tree.dimension();
  Abreast* const pose = room.pose.view().data;
  Abreast *const sines = room.sines.view().data, *const cosines = room.cosines.view().data;
  bool far = false;
  for (Index j = 0; j < d; ++j) {
    for (Index i = 0; i < abreast; ++i) pose[j][i] = poses(std::min(i, n - 1), j);
    for (Index i = 0; i < abreast; ++i) far = far || elementary::is_far(pose[j][i]);
  }
  const double* const angles = reinterpret_cast<const double*>(pose);
  double* const sine = reinterpret_cast<double*>(sines);
  double* const cosine = reinterpret_cast<double*>(cosines);
  for (Index i = 0; i < d * abreast; ++i) {
    sine[i] = elementary::sin_near(angles[i]);
    cosine[i] = elementary::cos_near(angles[i]);
  }
  for (Index i = 0; far && i < d * abreast; ++i) {
    sine[i] = elementary::sin(angles[i]);
    cosine[i] = elementary::cos(angles[i]);
  }
  const FramesOf<Abreast> placed{room.columns.view().data, room.origins.view().data,
                                 room.axes.view().data, room.dof_origins.view().data};
  const auto turn_of = [&](Index j) { return std::pair(sines[j], cosines[j]); };
  for (Index s = 0; s < tree.segments(); ++s) place_one(tree, s, pose, turn_of, placed);
  for (Index j = 0; j < segments.size(); ++j) {
    const Abreast* const columns = placed.columns + 9 * segments[j];
    const Abreast* const origin = placed.origins + 3 * segments[j];
    const double* const place = local[j].data;
    for (int x = 0; x < 3; ++x) {
      const Abreast found =
          columns[x] * place[0] + columns[3 + x] * place[1] + columns[6 + x] * place[2] + origin[x];
      for (Index i = 0; i < n; ++i) points(i, j, x) = found[i];
    }
  }
}

// Fills the points (N, P, 3), given by segments (P,) and local positions (P, 3), at poses (N, d);
// if `relative`, minus the first point.
inline void place_points(const Placing& tree, const Table& poses, const Places& segments,
                         const Table& local, bool relative, const Tensor& points) {
  const Index n = poses.size(), s = tree.segments(), d = tree.dimension(), count = segments.size();
  expect_poses(poses, d);
  expect_range("segments", segments, 0, s);
  expect_shape("local", local, {count, 3});
  expect_shape("points", points, {n, count, 3});
  const AbreastRoom room(s, d);
  for (Index i = 0; i < n; i += abreast) {
    const Index last = std::min(i + abreast, n);
    place_abreast(tree, poses.rows(i, last), segments, local, room, points.rows(i, last));
  }
  for (Index i = 0; relative && i < n; ++i) {
    double* const first = points[i].data;
    for (Index k = 3 * count - 1; k >= 0; --k) first[k] -= first[k % 3];
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

// Fills the derivatives (N, P, 3, d) of points (N, P, 3) on segments (P,) of N poses; zero where a
// degree of freedom does not move the point.
inline void derive_points(const Array<const bool, 2>& moves, const Mask& is_rotation,
                          const Tables& axes, const Tables& dof_origins, const Places& segments,
                          const Tables& points, const Array<double, 4>& result) {
  const Index poses = points.size(), count = segments.size(), d = is_rotation.size();
  expect_shape("moves", moves, {-1, d});
  expect_shape("axes", axes, {poses, d, 3});
  expect_shape("dof_origins", dof_origins, {poses, d, 3});
  expect_range("segments", segments, 0, moves.size());
  expect_shape("points", points, {poses, count, 3});
  expect_shape("result", result, {poses, count, 3, d});
  result.fill(0.0);
  for (Index n = 0; n < poses; ++n) {
    for (Index m = 0; m < count; ++m) {
      const bool* moved = moves[segments[m]].data;
      const double* p = points[n][m].data;
      double* own = result[n][m].data;
      for (Index j = 0; j < d; ++j) {
        if (!moved[j]) continue;
        const double *axis = axes[n][j].data, *o = dof_origins[n][j].data;
        const double arm[3] = {p[0] - o[0], p[1] - o[1], p[2] - o[2]};
        const auto turned = cross(axis, arm);
        for (int k = 0; k < 3; ++k) own[k * d + j] = is_rotation[j] ? turned[k] : axis[k];
      }
    }
  }
}

// Fills the derivatives (N, S, 3, L) of the origins by the lengths, from the basis (S, 3, L) of the
// offsets and the origins of the parents. Columns are (N, S, 3, 3).
inline void lift_origins(const Places& parents, const Tables& basis,
                         const Array<const double, 4>& columns, const Array<double, 4>& result) {
  const Index count = parents.size(), lengths = basis.size(2), poses = columns.size();
  expect_range("parents", parents, -1, count);
  for (Index s = 0; s < count; ++s) expect(parents[s] < s, "parents", "parents before children");
  expect_shape("basis", basis, {count, 3, lengths});
  expect_shape("columns", columns, {poses, count, 3, 3});
  expect_shape("result", result, {poses, count, 3, lengths});
  for (Index n = 0; n < poses; ++n) {
    for (Index s = 0; s < count; ++s) {
      const Index parent = parents[s];
      const double *own = basis[s].data, *column = columns[n][std::max<Index>(parent, 0)].data;
      double* lift = result[n][s].data;
      if (parent < 0) {
        std::copy_n(own, 3 * lengths, lift);
        continue;
      }
      const double* above = result[n][parent].data;
      for (int x = 0; x < 3; ++x) {
        for (Index k = 0; k < lengths; ++k) {
          lift[x * lengths + k] = above[x * lengths + k] + column[x] * own[k] +
                                  column[3 + x] * own[lengths + k] +
                                  column[6 + x] * own[2 * lengths + k];
        }
      }
    }
  }
}

}  // namespace hmt
