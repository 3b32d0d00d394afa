// What examples/stop_near_hand.cpp uses of rclcpp: spinning hands messages over, and prints each answer.
#pragma once
#include <chrono>
#include <cstdio>
#include <functional>
#include <memory>
#include <string>
#include <hmt_msgs/msg/pose_mixture.hpp>
#include <std_msgs/msg/bool.hpp>
namespace rclcpp {
struct Publisher {
  void publish(const std_msgs::msg::Bool & answer) const {std::printf("%d", answer.data);}
};
struct Node {
  explicit Node(const std::string &) {}
  std::function<void(const hmt_msgs::msg::PoseMixture &)> callback;
  std::function<void()> tick;
  template<typename Message>
  std::shared_ptr<Publisher> create_publisher(const std::string &, int)
  {
    return std::make_shared<Publisher>();
  }
  template<typename Message, typename Callback>
  std::shared_ptr<int> create_subscription(const std::string &, int, Callback given)
  {
    callback = given;
    return std::make_shared<int>(0);
  }
  template<typename Callback>
  std::shared_ptr<int> create_wall_timer(std::chrono::milliseconds, Callback given)
  {
    tick = given;
    return std::make_shared<int>(0);
  }
};
inline void init(int, char **) {}
inline void shutdown() {}
// A mode without hands nearby, and one whose hand is so many standard deviations of 0.1 m beyond 0.8 m.
inline hmt_msgs::msg::PoseMixture mixture(unsigned char state, double deviations)
{
  hmt_msgs::msg::PoseMixture result;
  result.state = state;
  result.joint_names = {"pelvis", "right_hand"};
  const double weights[2] = {0.75, 0.25}, distances[2] = {5.0, 0.8 + 0.1 * deviations};
  for (int k = 0; k < 2; ++k) {
    hmt_msgs::msg::PoseComponent mode;
    mode.weight = weights[k];
    mode.joint_positions.resize(2);
    mode.joint_positions[1].x = 0.6 * distances[k];
    mode.joint_positions[1].z = -0.8 * distances[k];
    // 0.01 m^2 along the line to the origin, and 1 m^2 across.
    mode.joint_covariances.assign(18, 0.0);
    mode.joint_covariances[9] = 0.36 * 0.01 + 0.64;
    mode.joint_covariances[11] = mode.joint_covariances[15] = 0.48 * (1.0 - 0.01);
    mode.joint_covariances[17] = 0.64 * 0.01 + 0.36;
    result.components.push_back(mode);
  }
  return result;
}
inline void spin(const std::shared_ptr<Node> & node)
{
  using hmt_msgs::msg::PoseMixture;
  node->tick();  // nothing has come
  // 0.25 of 19 % is less than 5 %, and 0.25 of 21 % more.
  node->callback(mixture(PoseMixture::STATE_TRACKING, 0.8779));
  node->tick();
  node->callback(mixture(PoseMixture::STATE_TRACKING, 0.8064));
  node->tick();
  node->callback(mixture(PoseMixture::STATE_NOBODY, 0.0));
  node->tick();
  node->callback(mixture(PoseMixture::STATE_LOST, 9.0));
  node->tick();
  node->callback(mixture(PoseMixture::STATE_TRACKING, 9.0));
  node->tick();
  // One that does not tell of hands, of modes, of covariances.
  auto unknown = mixture(PoseMixture::STATE_TRACKING, 9.0);
  unknown.joint_names[1] = "right_knee";
  node->callback(unknown);
  node->tick();
  unknown = mixture(PoseMixture::STATE_TRACKING, 9.0);
  unknown.components.clear();
  node->callback(unknown);
  node->tick();
  unknown = mixture(PoseMixture::STATE_TRACKING, 9.0);
  unknown.components[1].joint_covariances.clear();
  node->callback(unknown);
  node->tick();
}
}
