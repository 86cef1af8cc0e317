"""Simulated Droplets."""
