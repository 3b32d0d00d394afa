// Joints of poses with scaled bones; see hmt_ros/image/lifted_poses.py.
#pragma once

#include "../arrays.h"

namespace hmt {

// Scales the bones of poses with joints (C, J, 3) by factors (J,). `order` (J, 2): each joint and
// the joint at the start of its bone, which comes earlier in the order; -1: the origin.
inline void resize_bones(const Array<const Index, 2>& order, const Numbers& factors,
                         const Tables& joints, const Tensor& result) {
  const Index count = joints.size(1);
  expect_shape("order", order, {count, 2});
  expect_shape("factors", factors, {count});
  expect_shape("joints", joints, {-1, -1, 3});
  expect_shape("result", result, {joints.size(), count, 3});
  std::vector<bool> placed(count, false);
  for (Index k = 0; k < count; ++k) {
    const Index joint = order(k, 0), carrier = order(k, 1);
    expect(0 <= joint && joint < count && -1 <= carrier && carrier < count, "order", "joints");
    expect(carrier < 0 || placed[carrier], "order", "joints after those that they hang on");
    placed[joint] = true;
  }
  for (Index c = 0; c < joints.size(); ++c) {
    for (Index k = 0; k < count; ++k) {
      const Index joint = order(k, 0), carrier = order(k, 1);
      for (Index axis = 0; axis < 3; ++axis) {
        const double from = carrier < 0 ? 0.0 : joints(c, carrier, axis);
        const double start = carrier < 0 ? 0.0 : result(c, carrier, axis);
        result(c, joint, axis) = start + factors[joint] * (joints(c, joint, axis) - from);
      }
    }
  }
}

}  // namespace hmt
