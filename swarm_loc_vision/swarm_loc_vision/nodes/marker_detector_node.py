"""A camera's marker detector as a ROS 2 node.

    ./run swarm_loc_vision marker_detector_node --ros-args -r __ns:=/epuck1 -p family:=aruco_mip_36h12

It subscribes to `image_raw` and `camera_info` and publishes `detections` with the pictures' own stamps and
frames, and `/diagnostics`. Parameters: see `detector_parameters.py` and the package's README.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from numpy.typing import NDArray
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, Image

from swarm_loc_estimator.core.compiled import is_warm
from swarm_loc_estimator.io.messages import encode_detections
from swarm_loc_estimator.nodes.declare import declare_parameters
from swarm_loc_estimator.nodes.running import run_node, spin
from swarm_loc_msgs.msg import MarkerDetectionArray
from swarm_loc_vision.core.camera import Camera, CameraError
from swarm_loc_vision.core.detector import MarkerDetector
from swarm_loc_vision.core.gray import ImageError, gray_image
from swarm_loc_vision.core.rows import detection_rows
from swarm_loc_vision.core.warm_up import CORE, warm_up
from swarm_loc_vision.nodes.detector_parameters import DetectorParameters, detector_maker

IMAGE_QOS = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Pictures that come faster than they can be read are dropped by the middleware, oldest first."""

_SECOND = 1_000_000_000
_DIAGNOSTICS_PERIOD_S = 1.0
_THROTTLE_S = 30.0
_PATIENCE_S = 5.0
"""How long nothing may come before the log names what is missing."""


class MarkerDetectorNode(Node):
    """Receives pictures, lets the core find the markers, publishes.

    Args:
        node_arguments: Further arguments of `rclpy.node.Node`.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("marker_detector", **node_arguments)
        self._wishes = declare_parameters(self, DetectorParameters)
        self._create_detector = detector_maker(self._wishes)
        if not is_warm(CORE):
            self.get_logger().info("compiling the detector for this machine: about half a minute")
        warm_up()
        self._camera: Camera | None = None
        self._camera_trouble = ""
        self._detector: MarkerDetector | None = None
        self._drops: Counter[str] = Counter()
        self._images = self._found = 0
        self._cost_s = 0.0
        self._waiting_since_s: float | None = time.monotonic()
        self._detections = self.create_publisher(MarkerDetectionArray, "detections", QoSProfile(depth=10))
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        self.create_subscription(CameraInfo, "camera_info", self._on_camera_info, qos_profile_sensor_data)
        reliability = QoSOverridingOptions([QoSPolicyKind.RELIABILITY])
        self.create_subscription(
            Image, "image_raw", self._on_image, IMAGE_QOS, qos_overriding_options=reliability
        )
        # by a clock that runs also while simulated time stands still
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_DIAGNOSTICS_PERIOD_S, self._on_diagnostics, clock=steady)
        self.get_logger().info(f"ready: markers of family {self._wishes.family}")

    def _on_camera_info(self, message: CameraInfo) -> None:
        """Take over the calibration; the detector is made anew only when it has changed."""
        try:
            camera = camera_of(message)
        except CameraError as error:
            self._camera, self._detector = None, None
            self._camera_trouble = str(error)
            self.get_logger().error(str(error), throttle_duration_sec=_THROTTLE_S)
            return
        self._camera_trouble = ""
        if camera != self._camera:
            self._camera, self._detector = camera, self._create_detector(camera)

    def _on_image(self, message: Image) -> None:
        begin_s = time.process_time()
        self._images += 1
        try:
            detector, camera = self._calibrated()
            gray = gray_of(message, camera)
        except ImageError as error:
            self._drops[error.reason] += 1
            self.get_logger().warning(f"dropped a picture: {error}", throttle_duration_sec=_THROTTLE_S)
            return
        detections = detector.detect(gray)
        rows = detection_rows(detections, self._wishes.settings.ambiguity)
        stamp = message.header.stamp
        stamp_ns = stamp.sec * _SECOND + stamp.nanosec
        self._detections.publish(encode_detections(message.header.frame_id, stamp_ns, rows))
        self._drops["no_pose"] += len(detections) - len(rows)
        self._found += len(rows)
        self._cost_s += time.process_time() - begin_s

    def _calibrated(self) -> tuple[MarkerDetector, Camera]:
        """The detector and its camera.

        Raises:
            ImageError: The camera is not known; without it there are no poses.
        """
        if self._detector is None or self._camera is None:
            raise ImageError("no_calibration", self._camera_trouble or "no camera_info has come yet.")
        return self._detector, self._camera

    def _on_diagnostics(self) -> None:
        trouble = self._trouble()
        values = {
            "pictures": str(self._images),
            "markers": str(self._found),
            "CPU time per picture [ms]": f"{1e3 * self._cost_s / max(self._images, 1):.3g}",
            **{f"dropped: {reason}": str(count) for reason, count in sorted(self._drops.items()) if count},
        }
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if trouble else DiagnosticStatus.OK,
            name=f"{self.get_namespace().strip('/')}/{self.get_name()}".lstrip("/"),
            message=trouble or "detecting",
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def _trouble(self) -> str:
        """What keeps the node from detecting; said in the log, too, after a while and once."""
        missing = self._missing()
        if not missing:
            self._waiting_since_s = None
        elif self._waiting_since_s is not None and time.monotonic() > self._waiting_since_s + _PATIENCE_S:
            self._waiting_since_s = None
            self.get_logger().warning(f"waiting: {missing}")
        return self._camera_trouble or missing

    def _missing(self) -> str:
        """The topic on which nothing has come."""
        if self._camera is None and not self._camera_trouble:
            return f"nothing has come on {self.resolve_topic_name('camera_info')}"
        if not self._images:
            return f"nothing has come on {self.resolve_topic_name('image_raw')}"
        return ""


def camera_of(message: CameraInfo) -> Camera:
    """The camera that a sensor_msgs/CameraInfo describes.

    Raises:
        CameraError: It is not calibrated, or its pictures are cut or binned.
    """
    roi = message.roi
    is_cut = (roi.width, roi.height) not in ((0, 0), (message.width, message.height))
    if is_cut or max(message.binning_x, message.binning_y) > 1:
        raise CameraError("the camera's pictures are cut or binned; only whole ones can be read.")
    return Camera.from_matrix(
        (message.width, message.height),
        np.reshape(message.k, (3, 3)),
        tuple(message.d),
        message.distortion_model,
    )


def gray_of(message: Image, camera: Camera) -> NDArray[np.uint8]:
    """The picture of a sensor_msgs/Image.

    Raises:
        ImageError: It cannot be read, or is not of the size that the camera is calibrated for.
    """
    if (message.width, message.height) != (camera.width, camera.height):
        raise ImageError(
            "size",
            f"the picture has {message.width} x {message.height} pixels,"
            f" but the camera is calibrated for {camera.width} x {camera.height}.",
        )
    return gray_image(
        message.encoding,
        message.width,
        message.height,
        message.step,
        message.data,
        is_bigendian=bool(message.is_bigendian),
    )


def main() -> int:
    """Run until SIGINT or SIGTERM; 1 when a parameter or the swarm description cannot be used."""
    return run_node("marker_detector_node", MarkerDetectorNode, spin)


if __name__ == "__main__":
    sys.exit(main())
