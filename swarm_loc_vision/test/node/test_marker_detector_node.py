"""The marker detector's node: images to detections, managed or not."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from managed_node import ACTIVATE, CLEANUP, CONFIGURE, DEACTIVATE, Manager
from node_world import PATIENCE_S, Ros, newest_status, overrides, values_of, write_swarm
from rcl_interfaces.msg import Log
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from bench.vision.scenes import CAMERA, HEIGHT, WIDTH, Look, random_scene
from swarm_loc_estimator.common import health
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_msgs.msg import MarkerDetection, MarkerDetectionArray, SwarmPoses
from swarm_loc_vision.common import camera_node
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.marker_nodes import MarkerDetectorNode

pytestmark = pytest.mark.usefixtures("frequent_diagnostics")

FAMILY = "aruco_mip_36h12"
IMAGE, TRUTHS = random_scene(np.random.default_rng(4), family_named(FAMILY), 8, Look())
FRAME = "epuck1/camera_optical_frame"


def image(number: int, encoding: str = "mono8", channels: int = 1) -> Image:
    """The scene; its stamp is its number."""
    message = Image(height=HEIGHT, width=WIDTH, encoding=encoding, step=channels * WIDTH)
    message.header.frame_id = FRAME
    message.header.stamp.sec = number
    message.data = np.repeat(IMAGE[..., None], channels, axis=2).tobytes()
    return message


def compressed(number: int, how: str = "jpeg", suffix: str = ".jpg") -> CompressedImage:
    """The scene in a file's bytes."""
    message = CompressedImage(format=how)
    message.header.frame_id = FRAME
    message.header.stamp.sec = number
    message.data = cv2.imencode(suffix, IMAGE)[1].tobytes()
    return message


def camera_info(**changes: Any) -> CameraInfo:
    """The scene's camera."""
    message = CameraInfo(height=HEIGHT, width=WIDTH, distortion_model="plumb_bob", d=[0.0] * 5)
    message.k = CAMERA.ravel()
    for name, value in changes.items():
        setattr(message, name, value)
    return message


class Camera:
    """A camera's driver, heard by a node, and what the node says."""

    def __init__(
        self, ros: Ros, qos: QoSProfile = qos_profile_sensor_data, namespace: str = "", **parameters: Any
    ) -> None:
        self._ros, self._name = ros, f"{namespace}/marker_detector".strip("/")
        given = overrides(family=FAMILY, **parameters)
        ros.add(MarkerDetectorNode(namespace=namespace, parameter_overrides=given))
        tester = ros.tester
        kind, topic = (
            (CompressedImage, "image_raw/compressed")
            if parameters.get("image_transport") == "compressed"
            else (Image, "image_raw")
        )
        self.images = tester.create_publisher(kind, f"{namespace}/{topic}", qos)
        self._info = tester.create_publisher(CameraInfo, f"{namespace}/camera_info", qos)
        found = f"{namespace}/detections"
        self.detections: list[MarkerDetectionArray] = ros.listen(MarkerDetectionArray, found)
        self._diagnostics: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
        ros.until(lambda: self.images.get_subscription_count() and self._info.get_subscription_count())
        ros.until(lambda: tester.count_publishers(found) and tester.count_publishers("/diagnostics"))

    def calibrate(self, message: CameraInfo, words: str) -> None:
        """Publish a calibration until the node tells of it in its diagnostics."""
        self._ros.publish_until(self._info, message, lambda: words in self.status().message)

    def status(self) -> DiagnosticStatus:
        """The newest diagnostics."""
        return newest_status(self._diagnostics, self._name)

    def values(self) -> dict[str, str]:
        """Its figures."""
        return values_of(self.status())

    def see(self, message: Image | CompressedImage) -> MarkerDetectionArray:
        """Publish an image until its detections come; large best-effort messages may get lost."""
        stamp = message.header.stamp.sec
        self._ros.publish_until(
            self.images, message, lambda: any(d.header.stamp.sec == stamp for d in self.detections)
        )
        return next(d for d in self.detections if d.header.stamp.sec == stamp)

    def see_dropped(self, message: Image | CompressedImage, reason: str) -> None:
        """Publish an image until it is counted as dropped."""
        self._ros.publish_until(self.images, message, lambda: f"dropped: {reason}" in self.values())


