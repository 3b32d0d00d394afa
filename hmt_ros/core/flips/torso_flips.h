// Flips of the torso in depth (KJS 3); see hmt_ros/flips/torso_flips.py.
#pragma once

#include "../elementary.h"
#include "../kinematics.h"

namespace hmt {

struct Torso {
  static constexpr double significant = 0.04;  // minimum change of depth of some joint, m
  // Rows of the joints.
  enum { pelvis, neck, left_hip, right_hip, left_shoulder, right_shoulder, joint_count };

  Places root, trunk;          // (3,), (0, 2 or 3) degrees of freedom that turn them
  Index segment;               // the trunk
  Places joint_segments;       // (6,)
  Table joint_offsets;         // (6, 3)
  Numbers lower, upper;        // (d,) limits
  Array<const bool, 2> flips;  // (F, 3) whether the hips turn, the torso leans, the shoulders turn

  void check() const {
    const Index d = lower.size();
    expect_shape("root", root, {3});
    expect_range("root", root, 0, d);
    expect(trunk.empty() || trunk.size() == 2 || trunk.size() == 3, "trunk", "0, 2 or 3 entries");
    expect_range("trunk", trunk, 0, d);
    expect_shape("joint_segments", joint_segments, {joint_count});
    expect_shape("joint_offsets", joint_offsets, {joint_count, 3});
    expect_shape("upper", upper, {d});
    expect_shape("flips", flips, {-1, 3});
  }
};

class TorsoFlips {
 public:
  TorsoFlips(const Placing& tree, const Torso& torso) : tree_(tree), torso_(torso) {}

  // Reads the torso of a pose (d,), which `flip` then flips.
  void read(const Numbers& pose) {
    place_pose(tree_, pose, columns_, origins_, axes_, dof_origins_);
    for (int j = 0; j < Torso::joint_count; ++j) {
      const Index s = torso_.joint_segments[j];
      for (int k = 0; k < 3; ++k) {
        joints_[j][k] = origins_(s, k);
        for (int i = 0; i < 3; ++i) joints_[j][k] += columns_(s, i, k) * torso_.joint_offsets(j, i);
      }
    }
    for (int k = 0; k < 3; ++k) {
      hips_[k] = joints_[Torso::right_hip][k] - joints_[Torso::left_hip][k];
      shoulders_[k] = joints_[Torso::right_shoulder][k] - joints_[Torso::left_shoulder][k];
      before_[k] = origins_(torso_.segment, k);
      z_[k] = columns_(0, 2, k);
    }
  }

  // Flips the pose that was read; returns whether the limits allow it and some depth changes.
  bool flip(bool turn_hips, bool lean, bool turn_shoulders, const Vector& pose) {
    double hips[3], shoulders[3];
    wish(hips_, joints_[Torso::pelvis], turn_hips, hips);
    wish(shoulders_, joints_[Torso::neck], turn_shoulders, shoulders);
    if (turn_hips && !turn_root(hips, pose)) return false;
    double change = most(std::abs(hips[2] - hips_[2]), std::abs(shoulders[2] - shoulders_[2]));
    if (!torso_.trunk.empty()) {
      const Index segment = torso_.segment;
      for (Index s = 0; s <= segment; ++s) {  // the parents of a segment come before it
        place_segment(tree_, s, pose, columns_, origins_, axes_, dof_origins_);
      }
      double neck[3], up[3];
      const bool meets = place_neck(origins_[segment].data, lean, neck);
      if (lean && !meets) return false;
      change = most(change, std::abs(neck[2] - joints_[Torso::neck][2]));
      for (int k = 0; k < 3; ++k) up[k] = neck[k] - origins_(segment, k);
      if (!turn_trunk(up, shoulders, pose)) return false;
    }
    return change > Torso::significant;
  }

 private:
  const Placing& tree_;
  const Torso& torso_;
  const Index segments_ = tree_.segments(), d_ = tree_.dimension();
  Scratch<double, 3> columns_{segments_, 3, 3};
  Scratch<double, 2> origins_{segments_, 3}, axes_{d_, 3}, dof_origins_{d_, 3};
  // Of the pose that was read: joints, lines from left to right hip and shoulder, start of the
  // trunk, and z axis of the root.
  double joints_[Torso::joint_count][3], hips_[3], shoulders_[3], before_[3], z_[3];

  // A line (3,); if it turns, its component along the ray to a point is reversed.
  static void wish(const double* line, const double* at, bool turns, double* wanted) {
    std::copy_n(line, 3, wanted);
    if (!turns) return;
    const double distance = std::sqrt(dot(at, at));
    const double ray[3] = {at[0] / distance, at[1] / distance, at[2] / distance};
    const double twice = 2.0 * dot(line, ray);
    for (int k = 0; k < 3; ++k) wanted[k] = line[k] - twice * ray[k];
  }

