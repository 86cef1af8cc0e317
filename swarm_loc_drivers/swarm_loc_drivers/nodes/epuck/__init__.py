"""Nodes of e-pucks."""
