"""What a driver does between bytes and messages, without ROS."""
