"""The first pose of a robot whose start is unknown."""
