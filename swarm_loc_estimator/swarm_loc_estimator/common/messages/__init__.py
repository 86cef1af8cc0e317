"""ROS messages as bytes: encoding and decoding."""
