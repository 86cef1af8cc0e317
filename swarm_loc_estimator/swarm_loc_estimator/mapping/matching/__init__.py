"""Beams of one scan against the lines of another."""
