"""Messages in, messages out, without ROS: the part that a node and an offline replay share."""
