"""Simulated swarms: numpy only, seeded, no ROS."""
