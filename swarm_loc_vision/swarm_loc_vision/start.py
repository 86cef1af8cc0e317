"""The executables of this package; see the estimator's `start.py`."""

from __future__ import annotations

from swarm_loc_estimator.start import program

detect = program("swarm_loc_vision.cli.detect")
marker_detector_node = program("swarm_loc_vision.nodes.marker_detector_node")
