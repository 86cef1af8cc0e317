"""A camera's marker detector as a ROS 2 node.

    ./run swarm_loc_vision marker_detector_node --ros-args -r __ns:=/epuck1 -p family:=aruco_mip_36h12

It subscribes to `camera_info`, and to `image_raw` or `image_raw/compressed`, and publishes `detections` with
the images' own stamps and frames, and `/diagnostics`. Parameters: see
`doc/marker_detector_node.md`.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from swarm_loc_estimator.numerics.jit import is_warm
from swarm_loc_estimator.ros.running import ConfiguredNode, run_node
from swarm_loc_msgs.msg import MarkerDetectionArray
from swarm_loc_vision.core.imaging.camera import CameraError
from swarm_loc_vision.core.imaging.gray import ImageError
from swarm_loc_vision.core.warm_up import WARM_UP, warm_up
from swarm_loc_vision.io.camera_detector import TRANSPORTS, CameraDetector
from swarm_loc_vision.nodes.detector_parameters import DetectorParameters, detector_maker

IMAGE_QOS = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Images that come faster than they can be read are dropped by the middleware, oldest first."""

_MESSAGES = {"sensor_msgs/msg/Image": Image, "sensor_msgs/msg/CompressedImage": CompressedImage}
_DIAGNOSTICS_PERIOD_S = 1.0
_THROTTLE_S = 30.0
_PATIENCE_S = 5.0
"""How long no image may come before the log names what is missing."""
_MAX_MISFIT_SHARE = 0.1
"""Of the markers since the last diagnostics; if more fit no square the camera is not the calibrated one."""


class MarkerDetectorNode(ConfiguredNode[DetectorParameters]):
    """Receives images, lets the core find the markers, publishes."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("marker_detector", DetectorParameters, **node_arguments)
        parameters = self.chosen
        create_detector = detector_maker(parameters)
        if not is_warm(WARM_UP):
            self.get_logger().info("compiling the detector for this machine: about half a minute")
        warm_up()
        transport = TRANSPORTS[parameters.image_transport]
        self._camera = CameraDetector(create_detector, transport.gray_of, parameters.settings.ambiguity)
        self._cost_s = 0.0
        self._image_s = time.monotonic()
        self._has_said_missing = False
        self._told = (0, 0)  # markers and misfits
        self._detections = self.create_publisher(MarkerDetectionArray, "detections", QoSProfile(depth=10))
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        overriding = QoSOverridingOptions([QoSPolicyKind.RELIABILITY])
        self.create_subscription(
            CameraInfo,
            "camera_info",
            self._on_camera_info,
            qos_profile_sensor_data,
            qos_overriding_options=overriding,
        )
        # as image_transport does: who renames image_raw means all of its transports
        self._image_topic = self.resolve_topic_name("image_raw") + transport.suffix
        self.create_subscription(
            _MESSAGES[transport.message_type],
            self._image_topic,
            self._on_image,
            IMAGE_QOS,
            qos_overriding_options=overriding,
        )
        # by a clock that runs also while simulated time stands still
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_DIAGNOSTICS_PERIOD_S, self._on_diagnostics, clock=steady)
        self.get_logger().info(f"ready: markers of family {parameters.family}")

    def _on_camera_info(self, message: CameraInfo) -> None:
        try:
            self._camera.calibrate(message)
        except CameraError as error:
            self.get_logger().error(str(error), throttle_duration_sec=_THROTTLE_S)

    def _on_image(self, message: Image | CompressedImage) -> None:
        begin_s = time.process_time()
        try:
            self._detections.publish(self._camera.detect(message))
        except ImageError as error:
            self.get_logger().warning(f"dropped an image: {error}", throttle_duration_sec=_THROTTLE_S)
        finally:
            self._cost_s += time.process_time() - begin_s
            self._image_s = time.monotonic()

    def _on_diagnostics(self) -> None:
        trouble, camera = self._trouble() or self._misfit(), self._camera
        self._told = camera.markers, camera.misfits
        values = {
            "images": str(camera.images),
            "markers": str(camera.markers),
            "markers that fit no square": str(camera.misfits),
            "CPU time per image [ms]": f"{1e3 * self._cost_s / max(camera.images, 1):.3g}",
            **{f"dropped: {reason}": str(count) for reason, count in sorted(camera.drops.items()) if count},
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
        """What keeps the node from detecting; said in the log, too, once for each silence of the camera."""
        missing = self._missing()
        if not missing:
            self._has_said_missing = False
        elif not self._has_said_missing and self._silence_s() > _PATIENCE_S:
            self._has_said_missing = True
            self.get_logger().warning(f"waiting: {missing}")
        return self._camera.trouble or missing

    def _misfit(self) -> str:
        """That many of the markers since the last diagnostics fit no square."""
        markers, misfits = self._camera.markers - self._told[0], self._camera.misfits - self._told[1]
        if misfits <= _MAX_MISFIT_SHARE * markers:
            return ""
        return f"{misfits} of {markers} markers fit no square: is camera_info that of this camera?"

    def _missing(self) -> str:
        """The topic on which nothing has come, or nothing for a while."""
        if not self._camera.is_calibrated and not self._camera.trouble:
            return f"nothing has come on {self.resolve_topic_name('camera_info')}"
        if not self._camera.images:
            return f"nothing has come on {self._image_topic}"
        if self._silence_s() > _PATIENCE_S:
            return f"nothing has come on {self._image_topic} for {self._silence_s():.0f} s"
        return ""

    def _silence_s(self) -> float:
        """How long no image has come."""
        return time.monotonic() - self._image_s


main = partial(run_node, "marker_detector_node", MarkerDetectorNode)
