// Leaves of the interpretation trees of chains (KJS 3); see hmt_ros/flips/interpretation_tree.py.
//
// For a link of length l from the joint P to a joint on the unit ray r, that joint is at
//
//     s r,    s = r.P +- sqrt((r.P)^2 - |P|^2 + l^2).
//
// Joint angles follow by descending the chain, with v the z axis of the segment in the frame before
// its rotations:
//
//     spherical, first two   v = (sin b, -sin a cos b, cos a cos b)
//     its third, and hinge   v = (sin c sin e, -cos c sin e, cos e)
//     end effector           as the first line
#pragma once

#include "../arrays.h"
#include "../elementary.h"

namespace hmt {

inline constexpr double turn = 2.0 * pi;
inline constexpr double touching = 1e-6;  // distance below which two solutions are one, m
// Sine of an elbow or knee angle below which the segments count as straight, and their twist is
// free.
inline constexpr double straight = 1e-6;
inline constexpr double limit_tolerance = 1e-9;  // rad

// A chain of K links with D degrees of freedom; a link has 3 (x y z), 1 (x) or 2 (x y) of them.
struct ChainLinks {
  static constexpr Index most_links = 20;  // so that multiples of 4^K fit into an Index

  Places segments;             // (K,)
  Index parent;                // parent segment of the chain
  Tables mounts;               // (K, 3, 3)
  Mask mounted;                // (K,) whether the mount is not the identity
  Numbers lengths;             // (K,) from joint to joint, m
  Places first_dofs;           // (K + 1,) first degree of freedom of each link
  Places dofs;                 // (D,)
  Numbers lower, upper;        // (D,) rad
  Array<const bool, 2> sides;  // (K, 2) whether limits of a link allow each solution

  Index links() const { return segments.size(); }
  Index leaves() const { return Index{1} << links(); }
  Index dofs_of(Index k) const { return first_dofs[k + 1] - first_dofs[k]; }
  void check() const {
    const Index k = links(), d = dofs.size();
    expect(k > 0 && k <= most_links, "segments", "1 to 20 links");
    expect_shape("mounts", mounts, {k, 3, 3});
    expect_shape("mounted", mounted, {k});
    expect_shape("lengths", lengths, {k});
    expect_shape("first_dofs", first_dofs, {k + 1});
    expect_range("first_dofs", first_dofs, 0, d + 1);
    for (Index i = 0; i < k; ++i) {
      expect(dofs_of(i) > (i == 0) && dofs_of(i) < 4, "first_dofs",
             "links of 1 to 3 degrees of freedom, the first of 2 or 3");
    }
    expect_shape("lower", lower, {d});
    expect_shape("upper", upper, {d});
    expect_shape("sides", sides, {k, 2});
  }
};

struct Nearest {
  double angle;
  bool fits;
};

// The angle plus a multiple of 2 pi within the limits; if several fit, the nearest to the given
// angle.
inline Nearest into_limits(double angle, double lower, double upper, double given) {
  double shifted = angle + turn * std::rint((given - angle) / turn);
  if (shifted < lower - limit_tolerance) shifted += turn;
  if (shifted > upper + limit_tolerance) shifted -= turn;
  const bool fits = lower - limit_tolerance <= shifted && shifted <= upper + limit_tolerance;
  return {between(shifted, lower, upper), fits};
}

// Grows the trees of chains with limited numbers of links and degrees of freedom.
class TreeGrowth {
 public:
  TreeGrowth(Index links, Index dofs)
      : rays_(links, 3),
        distances_(links),
        signs_(links),
        joints_(links + 1, 3),
        frames_(links + 1, 3, 3),
        given_(dofs),
        found_(dofs) {}

  // Fills the angles (2^K, D) and sets valid (2^K,) for existing leaves, depth first; dead branches
  // are skipped. The bits of the number of a leaf, highest first, select one of the two solutions
  // of each link.
  //
  // The chain starts at `start` (3,) in the frame `base` (3, 3), whose rows are axes; targets (K,
  // 3) are points on the rays of the joints. Of equivalent angles, those nearest to the pose (d,)
  // are taken. A ray that misses its sphere by less than the slack counts as touching. If the given
  // pose stays, the targets are its joints, and the pose is the first leaf.
  void grow(const ChainLinks& chain, const double* start, const double* base, const Table& targets,
            const Numbers& pose, double slack, bool given_stays, const Matrix& angles,
            const Array<bool, 1>& valid) {
    aim(chain, start, base, targets, pose);
    const Index last = chain.links() - 1, leaves = chain.leaves(), d = chain.dofs.size();
    Index leaf = 0, k = 0;
    while (leaf < leaves) {
      for (; k <= last; ++k) {
        const Index branch = leaf >> (last - k);
        const bool stays = given_stays && branch == 0;
        if (!put_joint(chain.lengths[k], k, branch & 1, stays, slack) || !bend(chain, k)) break;
      }
      if (k > last) {
        valid[leaf] = true;
        std::copy_n(found_.view().data, d, angles[leaf].data);
        k = last;
      }
      // Continue with the second solution of the last link that has not taken it yet.
      leaf = ((leaf >> (last - k)) + 1) << (last - k);
      for (k = last; k > 0 && !((leaf >> (last - k)) & 1);) --k;
    }
  }

