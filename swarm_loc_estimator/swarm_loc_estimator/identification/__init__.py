"""Identification of robots among anonymous detections in aerial images."""
