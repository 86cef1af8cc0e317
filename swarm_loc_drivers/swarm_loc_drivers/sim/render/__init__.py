"""Rendered cameras: exact area coverage of planar patches, motion blur, sensor noise. No ROS."""
