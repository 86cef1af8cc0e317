"""The e-puck: bytes, sessions, odometry, driver and node."""
