"""The executables of this package, each imported only when it is started."""

from __future__ import annotations

from swarm_loc_estimator.common.command_line import Program

calibrate_laser = Program("swarm_loc_vision.laser.calibrate_laser_node")
aerial_camera_node = Program("swarm_loc_vision.aerial.aerial_camera_node")
detect = Program("swarm_loc_vision.markers.detect")
locate_camera = Program("swarm_loc_vision.aerial.locate_camera")
event_tracker_node = Program("swarm_loc_vision.events.event_tracker_node")
marker_bridge_node = Program("swarm_loc_vision.markers.marker_nodes", "run_marker_bridge")
marker_detector_node = Program("swarm_loc_vision.markers.marker_nodes", "run_marker_detector")
print_markers = Program("swarm_loc_vision.sheets.print_markers")
