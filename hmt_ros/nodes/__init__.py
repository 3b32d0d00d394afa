"""ROS 2 nodes: topics, services and diagnostics around the sessions of `hmt_ros.sessions`."""
