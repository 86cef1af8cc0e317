"""The aerial camera node over DDS: overhead images in, anonymous detections in map out."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from node_world import Ros, newest_status, overrides, values_of
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from bench.aerial.pictures import DIAMETER, Look, control_pixels, draw_picture
from swarm_loc_msgs.msg import AnonymousDetectionArray
from swarm_loc_vision.aerial.aerial_camera_node import AerialCameraNode
from swarm_loc_vision.aerial.ground_control import ControlPoints, Ground, GroundFileError, save_ground

pytestmark = pytest.mark.usefixtures("frequent_diagnostics")

PICTURE = draw_picture(Look(tilt=0.3, robots=6), seed=2)
HEIGHT, WIDTH = PICTURE.gray.shape
FRAME = "aerial/camera_optical_frame"


@pytest.fixture
def points_file(tmp_path: Path) -> Path:
    places, pixels = control_pixels(PICTURE.ground, 6, np.random.default_rng(1))
    path = tmp_path / "points.yaml"
    save_ground(Ground(ControlPoints([f"p{k}" for k in range(6)], places, pixels)), path)
    return path


def image(number: int) -> Image:
    message = Image(height=HEIGHT, width=WIDTH, encoding="mono8", step=WIDTH)
    message.header.frame_id = FRAME
    message.header.stamp.sec = number
    message.data = PICTURE.gray.tobytes()
    return message


def compressed(number: int) -> CompressedImage:
    message = CompressedImage(format="mono8; jpeg compressed mono8")
    message.header.stamp.sec = number
    message.data = cv2.imencode(".jpg", PICTURE.gray)[1].tobytes()
    return message


def camera_info() -> CameraInfo:
    camera = PICTURE.ground.camera
    message = CameraInfo(height=HEIGHT, width=WIDTH, distortion_model=camera.model)
    message.k, message.d = camera.matrix.ravel(), list(camera.distortion)
    return message


class Overhead:
    """An overhead camera's driver, heard by a node, and what the node says."""

    def __init__(self, ros: Ros, **parameters: Any) -> None:
        self._ros = ros
        values = {"robot_diameter": DIAMETER, **parameters}
        ros.add(AerialCameraNode(namespace="aerial", parameter_overrides=overrides(**values)))
        tester = ros.tester
        is_raw = parameters.get("image_transport") != "compressed"
        kind, topic = (Image, "image_raw") if is_raw else (CompressedImage, "image_raw/compressed")
        self._make = image if is_raw else compressed
        self._image = tester.create_publisher(kind, f"aerial/{topic}", QoSProfile(depth=5))
        self._info = tester.create_publisher(CameraInfo, "aerial/camera_info", qos_profile_sensor_data)
        self.detections: list[AnonymousDetectionArray] = ros.listen(
            AnonymousDetectionArray, "aerial/detections"
        )
        self._diagnostics: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
        ros.until(lambda: self._image.get_subscription_count() and self._info.get_subscription_count())
        ros.until(lambda: tester.count_publishers("aerial/detections"))

    @property
    def status(self) -> DiagnosticStatus:
        """The newest diagnostics."""
        return newest_status(self._diagnostics, "aerial/aerial_camera")

    @property
    def values(self) -> dict[str, str]:
        """Its figures."""
        return values_of(self.status)

    def show(self, number: int, condition: Any) -> None:
        """Publish calibration and image until something is so; large messages may get lost."""

        def happened() -> bool:
            if condition():
                return True
            self._info.publish(camera_info())
            self._image.publish(self._make(number))
            return False

        self._ros.until(happened)


@pytest.mark.parametrize("transport", ["raw", "compressed"])
def test_images_become_places_in_map(ros: Ros, points_file: Path, transport: str) -> None:
    overhead = Overhead(ros, control_points_file=str(points_file), image_transport=transport)
    overhead.show(7, lambda: bool(overhead.detections))
    array = overhead.detections[0]
    assert (array.header.frame_id, array.header.stamp.sec) == ("map", 7)
    found = np.array([[one.x, one.y, one.theta] for one in array.detections])
    assert len(found) == len(PICTURE.poses)
    away = np.linalg.norm(found[:, None, :2] - PICTURE.poses[None, :, :2], axis=2)
    assert away.min(axis=0).max() < 0.004
    which = away.argmin(axis=0)
    turned = found[which, 2] - PICTURE.poses[:, 2]
    assert np.abs(np.angle(np.exp(1j * turned))).max() < 0.15
    for one in array.detections:
        assert np.linalg.eigvalsh(np.reshape(one.covariance, (3, 3)))[0] > 0.0
        there = PICTURE.ground.pixels(np.array([one.x, one.y, 0.0]))
        assert (one.u_px, one.v_px) == pytest.approx(tuple(there), abs=1.0)
    ros.until(
        lambda: overhead.status.message == "detecting" and overhead.values.get("robots per image") == "6"
    )
    assert overhead.values["control points"] == "6"
    assert float(overhead.values["reprojection residual [px]"]) < 0.1


def test_without_control_points_nothing_is_published_and_that_is_said(ros: Ros) -> None:
    overhead = Overhead(ros)
    overhead.show(1, lambda: int(overhead.values.get("dropped: no_control_points", "0")) > 0)
    assert overhead.status.level == DiagnosticStatus.WARN
    assert overhead.status.message == (
        "there are neither control points nor floor markers, without which nothing is published."
    )
    assert not overhead.detections


def test_points_that_do_not_fit_are_named_and_nothing_is_published(ros: Ros, points_file: Path) -> None:
    places, pixels = control_pixels(PICTURE.ground, 6, np.random.default_rng(1))
    pixels[2] += 40.0
    save_ground(Ground(ControlPoints([f"p{k}" for k in range(6)], places, pixels)), points_file)
    overhead = Overhead(ros, control_points_file=str(points_file))
    overhead.show(1, lambda: "control point p2 lies 56.6 px from where" in overhead.status.message)
    assert not overhead.detections


def test_a_wrong_file_stops_the_node(ros: Ros, tmp_path: Path) -> None:
    del ros
    (tmp_path / "points.yaml").write_text("points: {a: {x: 0, y: 0, u: 1, v: 1}}", encoding="utf-8")
    path = str(tmp_path / "points.yaml")
    with pytest.raises(GroundFileError, match="there are only 1 control points"):
        AerialCameraNode(parameter_overrides=overrides(control_points_file=path))
