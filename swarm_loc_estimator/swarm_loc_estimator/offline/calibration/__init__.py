"""Fits of sensors, motion and noise to recordings with ground truth; no ROS."""
