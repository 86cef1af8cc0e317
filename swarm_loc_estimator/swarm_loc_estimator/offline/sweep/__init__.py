"""Sweeps: many deterministic replays of a grid of settings, their table and plots."""
