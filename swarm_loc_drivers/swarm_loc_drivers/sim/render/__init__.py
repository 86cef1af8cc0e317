"""What simulated cameras show: exact area coverage of planar patches, motion blur, noise. No ROS."""
