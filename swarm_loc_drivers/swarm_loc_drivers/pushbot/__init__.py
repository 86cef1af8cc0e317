"""The PushBot: bytes, session, odometry, driver and nodes."""
