"""Robustness: robots whose bytes are corrupted, and odometry with wrong stamps."""
