"""What nodes of cameras share: images and calibrations in, diagnostics out, and what is missing."""

from __future__ import annotations

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from swarm_loc_estimator.common.node import ConfiguredNode, Parameters
from swarm_loc_vision.common.calibrated_camera import CalibratedCamera
from swarm_loc_vision.common.camera import CameraError
from swarm_loc_vision.common.images import TRANSPORTS, ImageError

IMAGE_QOS = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Images that come faster than they can be read are dropped by the middleware, oldest first."""

_MESSAGES = {"sensor_msgs/msg/Image": Image, "sensor_msgs/msg/CompressedImage": CompressedImage}
_DIAGNOSTICS_PERIOD_S = 1.0
_THROTTLE_S = 30.0
_PATIENCE_S = 5.0
"""How long no image may come before the log names what is missing."""


class CameraNode(ConfiguredNode[Parameters]):
    """Receives the images of one camera and publishes what is found in them; a kind says what and how."""

    def __init__(self, name: str, parameters: type[Parameters], **node_arguments: Any) -> None:
        super().__init__(name, parameters, **node_arguments)
        self._cost_s = 0.0
        self._image_s = time.monotonic()
        self._has_said_missing = False

    def watch(self, camera: CalibratedCamera, transport_name: str, detections: Publisher) -> None:
        """Subscribe to the camera's topics.

        Args:
            camera: What they belong to.
            transport_name: One of `TRANSPORTS`.
            detections: Where what is found is published.
        """
        transport = TRANSPORTS[transport_name]
        self._source, self._detections = camera, detections
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

    def detect(self, message: Any) -> bytes:
        """The serialized detections of an image.

        Raises:
            ImageError: It was dropped, and counted.
        """
        raise NotImplementedError

    def figures(self) -> dict[str, str]:
        """What the diagnostics tell beside images, cost and drops."""
        raise NotImplementedError

    def trouble(self) -> str:
        """What is wrong beside missing topics, a sentence; empty: nothing. Asked once per diagnostics."""
        raise NotImplementedError

    def _on_camera_info(self, message: CameraInfo) -> None:
        try:
            self._source.calibrate(message)
        except CameraError as error:
            self.get_logger().error(str(error), throttle_duration_sec=_THROTTLE_S)

    def _on_image(self, message: Image | CompressedImage) -> None:
        begin_s = time.process_time()
        try:
            self._detections.publish(self.detect(message))
        except ImageError as error:
            self.get_logger().warning(f"dropped an image: {error}", throttle_duration_sec=_THROTTLE_S)
        finally:
            self._cost_s += time.process_time() - begin_s
            self._image_s = time.monotonic()

    def _on_diagnostics(self) -> None:
        source = self._source
        missing = self._told_missing()
        trouble = source.trouble or self.trouble() or missing
        values = {
            "images": str(source.images),
            **self.figures(),
            "CPU time per image [ms]": f"{1e3 * self._cost_s / max(source.images, 1):.3g}",
            **{f"dropped: {reason}": str(count) for reason, count in sorted(source.drops.items()) if count},
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

    def _told_missing(self) -> str:
        """What is missing; said in the log, too, once for each silence of the camera."""
        missing = self._missing()
        if not missing:
            self._has_said_missing = False
        elif not self._has_said_missing and self._silence_s() > _PATIENCE_S:
            self._has_said_missing = True
            self.get_logger().warning(f"waiting: {missing}")
        return missing

    def _missing(self) -> str:
        """The topic on which nothing has come, or nothing for a while."""
        if not self._source.is_calibrated and not self._source.trouble:
            return f"nothing has come on {self.resolve_topic_name('camera_info')}"
        if not self._source.images:
            return f"nothing has come on {self._image_topic}"
        if self._silence_s() > _PATIENCE_S:
            return f"nothing has come on {self._image_topic} for {self._silence_s():.0f} s"
        return ""

    def _silence_s(self) -> float:
        """How long no image has come."""
        return time.monotonic() - self._image_s
