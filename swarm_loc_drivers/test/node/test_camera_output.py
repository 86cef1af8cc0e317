"""Nobody gets a simulated camera's image before its calibration."""

import numpy as np
import pytest
from node_world import Ros
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image

from swarm_loc_drivers.sim.epuck.epuck_world_node import CameraOutput
from swarm_loc_drivers.sim.render.lens import CameraModel

PIXELS = np.zeros((12, 16), np.uint8)
RELIABLE = QoSProfile(depth=10)


class _Publisher:
    """Stands for one of ROS's: what a test sets, and what was published."""

    def __init__(self) -> None:
        self.listeners = 0
        self.acknowledged = True
        self.published: list[object] = []

    def get_subscription_count(self) -> int:
        return self.listeners

    def wait_for_all_acked(self, _timeout: object) -> bool:
        return self.acknowledged

    def publish(self, message: object) -> None:
        self.published.append(message)


class _Camera:
    """A camera's output between publishers that a test commands."""

    def __init__(self) -> None:
        self.infos, self.images = _Publisher(), _Publisher()
        self.output = CameraOutput(self, "epuck1", CameraModel(width=16, height=12).calibration)

    def create_publisher(self, kind: type, _topic: str, _qos: object) -> _Publisher:
        return self.infos if kind is CameraInfo else self.images

    def expose(self) -> bool:
        return self.output.publish(1, lambda: PIXELS)


@pytest.fixture
def camera() -> _Camera:
    return _Camera()


def test_an_image_waits_until_a_calibration_was_received(camera: _Camera) -> None:
    camera.images.listeners = camera.infos.listeners = 1
    assert not camera.expose()  # this calibration may get lost
    camera.infos.acknowledged = False
    assert not camera.expose()
    camera.infos.acknowledged = True
    assert camera.expose()
    assert (len(camera.infos.published), len(camera.images.published)) == (3, 1)


def test_who_joins_later_gets_no_image_before_a_calibration_either(camera: _Camera) -> None:
    camera.images.listeners = camera.infos.listeners = 1
    camera.expose()
    assert camera.expose()
    camera.images.listeners = camera.infos.listeners = 2
    assert not camera.expose()
    assert camera.expose()


def test_who_wants_no_calibration_gets_images_at_once(camera: _Camera) -> None:
    camera.images.listeners = 1
    assert camera.expose()


def test_an_image_that_nobody_wants_is_not_drawn(camera: _Camera) -> None:
    camera.infos.listeners = 1
    for _ in range(2):
        assert not camera.output.publish(1, pytest.fail)


def test_over_dds_the_first_calibration_comes_before_the_first_image(ros: Ros) -> None:
    came: list[type] = []
    output = CameraOutput(ros.tester, "epuck1", CameraModel(width=16, height=12).calibration)
    for kind, topic in ((CameraInfo, "camera_info"), (Image, "image_raw")):
        ros.tester.create_subscription(kind, f"epuck1/{topic}", lambda one: came.append(type(one)), RELIABLE)

    def image_came() -> bool:
        output.publish(1, lambda: PIXELS)
        return Image in came

    ros.until(image_came)
    assert came[0] is CameraInfo
