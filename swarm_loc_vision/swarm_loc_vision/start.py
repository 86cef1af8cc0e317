"""The executables of this package; see the estimator's `start.py`."""

from __future__ import annotations

from swarm_loc_estimator.start import program

calibrate_laser = program("swarm_loc_vision.nodes.calibrate_laser_node")
aerial_camera_node = program("swarm_loc_vision.nodes.aerial_camera_node")
detect = program("swarm_loc_vision.cli.detect")
event_tracker_node = program("swarm_loc_vision.nodes.event_tracker_node")
marker_detector_node = program("swarm_loc_vision.nodes.marker_detector_node")
