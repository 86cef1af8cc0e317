"""Robots seen from above: camera pose by control points, anonymous detections."""
