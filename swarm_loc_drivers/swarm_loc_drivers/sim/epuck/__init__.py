"""Simulated e-pucks."""
