"""Nodes of Droplets."""
