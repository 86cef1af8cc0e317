"""Base of the nodes of cameras: subscriptions, diagnostics, and warnings about missing topics."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from swarm_loc_estimator.common.health import PATIENCE_S, Report, drop_values, level_of
from swarm_loc_estimator.common.node import ManagedNode, Parameters
from swarm_loc_vision.common.camera import CameraError
from swarm_loc_vision.common.images import TRANSPORTS, Calibration, ImageError

IMAGE_QOS = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Where images arrive faster than they are processed, the middleware drops the oldest ones."""

_MESSAGES = {"sensor_msgs/msg/Image": Image, "sensor_msgs/msg/CompressedImage": CompressedImage}
_THROTTLE_S = 30.0


class Input(NamedTuple):
    """A topic with a camera's images, or with what was found in them."""

    message_class: type  # Class of its messages
    topic: str  # Its name, with its namespace
    qos: QoSProfile  # Of the subscription


class CameraNode(ManagedNode[Parameters]):
    """Receives the images of one camera and publishes what is found in them; subclasses report on it."""

    def images(self, transport_name: str) -> Input:
        """The camera's images by one of `TRANSPORTS`."""
        transport = TRANSPORTS[transport_name]
        # as image_transport does: a remapping of image_raw applies to all of its transports
        topic = self.resolve_topic_name("image_raw") + transport.suffix
        return Input(_MESSAGES[transport.message_type], topic, IMAGE_QOS)

    def use(self, camera: Calibration, source: Input, detections: type) -> None:
        """Publish what a camera finds in messages of a source, as `detections`, while the node is active."""
        self._source, self._input, self._found = camera, source, detections
        self._cost_s = 0.0

    def begin(self) -> None:
        """Publish what is found in messages."""
        source, self._topic = self._input, self._input.topic
        self._detections = self.create_publisher(self._found, "detections", QoSProfile(depth=10))
        overriding = QoSOverridingOptions([QoSPolicyKind.RELIABILITY])
        for kind, topic, receive, qos in (
            (CameraInfo, "camera_info", self._on_camera_info, qos_profile_sensor_data),
            (source.message_class, self._topic, self._on_message, source.qos),
        ):
            self.create_subscription(kind, topic, receive, qos, qos_overriding_options=overriding)

    def figures(self) -> dict[str, str]:
        """Values for the diagnostics in addition to images, cost and drops."""
        raise NotImplementedError

    def trouble(self) -> str:
        """What is wrong but missing topics, a sentence; empty: nothing. Called once per diagnostics."""
        raise NotImplementedError

    def _on_camera_info(self, message: CameraInfo) -> None:
        if not self.is_active:
            return
        try:
            self._source.calibrate(message)
        except CameraError as error:
            self.get_logger().error(str(error), throttle_duration_sec=_THROTTLE_S)

    def _on_message(self, message: Any) -> None:
        if not self.is_active:
            return
        begin_s = time.process_time()
        try:
            self._detections.publish(self._source.detect(message))
        except ImageError as error:
            self.health.drop(error.reason, str(error))
        finally:
            self._cost_s += time.process_time() - begin_s
            self.health.received(self._topic)

    def report(self) -> None:
        """Publish the state of the camera."""
        source, missing = self._source, self.health.silence(self._topic)
        if source.camera is None and not source.trouble:
            missing = f"no messages received on {self.resolve_topic_name('camera_info')}"
        self.health.warn_of("missing", {"": missing} if missing else {}, PATIENCE_S)
        self.health.warn_of_drops()
        trouble = source.trouble or self.trouble() or missing
        values: dict[str, object] = {
            "images": source.images,
            **self.figures(),
            "CPU time per image [ms]": f"{1e3 * self._cost_s / max(source.images, 1):.3g}",
            **drop_values(source.drops),
        }
        self.publish_reports(Report(self.status_name, trouble or "detecting", level_of(trouble), values))