 private:
  // Of the tree: unit rays (K, 3), distances and signs (K,) of the targets.
  Scratch<double, 2> rays_;
  Scratch<double, 1> distances_, signs_;
  // Of the current branch: the joints, the frames before the rotations of the links, and the
  // angles.
  Scratch<double, 2> joints_;
  Scratch<double, 3> frames_;
  Scratch<double, 1> given_, found_;

  void aim(const ChainLinks& chain, const double* start, const double* base, const Table& targets,
           const Numbers& pose) {
    for (Index j = 0; j < chain.dofs.size(); ++j) given_[j] = pose[chain.dofs[j]];
    std::copy_n(start, 3, joints_[0].data);
    std::copy_n(base, 9, frames_[0].data);
    const double* before = start;
    for (Index k = 0; k < chain.links(); ++k) {
      const double *target = targets[k].data, *ray = rays_[k].data;
      distances_[k] = std::sqrt(dot(target, target));
      for (int x = 0; x < 3; ++x) rays_(k, x) = target[x] / distances_[k];
      // The given pose takes the far solution if its joint lies beyond the point of the ray that is
      // nearest to the parent.
      signs_[k] = distances_[k] >= dot(ray, before) ? 1.0 : -1.0;
      before = target;
    }
  }

  // Places the end of link k on its ray; false if the link cannot reach the ray.
  bool put_joint(double length, Index k, bool second, bool stays, double slack) {
    const double *p = joints_[k].data, *ray = rays_[k].data;
    double* joint = joints_[k + 1].data;
    double s = distances_[k];
    // The given pose stays, even if rounding makes its discriminant negative.
    if (!stays) {
      const double along = dot(p, ray);
      const double discriminant = along * along - dot(p, p) + length * length;
      const double reach = length + slack;
      if (!(discriminant >= length * length - reach * reach)) return false;
      const double root = std::sqrt(most(discriminant, 0.0));
      if (second && root <= 0.5 * touching) return false;
      s = second ? along - signs_[k] * root : along + signs_[k] * root;
      if (!(s > 0.0)) return false;
    }
    for (int x = 0; x < 3; ++x) joint[x] = s * ray[x];
    if (slack > 0.0) {
      // If the ray is out of reach, the link points at its nearest point and keeps its length.
      const double arm[3] = {joint[0] - p[0], joint[1] - p[1], joint[2] - p[2]};
      const double scale = length / most(std::sqrt(dot(arm, arm)), 1e-9);
      for (int x = 0; x < 3; ++x) joint[x] = p[x] + scale * arm[x];
    }
    return true;
  }

  // Sets the angles that point link k at its joint, and the next frame; false outside the limits.
  bool bend(const ChainLinks& chain, Index k) {
    const Index at = chain.first_dofs[k], dofs = chain.dofs_of(k);
    const bool inner = k + 1 < chain.links();
    const double *joint = joints_[k].data, *end = joints_[k + 1].data;
    double z[3], v[3];
    for (int x = 0; x < 3; ++x) z[x] = (joint[x] - end[x]) / chain.lengths[k];
    // Build the frame after the mount in the place of the frame of the next link.
    mount(chain, k);
    double* frame = frames_[k + 1].data;
    for (int i = 0; i < 3; ++i) v[i] = dot(frame + 3 * i, z);
    if (dofs == 1) {
      const double e = elementary::acos(between(v[2], -1.0, 1.0));
      // So far the frame does not include the twist of the spherical joint.
      const bool fits = choose(chain, k, at - 1, at, e, -e, v[0], -v[1]);
      if (inner && fits) {
        turn_about(frame, found_[at - 1], 2);
        turn_about(frame, found_[at], 0);
      }
      return fits;
    }
    const double b = elementary::asin(between(v[0], -1.0, 1.0));
    const bool fits = choose(chain, k, at, at + 1, b, pi - b, -v[1], v[2]);
    if (inner && fits) {
      turn_about(frame, found_[at], 0);
      turn_about(frame, found_[at + 1], 1);
    }
    if (dofs == 3) {
      found_[at + 2] = given_[at + 2];
      if (inner && fits && chain.dofs_of(k + 1) != 1) turn_about(frame, given_[at + 2], 2);
    }
    return fits;
  }

