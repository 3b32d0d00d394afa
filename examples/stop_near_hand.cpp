// Stops an arm while a hand of the person may be near; stop_near_hand.py explains it.
//
//     ros2 run hmt_ros_examples stop_near_hand --ros-args -r __ns:=/humans/bodies/p1

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <memory>
#include <string>
#include <vector>

#include <hmt_msgs/msg/pose_mixture.hpp>
#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/bool.hpp>

using hmt_msgs::msg::PoseMixture;
using std::chrono::steady_clock;
using std_msgs::msg::Bool;

constexpr double kNear = 0.8;    // m
constexpr double kDoubt = 0.05;  // probability
constexpr std::chrono::milliseconds kSilence(500);

bool ends_with(const std::string & name, const std::string & end)
{
  return name.size() >= end.size() && name.compare(name.size() - end.size(), end.size(), end) == 0;
}

// Probability that a hand is nearer to the origin; NaN where the mixture does not tell.
double hand_near(const PoseMixture & mixture, double near)
{
  std::vector<std::size_t> points;
  for (std::size_t j = 0; j < mixture.joint_names.size(); ++j) {
    const auto & name = mixture.joint_names[j];
    if (ends_with(name, "wrist") || ends_with(name, "hand")) {
      points.push_back(j);
    }
  }
  const auto count = mixture.joint_names.size();
  double total = points.empty() || mixture.components.empty() ? std::nan("") : 0.0;
  for (const auto & mode : mixture.components) {
    if (mode.joint_positions.size() != count || mode.joint_covariances.size() != 9 * count) {
      return std::nan("");
    }
    double none = 1.0;
    for (const auto j : points) {
      const auto & place = mode.joint_positions[j];
      const double p[3] = {place.x, place.y, place.z};
      const double distance = std::max(std::hypot(p[0], p[1], p[2]), 1e-9);
      // Along the line to the origin the covariance is that of the distance.
      double variance = 0.0;
      for (std::size_t a = 0; a < 3; ++a) {
        for (std::size_t b = 0; b < 3; ++b) {
          variance += p[a] * mode.joint_covariances[9 * j + 3 * a + b] * p[b];
        }
      }
      const double sigma = std::sqrt(std::max(variance, 1e-12)) / distance;
      none *= 1.0 - 0.5 * std::erfc((distance - near) / (sigma * std::sqrt(2.0)));
    }
    total += mode.weight * (1.0 - none);
  }
  return total;
}

// Whether to stop; true unless the mixture shows that no hand is near.
bool must_stop(const PoseMixture & mixture)
{
  if (mixture.state == PoseMixture::STATE_NOBODY) {
    return false;
  }
  return mixture.state != PoseMixture::STATE_TRACKING || !(hand_near(mixture, kNear) < kDoubt);
}

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  auto node = std::make_shared<rclcpp::Node>("stop_near_hand");
  auto publisher = node->create_publisher<Bool>("stop", 10);
  bool stop = true;
  auto at = steady_clock::now() - 2 * kSilence;
  auto subscription = node->create_subscription<PoseMixture>(
    "pose_mixture", 10, [&stop, &at](const PoseMixture & mixture) {
      stop = must_stop(mixture);
      at = steady_clock::now();
    });
  auto timer = node->create_wall_timer(
    std::chrono::milliseconds(100), [&stop, &at, publisher]() {
      Bool answer;
      answer.data = stop || steady_clock::now() - at > kSilence;
      publisher->publish(answer);
    });
  rclcpp::spin(node);
  rclcpp::shutdown();
  return 0;
}
