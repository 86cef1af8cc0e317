"""Planar geometry and small matrices, for arrays and inside compiled code."""
