"""Replay of bags, errors against ground truth, reports, calibration and datasets."""
