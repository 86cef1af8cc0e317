"""Poses of markers and of bodies that carry several."""