  void mount(const ChainLinks& chain, Index k) {
    const double *above = frames_[k].data, *mount = chain.mounts[k].data;
    double* frame = frames_[k + 1].data;
    if (!chain.mounted[k]) {
      std::copy_n(above, 9, frame);
      return;
    }
    for (int i = 0; i < 3; ++i) {
      for (int x = 0; x < 3; ++x) {
        double total = 0.0;
        for (int j = 0; j < 3; ++j) total += above[3 * j + x] * mount[3 * j + i];
        frame[3 * i + x] = total;
      }
    }
  }

  // Finds angles i and j of link k within their limits; of two solutions, those nearest to the
  // given angles; false if none. Angle j is `one` or `two`. Angle i is the angle of (x, y), turned
  // by pi for the second solution; it is kept if (x, y) vanishes, because it has no effect on the
  // segment then.
  bool choose(const ChainLinks& chain, Index k, Index i, Index j, double one, double two, double y,
              double x) {
    const bool free = std::sqrt(y * y + x * x) < straight;
    double best = infinity;
    bool found = false;
    found_[i] = given_[i];
    found_[j] = given_[j];
    for (int solution = 0; solution < 2; ++solution) {
      if (!chain.sides(k, solution)) continue;
      const double side = solution == 0 ? 1.0 : -1.0;
      const auto [b, b_fits] =
          into_limits(solution == 0 ? one : two, chain.lower[j], chain.upper[j], given_[j]);
      if (!b_fits) continue;
      const double toward = free ? given_[i] : elementary::atan2(side * y, side * x);
      const auto [a, a_fits] = into_limits(toward, chain.lower[i], chain.upper[i], given_[i]);
      const double cost = square(a - given_[i]) + square(b - given_[j]);
      if (a_fits && cost < best) {
        found_[i] = a;
        found_[j] = b;
        best = cost;
        found = true;
      }
    }
    return found;
  }

  // Turns a frame (3, 3) about one of its own axes.
  static void turn_about(double* frame, double angle, int axis) {
    double *first = frame + 3 * ((axis + 1) % 3), *second = frame + 3 * ((axis + 2) % 3);
    const auto [sine, cosine] = elementary::sincos(angle);
    for (int x = 0; x < 3; ++x) {
      const double a = first[x], b = second[x];
      first[x] = cosine * a + sine * b;
      second[x] = cosine * b - sine * a;
    }
  }
};

// Fills angles (N, 2^K, D) and validity (N, 2^K) of N poses (N, d), pose by pose; see
// `TreeGrowth.grow`. Columns (S, 3, 3, N), origins (S, 3, N) and targets (K, 3, N) have the poses
// on their last axis.
inline void grow_leaves(const ChainLinks& chain, const Array<const double, 4>& columns,
                        const Tables& origins, const Table& poses, const Tables& targets,
                        double slack, bool given_stays, const Tensor& angles,
                        const Array<bool, 2>& valid) {
  const Index n = poses.size(), s = origins.size(), links = chain.links();
  const Index d = chain.dofs.size();
  expect_shape("columns", columns, {s, 3, 3, n});
  expect_shape("origins", origins, {s, 3, n});
  expect_shape("targets", targets, {links, 3, n});
  expect_shape("angles", angles, {n, chain.leaves(), d});
  expect_shape("valid", valid, {n, chain.leaves()});
  expect_range("chain.segments", chain.segments, 0, s);
  expect_range("chain.dofs", chain.dofs, 0, poses.size(1));
  expect(chain.parent >= 0 && chain.parent < s, "chain.parent", "a segment");
  TreeGrowth growth(links, d);
  Scratch<double, 2> own_targets(links, 3);
  double start[3], base[9];
  for (Index i = 0; i < n; ++i) {
    for (int x = 0; x < 3; ++x) start[x] = origins(chain.segments[0], x, i);
    for (int x = 0; x < 9; ++x) base[x] = columns(chain.parent, x / 3, x % 3, i);
    for (Index k = 0; k < links; ++k) {
      for (int x = 0; x < 3; ++x) own_targets(k, x) = targets(k, x, i);
    }
    growth.grow(chain, start, base, own_targets, poses[i], slack, given_stays, angles[i], valid[i]);
  }
}

}  // namespace hmt
