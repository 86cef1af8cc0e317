"""The nodes that publish the markers of one camera, and their base.

    ./run swarm_loc_vision marker_detector_node --ros-args -r __ns:=/epuck1 -p family:=aruco_mip_36h12
    ./run swarm_loc_vision marker_bridge_node --ros-args -r __ns:=/epuck1 -p source:=apriltag

The detector subscribes to `camera_info` and to `image_raw` or `image_raw/compressed`. The bridge turns
markers that apriltag_ros or aruco_opencv have found into detections with covariances: it subscribes to
`camera_info` and to `apriltag_detections` or `aruco_detections`. Both publish `detections` with the stamps
and frames of what they receive, and `/diagnostics`. Parameters: see `doc/marker_detector_node.md` and
`doc/marker_bridge_node.md`.
"""

from __future__ import annotations

from functools import partial
from typing import Any, TypeVar

from rclpy.qos import qos_profile_sensor_data

from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_estimator.common.node import message_class, run_node
from swarm_loc_msgs.msg import MarkerDetectionArray
from swarm_loc_vision.common.camera_node import CameraNode, Input
from swarm_loc_vision.common.images import TRANSPORTS
from swarm_loc_vision.markers.detector import (
    CameraDetector,
    DetectorParameters,
    MarkersInUse,
    detector_maker,
    precompile,
)
from swarm_loc_vision.markers.foreign_markers import KINDS, ForeignMarkers, ForeignParameters

Markers = TypeVar("Markers", bound=MarkersInUse)

_MAX_MISFIT_SHARE = 0.1  # Of misfits since the last diagnostics; above it the calibration may be wrong


class MarkerNode(CameraNode[Markers]):
    """Publishes the markers of a camera."""

    def use_markers(self, camera: CameraDetector | ForeignMarkers, source: Input) -> None:
        """Publish what a camera finds in messages while the node is active, and compile what that needs."""
        self._camera = camera
        self._reported = (0, 0)  # markers and misfits
        if not is_precompiled(precompile):
            self.get_logger().info("compiling for this machine: about half a minute")
        precompile()
        self.use(camera, source, MarkerDetectionArray)

    def begin(self) -> None:
        """Publish the markers in messages."""
        super().begin()
        self.get_logger().info(f"ready: markers of family {self.params.family}")

    def figures(self) -> dict[str, str]:
        """Numbers of markers."""
        return {"markers": str(self._camera.markers), "markers that fit no square": str(self._camera.misfits)}

    def trouble(self) -> str:
        """A warning if many markers since the last call do not fit a square."""
        markers, misfits = self._camera.markers - self._reported[0], self._camera.misfits - self._reported[1]
        self._reported = self._camera.markers, self._camera.misfits
        if misfits <= _MAX_MISFIT_SHARE * markers:
            return ""
        return f"{misfits} of {markers} markers fit no square: is camera_info that of this camera?"


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


run_marker_detector = partial(run_node, "marker_detector_node", MarkerDetectorNode)


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


run_marker_bridge = partial(run_node, "marker_bridge_node", MarkerBridgeNode)
