"""Batch estimation of a whole recording: poses, landmarks and parameters by robust least squares."""