  // Moves the neck (3,) along its ray for a new start of the trunk, to the other side of the start
  // if the trunk leans; returns whether the neck can reach the ray.
  bool place_neck(const double* start, bool lean, double* wanted) const {
    const double* neck = joints_[Torso::neck];
    const double distance = std::sqrt(dot(neck, neck));
    double ray[3], gap[3];
    for (int k = 0; k < 3; ++k) {
      ray[k] = neck[k] / distance;
      gap[k] = neck[k] - before_[k];
    }
    const double middle = dot(ray, start);
    const double reach = dot(gap, gap) - dot(start, start) + middle * middle;
    const double side = (distance < dot(ray, before_)) != lean ? -1.0 : 1.0;
    const double depth = middle + side * std::sqrt(most(reach, 0.0));
    for (int k = 0; k < 3; ++k) wanted[k] = depth * ray[k];
    return reach > 0.0;
  }

  // Turns the root of a pose (d,): its x axis follows the hips, its z axis stays near z. Returns
  // whether it is within the limits.
  bool turn_root(const double* hips, const Vector& pose) const {
    const double width = std::sqrt(dot(hips, hips));
    const double x[3] = {hips[0] / width, hips[1] / width, hips[2] / width};
    const double along = dot(z_, x);
    double z[3];
    for (int k = 0; k < 3; ++k) z[k] = z_[k] - along * x[k];
    const double length = most(std::sqrt(dot(z, z)), 1e-9);
    for (int k = 0; k < 3; ++k) z[k] = z[k] / length;
    const double y[3] = {z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2],
                         z[0] * x[1] - z[1] * x[0]};
    double mount[3][3];  // rows: columns of the mount
    for (int i = 0; i < 3; ++i) {
      for (int k = 0; k < 3; ++k) mount[i][k] = tree_.mounts(0, k, i);
    }
    // Elements of R = mount' [x y z] that determine the angles about z, y and x.
    const double xx = dot(mount[0], x), yx = dot(mount[1], x), zx = dot(mount[2], x);
    const double zy = dot(mount[2], y), zz = dot(mount[2], z);
    const bool first = set(torso_.root[0], elementary::atan2(yx, xx), pose);
    const bool second = set(torso_.root[1], -elementary::asin(between(zx, -1.0, 1.0)), pose);
    const bool third = set(torso_.root[2], elementary::atan2(zy, zz), pose);
    return first && second && third;
  }

  // Turns the trunk of a placed pose (d,) up as wanted, its x axis along the shoulders. Returns
  // whether it is within the limits.
  bool turn_trunk(const double* up, const double* shoulders, const Vector& pose) const {
    const Index segment = torso_.segment;
    const Places own = torso_.trunk;
    const Matrix above = columns_[tree_.parents[segment]];
    const double length = std::sqrt(dot(up, up));
    const double direction[3] = {up[0] / length, up[1] / length, up[2] / length};
    // The trunk runs along its negative z axis:
    // (sin b, -sin a cos b, cos a cos b) = base^T (-up).
    double v[3];
    for (int j = 0; j < 3; ++j) {
      v[j] = 0.0;
      for (int i = 0; i < 3; ++i) {
        v[j] -= tree_.mounts(segment, i, j) * dot(above[i].data, direction);
      }
    }
    const bool first = set(own[0], elementary::atan2(-v[1], v[2]), pose);
    const bool second = set(own[1], elementary::asin(between(v[0], -1.0, 1.0)), pose);
    if (own.size() == 2) return first && second;
    const double twist = pose[own[2]];
    pose[own[2]] = 0.0;
    place_segment(tree_, segment, pose, columns_, origins_, axes_, dof_origins_);
    pose[own[2]] = twist;
    const Matrix axis = columns_[segment];
    const double c = elementary::atan2(dot(axis[1].data, shoulders), dot(axis[0].data, shoulders));
    const bool third = set(own[2], c, pose);
    return first && second && third;
  }

  // Sets an angle of a pose (d,), modulo a turn nearest to the old one; returns whether it is
  // valid.
  bool set(Index j, double angle, const Vector& pose) const {
    const double near = angle + 2.0 * pi * std::rint((pose[j] - angle) / (2.0 * pi));
    pose[j] = near;
    return near >= torso_.lower[j] && near <= torso_.upper[j];
  }
};

// Fills rows of result (N F, d) with the flips of poses (N, d), and parents (N F,) with the index
// of the pose of each; returns the number of flips.
inline Index fill_torso_flips(const Placing& tree, const Torso& torso, const Table& poses,
                              const Matrix& result, const Array<Index, 1>& parents) {
  const Index n = poses.size(), d = tree.dimension(), most_flips = n * torso.flips.size();
  expect_shape("torso.lower", torso.lower, {d});
  expect_range("torso.joint_segments", torso.joint_segments, 0, tree.segments());
  expect(torso.segment >= 0 && torso.segment < tree.segments(), "torso.segment", "a segment");
  expect(torso.trunk.empty() || tree.parents[torso.segment] >= 0, "torso.segment",
         "one that hangs on another");
  expect_shape("poses", poses, {n, d});
  expect_shape("result", result, {most_flips, d});
  expect_shape("parents", parents, {most_flips});
  TorsoFlips torso_flips(tree, torso);
  Index count = 0;
  for (Index i = 0; i < n; ++i) {
    torso_flips.read(poses[i]);
    for (Index f = 0; f < torso.flips.size(); ++f) {
      const Array<const bool, 1> flips = torso.flips[f];
      result[count].copy_from(poses[i]);
      if (torso_flips.flip(flips[0], flips[1], flips[2], result[count])) parents[count++] = i;
    }
  }
  return count;
}

}  // namespace hmt
