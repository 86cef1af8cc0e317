"""Simulated runs as bags."""