def test_images_become_detections_with_their_stamp_and_frame(ros: Ros) -> None:
    camera = Camera(ros)
    camera.calibrate(camera_info(), "image_raw")
    for number, (encoding, channels) in enumerate((("mono8", 1), ("rgb8", 3)), start=1):
        array = camera.see(image(number, encoding, channels))
        assert array.header.frame_id == FRAME
        found = {detection.id: detection for detection in array.detections}
        assert set(found) == {truth.marker_id for truth in TRUTHS}
        for truth in TRUTHS:
            detection = found[truth.marker_id]
            assert np.reshape(detection.corners_px, (4, 2)) == pytest.approx(truth.corners, abs=0.5)
            assert detection.family == MarkerDetection.FAMILY_ARUCO_MIP_36H12
            assert detection.content in (MarkerDetection.CONTENT_POSE, MarkerDetection.CONTENT_POSE_TWO)
            covariance = np.reshape(detection.pose.covariance, (6, 6))
            assert np.linalg.eigvalsh(covariance)[0] > 0.0
            depth = detection.pose.pose.position.z * truth.length / 0.05
            assert depth == pytest.approx(truth.position[2], rel=0.05)
    ros.until(lambda: camera.status().message == "detecting")
    assert camera.status().level == DiagnosticStatus.OK


@pytest.mark.parametrize("durability", [DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL])
@pytest.mark.parametrize("reliability", [ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE])
def test_cameras_that_publish_in_any_way_are_heard(
    ros: Ros, reliability: ReliabilityPolicy, durability: DurabilityPolicy
) -> None:
    camera = Camera(ros, QoSProfile(depth=5, reliability=reliability, durability=durability))
    camera.calibrate(camera_info(), "image_raw")
    assert camera.see(image(1)).detections


