"""A camera's marker detector as a ROS 2 node.

    ./run swarm_loc_vision marker_detector_node --ros-args -r __ns:=/epuck1 -p family:=aruco_mip_36h12

The node subscribes to `camera_info` and to `image_raw` or `image_raw/compressed`, and publishes `detections`
with the stamps and frames of the images, and `/diagnostics`. Parameters: see `doc/marker_detector_node.md`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from swarm_loc_estimator.common.node import run_node
from swarm_loc_vision.common.images import TRANSPORTS
from swarm_loc_vision.markers.camera_detector import CameraDetector
from swarm_loc_vision.markers.marker_node import MarkerNode
from swarm_loc_vision.markers.parameters import DetectorParameters, detector_maker


class MarkerDetectorNode(MarkerNode[DetectorParameters]):
    """Receives images and publishes detections."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("marker_detector", DetectorParameters, **node_arguments)
        self.autostart()

    def prepare(self) -> None:
        """Read which markers there are."""
        parameters = self.params
        gray_of = TRANSPORTS[parameters.image_transport].gray_of
        camera = CameraDetector(detector_maker(parameters), gray_of, parameters.settings.ambiguity)
        self.use_markers(camera, self.images(parameters.image_transport))


main = partial(run_node, "marker_detector_node", MarkerDetectorNode)
