"""Integrity: fault detection, noise inflation and loss of track."""
