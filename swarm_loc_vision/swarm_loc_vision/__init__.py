"""Detectors that turn the images of a robot swarm into marker detections."""
