"""Turns markers that apriltag_ros or aruco_opencv have found into detections with covariances.

    ./run swarm_loc_vision marker_bridge_node --ros-args -r __ns:=/epuck1 -p source:=apriltag

The node subscribes to `camera_info` and to `apriltag_detections` or `aruco_detections`, and publishes
`detections` and `/diagnostics`. Parameters: see `doc/marker_bridge_node.md`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from rclpy.qos import qos_profile_sensor_data

from swarm_loc_estimator.common.node import message_class, run_node
from swarm_loc_vision.common.camera_node import Input
from swarm_loc_vision.markers.foreign_markers import KINDS, ForeignMarkers, ForeignParameters
from swarm_loc_vision.markers.marker_node import MarkerNode


class MarkerBridgeNode(MarkerNode[ForeignParameters]):
    """Receives markers of another detector and publishes detections."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("marker_bridge", ForeignParameters, **node_arguments)
        self.autostart()

    def prepare(self) -> None:
        """Read which markers there are, and find the messages of the other detector."""
        camera, kind = ForeignMarkers(self.params), KINDS[self.params.source]
        topic = self.resolve_topic_name(kind.topic)
        self.use_markers(camera, Input(message_class(kind.message_type), topic, qos_profile_sensor_data))


main = partial(run_node, "marker_bridge_node", MarkerBridgeNode)
