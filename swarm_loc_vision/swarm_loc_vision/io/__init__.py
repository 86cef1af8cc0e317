"""What detectors read and write besides pictures themselves. No ROS here."""
