"""The drivers as ROS 2 nodes."""