def test_a_camera_that_falls_silent_is_told_each_time(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (camera_node, health):
        monkeypatch.setattr(module, "PATIENCE_S", 0.3)
    silence = "no messages received on /image_raw for "
    logged: list[Log] = ros.listen(Log, "/rosout")
    camera = Camera(ros)
    camera.calibrate(camera_info(), "image_raw")
    for number in (1, 2):
        ros.publish_until(camera.images, image(number), lambda: camera.status().message == "detecting")
        ros.until(lambda: camera.status().message.startswith(silence))
        assert camera.status().level == DiagnosticStatus.WARN
        ros.until(lambda: any(f"{silence}" in log.msg for log in logged))
        logged.clear()


def test_without_calibration_there_are_no_detections(ros: Ros) -> None:
    camera = Camera(ros)
    camera.see_dropped(image(1), "no_calibration")
    camera.calibrate(
        camera_info(k=np.zeros(9)), "the camera is not calibrated: its focal lengths are 0 and 0 px"
    )
    assert camera.status().level == DiagnosticStatus.WARN
    assert not camera.detections
    camera.calibrate(camera_info(), "detecting")
    assert camera.see(image(2)).detections


def test_markers_that_fit_no_square_are_told(ros: Ros) -> None:
    camera = Camera(ros)
    camera.calibrate(camera_info(d=[0.4, 0.0, 0.0, 0.0, 0.0]), "image_raw")
    told = "markers fit no square: is camera_info that of this camera?"
    ros.publish_until(camera.images, image(1), lambda: camera.status().message.endswith(told))
    assert camera.status().level == DiagnosticStatus.WARN
    assert int(camera.values()["markers that fit no square"]) > 0
    camera.calibrate(camera_info(), "detecting")
    camera.see(image(2))
    ros.until(lambda: camera.status().message == "detecting")


def test_bad_images_are_dropped_and_counted(ros: Ros) -> None:
    camera = Camera(ros)
    camera.calibrate(camera_info(), "image_raw")
    wrong_encoding, small, short = image(1), image(2), image(3)
    wrong_encoding.encoding = "jpeg"
    small.height //= 2
    short.data = short.data[:-1]
    camera.see_dropped(wrong_encoding, "encoding")
    camera.see_dropped(small, "size")
    dropped = int(camera.values()["dropped: size"])
    ros.publish_until(camera.images, short, lambda: int(camera.values()["dropped: size"]) > dropped)
    assert not camera.detections
    assert float(camera.values()["CPU time per image [ms]"]) > 0.0  # bad ones cost time as well
    assert camera.see(image(4)).detections  # and nothing else has stopped


def test_compressed_images_are_read_and_bad_ones_dropped_and_counted(ros: Ros) -> None:
    camera = Camera(ros, image_transport="compressed")
    camera.calibrate(camera_info(), "no messages received on /image_raw/compressed")
    assert not ros.tester.get_subscriptions_info_by_topic("/image_raw")
    for number, message in enumerate(
        (compressed(1), compressed(2, "rgb8; jpeg compressed bgr8"), compressed(3, "png", ".png")), start=1
    ):
        array = camera.see(message)
        assert array.header.stamp.sec == number
        found = {detection.id: np.reshape(detection.corners_px, (4, 2)) for detection in array.detections}
        assert set(found) == {truth.marker_id for truth in TRUTHS}
        for truth in TRUTHS:
            assert found[truth.marker_id] == pytest.approx(truth.corners, abs=0.5)
    count = len(camera.detections)
    cut, small = compressed(4), compressed(6)
    cut.data = cut.data[: len(cut.data) // 2]
    small.data = cv2.imencode(".jpg", IMAGE[:100])[1].tobytes()
    camera.see_dropped(cut, "corrupt")
    camera.see_dropped(compressed(5, "h264"), "encoding")
    camera.see_dropped(small, "size")
    assert all(detections.header.stamp.sec <= 3 for detections in camera.detections[count:])
    assert camera.see(compressed(7)).detections  # and nothing else has stopped


def test_who_renames_the_images_renames_the_compressed_ones(ros: Ros) -> None:
    arguments = ["--ros-args", "-r", "image_raw:=front/image", "-p", "image_transport:=compressed"]
    ros.add(MarkerDetectorNode(cli_args=arguments))
    (subscription,) = ros.tester.get_subscriptions_info_by_topic("/front/image/compressed")
    assert subscription.topic_type == "sensor_msgs/msg/CompressedImage"


def test_ids_can_be_restricted(ros: Ros) -> None:
    used = sorted(truth.marker_id for truth in TRUTHS)[:2]
    camera = Camera(ros, ids=[str(marker_id) for marker_id in used])
    camera.calibrate(camera_info(), "image_raw")
    assert sorted(detection.id for detection in camera.see(image(1)).detections) == used


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"family": "qr"}, "parameter family = 'qr' must be one of artoolkit_bch_thin, "),
        ({"image_transport": "theora"}, "image_transport = 'theora' must be one of raw, compressed"),
        ({"family": FAMILY, "ids": ["250"]}, "parameter ids: '250' must ascend within 0-249"),
        ({"family": FAMILY, "lengths": ["1:0"]}, "parameter lengths: '1:0' must give a length"),
        ({"family": FAMILY, "robot": "epuck1"}, "needs the parameter swarm_file"),
        ({"family": FAMILY, "marker_length": -1.0}, "marker_length = -1.0 must lie in"),
    ],
)
def test_wrong_parameters_stop_at_start(ros: Ros, parameters: dict[str, Any], words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        ros.add(MarkerDetectorNode(parameter_overrides=overrides(**parameters)))


def test_a_swarm_that_does_not_fit_stops_at_start(ros: Ros, tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    path.write_text("fileversion: 1\nrobots: {a: {}}\nlandmarks: {300: {x: 1.0, y: 0.0}}\n", encoding="utf-8")
    for parameters, words in (
        ({}, "marker id 300, but"),
        ({"ids": ["1"], "lengths": ["1:0.08"]}, "lengths cannot be given along with swarm_file"),
        ({"robot": "b"}, "must be a robot or fixed camera of the swarm: a"),
    ):
        overridden = overrides(family=FAMILY, swarm_file=str(path), **parameters)
        with pytest.raises(ParameterError, match=words):
            ros.add(MarkerDetectorNode(parameter_overrides=overridden))


def test_a_fixed_camera_has_the_detector_in_its_namespace(ros: Ros, tmp_path: Path) -> None:
    ids = [truth.marker_id for truth in TRUTHS]
    faces = ", ".join(f"top{k}: {{z: 0.1, yaw: 0.0, lies: true}}" for k in ids)
    own = ", ".join(f"top{k}: {k}" for k in ids)
    path = tmp_path / "swarm.yaml"
    path.write_text(
        f"fileversion: 1\nrobots: {{a: {{faces: {{{faces}}}, ids: {{{own}}}}}}}\n"
        "cameras: {ceiling1: {x: 0.0, y: 0.0, z: 2.5}}\n",
        encoding="utf-8",
    )
    camera = Camera(ros, namespace="/ceiling1", swarm_file=str(path), robot="ceiling1", tilt_sigma=0.02)
    camera.calibrate(camera_info(), "image_raw")
    assert sorted(detection.id for detection in camera.see(image(1)).detections) == sorted(ids)


def test_a_detector_detects_while_it_is_active(ros: Ros, tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    given = overrides(autostart=False, family=FAMILY, swarm_file=str(path))
    ros.add(MarkerDetectorNode(parameter_overrides=given))
    manager = Manager(ros, "marker_detector")
    heard: list[MarkerDetectionArray] = ros.listen(MarkerDetectionArray, "detections")
    told: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
    images = ros.tester.create_publisher(Image, "image_raw", qos_profile_sensor_data)
    info = ros.tester.create_publisher(CameraInfo, "camera_info", qos_profile_sensor_data)

    def sees() -> bool:
        info.publish(camera_info())
        images.publish(image(1))
        return bool(heard)

    assert not manager.change(CONFIGURE)
    assert manager.state() == "unconfigured"
    path.write_text("fileversion: 1\nrobots: {a: {}}\n", encoding="utf-8")
    assert manager.changes(CONFIGURE, ACTIVATE) == "active"
    ros.until(sees)

    assert manager.changes(DEACTIVATE) == "inactive"
    ros.until(lambda: not ros.tester.count_publishers("detections"))
    assert not ros.tester.count_subscribers("image_raw")
    inactive = "inactive: nothing is published"
    ros.until(lambda: newest_status(told, "marker_detector").message == inactive)
    heard.clear()
    assert manager.changes(ACTIVATE) == "active"
    ros.until(sees)
    assert manager.changes(DEACTIVATE, CLEANUP) == "unconfigured"


@pytest.fixture
def tester() -> Iterator[Node]:
    """A node apart from those that are tested."""
    rclpy.init(args=[])
    yield rclpy.create_node("tester")
    rclpy.shutdown()


@pytest.mark.parametrize("executor_class", [SingleThreadedExecutor, EventsExecutor])
def test_detectors_and_an_estimator_share_a_process(
    tester: Node, tmp_path: Path, executor_class: Callable[[], Any]
) -> None:
    swarm = {"swarm_file": str(write_swarm(tmp_path))}
    heard: dict[str, list[Any]] = {name: [] for name in ("alpha", "beta", "swarm")}
    nodes = [tester, EstimatorNode(parameter_overrides=overrides(**swarm))]
    executor = executor_class()
    publishers = []
    for robot in ("alpha", "beta"):
        own = overrides(**swarm, family=FAMILY, robot=robot)
        nodes.append(MarkerDetectorNode(namespace=robot, parameter_overrides=own))
        for kind, topic, message in (
            (CameraInfo, "camera_info", camera_info()),
            (Image, "image_raw", image(1)),
        ):
            name = f"{robot}/{topic}"
            publishers.append((tester.create_publisher(kind, name, qos_profile_sensor_data), message))
        tester.create_subscription(MarkerDetectionArray, f"{robot}/detections", heard[robot].append, 10)
    tester.create_subscription(SwarmPoses, "swarm/poses", heard["swarm"].append, 10)
    for node in nodes:
        executor.add_node(node)
    end_s = time.monotonic() + PATIENCE_S
    while not all(heard.values()):
        assert time.monotonic() < end_s, {name: len(messages) for name, messages in heard.items()}
        for publisher, message in publishers:
            publisher.publish(message)
        executor.spin_once(timeout_sec=0.02)
    for node in nodes:
        executor.remove_node(node)
    executor.shutdown()
    for node in nodes:
        node.destroy_node()
