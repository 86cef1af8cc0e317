"""The driver of one PushBot, without ROS."""
