"""The fit of odometry, cameras and noise to ground truth."""
