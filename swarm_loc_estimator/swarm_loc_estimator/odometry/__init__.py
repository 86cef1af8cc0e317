"""Odometry tracks, preintegrated between any two instants."""
