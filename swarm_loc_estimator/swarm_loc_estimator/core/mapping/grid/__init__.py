"""Grids: occupancy and visits."""
