// What docs/consumers.md uses of rclcpp: spinning hands one message over.
#pragma once
#include <cstdio>
#include <functional>
#include <memory>
#include <string>
#include <hmt_msgs/msg/pose_mixture.hpp>
#define RCLCPP_INFO(logger, ...) (void)(logger), std::printf(__VA_ARGS__)
namespace rclcpp {
struct Logger {};
struct Node {
  explicit Node(const std::string &) {}
  Logger get_logger() const {return {};}
  std::function<void(const hmt_msgs::msg::PoseMixture &)> callback;
  template<typename Message, typename Callback>
  std::shared_ptr<int> create_subscription(const std::string &, int, Callback given)
  {
    callback = given;
    return std::make_shared<int>(0);
  }
};
inline void init(int, char **) {}
inline void shutdown() {}
inline void spin(const std::shared_ptr<Node> & node)
{
  hmt_msgs::msg::PoseMixture mixture;
  mixture.state = mixture.STATE_TRACKING;
  mixture.joint_names = {"pelvis", "right_wrist"};
  const double weights[2] = {0.75, 0.25}, depths[2] = {2.1, 1.8};
  for (int k = 0; k < 2; ++k) {
    hmt_msgs::msg::PoseComponent mode;
    mode.weight = weights[k];
    mode.joint_positions.resize(2);
    mode.joint_positions[1].z = depths[k];
    mode.joint_covariances.assign(18, 0.0);
    mode.joint_covariances[17] = 0.01;
    mixture.components.push_back(mode);
  }
  node->callback(mixture);
}
}
