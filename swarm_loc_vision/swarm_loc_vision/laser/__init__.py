"""Distances by a laser pointer next to an event camera."""
