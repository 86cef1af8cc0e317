"""Calibration of sensors, motion and noise from recordings with ground truth."""
