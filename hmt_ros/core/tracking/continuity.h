// The motion prior on transitions between the modes of two images; equations in
// hmt_ros/tracking/weighting.py.
#pragma once

#include "../arrays.h"
#include "../elementary.h"
#include "../log_sum_exp.h"
#include "../wide.h"

namespace hmt {

// Student's density of the mean squared distance of joints.
struct Transition {
  double variance;  // of a joint, m^2
  double tails;     // nu
  void check() const { expect(variance > 0.0 && tails > 0.0, "variance", "positive numbers"); }
};

// Joints (N, J, 3) relative to the first joint, with poses on the last axis: (3 J, N).
inline Scratch<double, 2> relative_coordinates(const Tables& joints) {
  const Index n = joints.size(), count = joints.size(1);
  Scratch<double, 2> result(3 * count, n);
  for (Index i = 0; i < n; ++i) {
    const double* pose = joints[i].data;
    for (Index j = 0; j < 3 * count; ++j) result(j, i) = pose[j] - pose[j % 3];
  }
  return result;
}

// Fills log t (N,) from column k of coordinates to all columns of others, equation (3).
HMT_WIDE inline void fill_transitions(const Table& from, Index k, const Table& to, double scale,
                                      double tails, double* __restrict result) {
  const Index n = to.size(1);
  std::fill_n(result, n, 0.0);
  for (Index j = 0; j < to.size(); ++j) {
    const double own = from.data[j * from.size(1) + k];
    const double* other = to.data + j * n;
    for (Index i = 0; i < n; ++i) result[i] += square(own - other[i]);
  }
  for (Index i = 0; i < n; ++i) {
    result[i] = -0.5 * tails * elementary::log1p(result[i] / (scale * tails));
  }
}

// Fills log t (K, N) from poses with joints (K, J, 3) to poses with joints (N, J, 3).
inline void rate_transitions(const Tables& first, const Tables& joints,
                             const Transition& transition, const Matrix& result) {
  expect_shape("first", first, {-1, joints.size(1), 3});
  expect_shape("joints", joints, {-1, -1, 3});
  expect_shape("result", result, {first.size(), joints.size()});
  const auto from = relative_coordinates(first), to = relative_coordinates(joints);
  const double scale = double(joints.size(1)) * transition.variance;
  for (Index k = 0; k < first.size(); ++k) {
    fill_transitions(from, k, to, scale, transition.tails, result[k].data);
  }
}

// Fills log w_k p(x_n | x_k) (K, N), equation (2), from log t (K, N).
inline void rate_histories(const Numbers& log_weights, const Table& transitions,
                           const Tables& joints, const Transition& transition, double end,
                           const Matrix& result) {
  const Index modes = transitions.size(), n = joints.size();
  expect_shape("log_weights", log_weights, {modes});
  expect_shape("transitions", transitions, {-1, n});
  expect_shape("joints", joints, {-1, -1, 3});
  expect_shape("result", result, {modes, n});
  const auto at = relative_coordinates(joints);
  const double scale = double(joints.size(1)) * transition.variance;
  const Scratch<double, 1> near(n), room(n);
  for (Index i = 0; i < n; ++i) {
    fill_transitions(at, i, at, scale, transition.tails, room.view().data);
    near[i] = log_sum_exp(room.view().data, n);
  }
  for (Index k = 0; k < modes; ++k) {
    for (Index i = 0; i < n; ++i) room[i] = result(k, i) = transitions(k, i) - near[i];
    const double total = log_add_exp(log_sum_exp(room.view().data, n), -end);
    for (Index i = 0; i < n; ++i) result(k, i) += log_weights[k] - total;
  }
}

}  // namespace hmt
