"""Relative poses and gains from brightness matrices."""
