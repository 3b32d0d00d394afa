// Facing directions of persons; equations in hmt_ros/tracking/classes.py.
#pragma once

#include "../arrays.h"
#include "../elementary.h"
#include "../log_sum_exp.h"

namespace hmt {

using Direction = std::array<double, 3>;

inline Direction unit(Direction v) {
  const double length = most(std::sqrt(dot(v.data(), v.data())), 1e-12);
  for (double& x : v) x /= length;
  return v;
}

// The joints (L,) on the left and on the right side of the trunk.
struct Trunk {
  Places left, right;
};

// The unit vector to the left of a person with joints (J, 3).
inline Direction left_of(const Trunk& trunk, const Table& joints) {
  Direction left{}, right{};
  for (Index j : trunk.left) {
    for (int x = 0; x < 3; ++x) left[x] += joints(j, x);
  }
  for (Index j : trunk.right) {
    for (int x = 0; x < 3; ++x) right[x] += joints(j, x);
  }
  for (int x = 0; x < 3; ++x) left[x] -= right[x];
  return unit(left);
}

inline void expect_joints(const Trunk& trunk, const Tables& joints) {
  expect_shape("joints", joints, {-1, -1, 3});
  expect(joints.size(1) > 0, "joints", "a joint or more");
  expect_range("trunk.left", trunk.left, 0, joints.size(1));
  expect_range("trunk.right", trunk.right, 0, joints.size(1));
}

// Fills the unit vectors (N, 3) to the left of persons with joints (N, J, 3).
inline void point_left(const Trunk& trunk, const Tables& joints, const Matrix& result) {
  expect_joints(trunk, joints);
  expect_shape("result", result, {joints.size(), 3});
  for (Index n = 0; n < joints.size(); ++n) {
    const Direction left = left_of(trunk, joints[n]);
    std::copy(left.begin(), left.end(), result[n].data);
  }
}

// Sine of the angle by which the front of a person, left x up, points away from the camera.
inline double facing_away(const Direction& left, const Table& joints, Index neck) {
  const double *pelvis = joints[0].data, *top = joints[neck].data;
  const Direction up = unit({top[0] - pelvis[0], top[1] - pelvis[1], top[2] - pelvis[2]});
  const Direction ray = unit({pelvis[0], pelvis[1], pelvis[2]});
  return dot(left.data(), cross(up.data(), ray.data()).data());
}

// Fills whether persons with joints (N, J, 3) face another direction than one with joints (J, 3):
// by more than 90 degrees, or one faces the camera and the other faces away, with sines that differ
// by more than twice `sideways`.
inline void face_back(const Trunk& trunk, const Tables& joints, const Table& reference, Index neck,
                      double sideways, const Array<bool, 1>& result) {
  expect_joints(trunk, joints);
  expect_shape("reference", reference, {joints.size(1), 3});
  expect(neck >= 0 && neck < joints.size(1), "neck", "a joint");
  expect_shape("result", result, {joints.size()});
  const Direction ahead = left_of(trunk, reference);
  const double before = facing_away(ahead, reference, neck);
  for (Index n = 0; n < joints.size(); ++n) {
    const Direction left = left_of(trunk, joints[n]);
    const double away = facing_away(left, joints[n], neck);
    const bool apart = away * before < 0.0 && std::abs(away - before) > 2.0 * sideways;
    result[n] = dot(left.data(), ahead.data()) < 0.0 || apart;
  }
}

// Evidence for a facing direction, bounded because the image may be misleading, equation (3).
inline double believed(double evidence, double valid) {
  const double yes = elementary::log(valid), no = elementary::log1p(-valid);
  return log_add_exp(yes + evidence, no) - log_add_exp(yes, no + evidence);
}

// State and parameters of the two facing directions.
struct Ways {
  Mask before;      // (K,) modes that face another direction than the heaviest
  Mask back;        // (N,) hypotheses that face that other direction
  double variance;  // variance of turns, rad^2
  double log_odds;  // prior log odds of the other direction
  double price;     // price of a change of direction, nats
  double valid;     // share of the images that show the facing direction
  double most;      // maximum log odds
};

// Weights the facing directions, equations (1) and (2): fills log weights (N,) with the
// probabilities of the directions, the log odds (N,) of the direction of each hypothesis, and the
// terms that (6) adds to log t (K, N).
//
// first, joints: joints of the predicted modes (K, J, 3) and of the hypotheses (N, J, 3)
// transitions: (K, N) log t
// log_weights: (N,) only the ratios within a direction are used
// evidence: (N,) energies of the image
// followed: (N,) whether each hypothesis continues a mode
inline void weigh_ways(const Trunk& trunk, const Ways& ways, const Tables& first,
                       const Tables& joints, const Table& transitions, const Numbers& log_weights,
                       const Numbers& evidence, const Mask& followed, const Vector& result,
                       const Vector& facing, const Matrix& turned) {
  const Index modes = first.size(), n = joints.size();
  expect_joints(trunk, joints);
  expect_shape("first", first, {-1, joints.size(1), 3});
  expect_shape("ways.before", ways.before, {modes});
  expect_shape("ways.back", ways.back, {n});
  expect_shape("transitions", transitions, {modes, n});
  expect_shape("log_weights", log_weights, {n});
  expect_shape("evidence", evidence, {n});
  expect_shape("followed", followed, {n});
  expect_shape("result", result, {n});
  expect_shape("facing", facing, {n});
  expect_shape("turned", turned, {modes, n});
  const Mask& back = ways.back;
  const Scratch<double, 2> lefts(n, 3);
  point_left(trunk, joints, lefts);
  double log_odds = ways.log_odds;
  for (Index k = 0; k < modes; ++k) {
    const Direction left = left_of(trunk, first[k]);
    for (Index i = 0; i < n; ++i) {
      turned(k, i) = 0.0;
      if (ways.before[k] == back[i]) continue;
      const double angle = elementary::acos(between(dot(left.data(), lefts[i].data), -1.0, 1.0));
      const double turn = least(transitions(k, i), -0.5 * square(angle) / ways.variance);
      turned(k, i) = log_add_exp(turn, -ways.price) - transitions(k, i);
      if (back[i]) log_odds = most(log_odds, turn);
    }
  }
  double best[2] = {infinity, infinity};
  bool any[2] = {}, seen[2] = {};
  for (Index i = 0; i < n; ++i) {
    seen[back[i]] = true;
    if (!followed[i]) continue;
    any[back[i]] = true;
    best[back[i]] = least(best[back[i]], evidence[i]);
  }
  if (any[0] && any[1]) log_odds += believed(best[0] - best[1], ways.valid);
  log_odds = between(log_odds, -ways.most, ways.most);
  // If all hypotheses have turned, the track is as sure of this direction as it was of the other.
  if (!seen[0]) log_odds = std::abs(log_odds);
  for (Index i = 0; i < n; ++i) facing[i] = back[i] ? log_odds : -log_odds;
  result.copy_from(log_weights);
  if (!seen[0] || !seen[1]) return;
  const Scratch<double, 1> room(n);
  for (const bool way : {false, true}) {
    Index count = 0;
    for (Index i = 0; i < n; ++i) {
      if (back[i] == way) room[count++] = log_weights[i];
    }
    const double share = -log_add_exp(0.0, way ? -log_odds : log_odds);
    const double own = share - log_sum_exp(room.view().data, count);
    for (Index i = 0; i < n; ++i) {
      if (back[i] == way) result[i] += own;
    }
  }
}

}  // namespace hmt
