"""ROS 2 nodes, and what they share with offline runs of the same thing.

Only `filter_node` imports rclpy. What the node computes and publishes comes from `filter_session`,
which offline replay calls with the same messages.
"""
