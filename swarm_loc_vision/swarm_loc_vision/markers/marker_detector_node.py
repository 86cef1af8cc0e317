"""A camera's marker detector as a ROS 2 node.

    ./run swarm_loc_vision marker_detector_node --ros-args -r __ns:=/epuck1 -p family:=aruco_mip_36h12

The node subscribes to `camera_info` and to `image_raw` or `image_raw/compressed`, and publishes `detections`
with the stamps and frames of the images, and `/diagnostics`. Parameters: see `doc/marker_detector_node.md`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from rclpy.qos import QoSProfile

from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_estimator.common.node import run_node
from swarm_loc_msgs.msg import MarkerDetectionArray
from swarm_loc_vision.common.camera_node import CameraNode
from swarm_loc_vision.common.images import TRANSPORTS
from swarm_loc_vision.markers.camera_detector import CameraDetector
from swarm_loc_vision.markers.detector import precompile
from swarm_loc_vision.markers.parameters import DetectorParameters, detector_maker

_MAX_MISFIT_SHARE = 0.1
"""Largest share of misfits since the last diagnostics; above it the calibration may be wrong."""


class MarkerDetectorNode(CameraNode[DetectorParameters]):
    """Receives images and publishes detections."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("marker_detector", DetectorParameters, **node_arguments)
        parameters = self.params
        create_detector = detector_maker(parameters)
        if not is_precompiled(precompile):
            self.get_logger().info("compiling the detector for this machine: about half a minute")
        precompile()
        gray_of = TRANSPORTS[parameters.image_transport].gray_of
        self._camera = CameraDetector(create_detector, gray_of, parameters.settings.ambiguity)
        self._told = (0, 0)  # markers and misfits
        publisher = self.create_publisher(MarkerDetectionArray, "detections", QoSProfile(depth=10))
        self.watch(self._camera, parameters.image_transport, publisher)
        self.get_logger().info(f"ready: markers of family {parameters.family}")

    def detect(self, message: Any) -> bytes:
        """The serialized detections of an image; see `CameraDetector.detect`."""
        return self._camera.detect(message)

    def figures(self) -> dict[str, str]:
        """Numbers of markers."""
        camera = self._camera
        return {"markers": str(camera.markers), "markers that fit no square": str(camera.misfits)}

    def trouble(self) -> str:
        """A warning if many markers since the last call do not fit a square."""
        camera = self._camera
        markers, misfits = camera.markers - self._told[0], camera.misfits - self._told[1]
        self._told = camera.markers, camera.misfits
        if misfits <= _MAX_MISFIT_SHARE * markers:
            return ""
        return f"{misfits} of {markers} markers fit no square: is camera_info that of this camera?"


main = partial(run_node, "marker_detector_node", MarkerDetectorNode)
