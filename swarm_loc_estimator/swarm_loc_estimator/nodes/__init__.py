"""The ROS nodes, one per file: convert, call the core, publish."""
