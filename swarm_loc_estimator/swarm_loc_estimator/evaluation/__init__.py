"""Replay of bags, errors against ground truth, reports."""
