"""The Droplet: bytes, sessions, driver and nodes."""
