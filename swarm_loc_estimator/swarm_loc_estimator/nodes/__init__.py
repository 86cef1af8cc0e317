"""ROS nodes, one per file: they convert messages, call the core and publish its results."""
