"""Images and detections as messages and in bags. No ROS here."""
