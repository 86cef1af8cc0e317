"""Distances by a laser pointer beside an event camera."""
