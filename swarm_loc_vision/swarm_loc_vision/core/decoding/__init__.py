"""Marker families, ids and their codes."""
