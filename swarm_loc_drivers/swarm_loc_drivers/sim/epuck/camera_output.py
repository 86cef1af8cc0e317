"""A simulated camera's topics: `image_raw` and `camera_info`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from swarm_loc_drivers.common.calibration_file import CameraCalibration
from swarm_loc_drivers.common.ros_messages import camera_info_message, image_message, stamp_message

_QOS = QoSProfile(depth=5)
"""Reliable: who wants so gets every image, and who listens with best effort gets what comes."""


class CameraOutput:
    """Publishes what one camera takes.

    Args:
        node: Whose publishers.
        robot: Name of the robot.
        calibration: Of its camera.
    """

    def __init__(self, node: Node, robot: str, calibration: CameraCalibration) -> None:
        self._calibration = calibration
        self._frame_id = f"{robot}/camera_optical_frame"
        self._infos = node.create_publisher(CameraInfo, f"{robot}/camera_info", _QOS)
        self._images = node.create_publisher(Image, f"{robot}/image_raw", _QOS)
        self._sent_to = self._received_by = 0  # listeners to camera_info: at the last one, with one received

    def publish(self, stamp_ns: int, draw: Callable[[], NDArray[np.uint8]]) -> bool:
        """Publish the calibration, and the image where somebody listens; whether it was published.

        Nobody gets an image before the first calibration for which he listens, since he would drop it.

        Args:
            stamp_ns: Of the exposure.
            draw: Makes the image (height, width).
        """
        listeners = self._infos.get_subscription_count()
        if self._infos.wait_for_all_acked(Duration()):
            self._received_by = self._sent_to
        header = Header(stamp=stamp_message(stamp_ns), frame_id=self._frame_id)
        self._infos.publish(camera_info_message(self._calibration, header))
        self._sent_to = listeners
        if not self._images.get_subscription_count() or self._received_by < listeners:
            return False
        self._images.publish(image_message(draw(), stamp_ns, self._frame_id))
        return True
