"""Messages in, messages out, without ROS: what a node and an offline replay both hold."""
