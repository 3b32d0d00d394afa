"""The logic that nodes and offline replay share: messages in, messages out, without ROS."""
