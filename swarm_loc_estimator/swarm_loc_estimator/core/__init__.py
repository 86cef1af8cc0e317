"""The estimator itself: no ROS, no files, no clock."""
