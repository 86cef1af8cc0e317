"""The marker bridge over DDS: markers of another detector in, detections with covariances out."""

from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from node_world import Ros, newest_status, overrides, values_of
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo

from bench.vision.scenes import CAMERA, HEIGHT, WIDTH, Look, random_scene
from swarm_loc_estimator.common.parameters import ParameterError, UserError
from swarm_loc_msgs.msg import MarkerDetection, MarkerDetectionArray
from swarm_loc_vision.markers import marker_nodes
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.foreign_markers import KINDS, ForeignMarker
from swarm_loc_vision.markers.marker_nodes import MarkerBridgeNode

pytestmark = pytest.mark.usefixtures("frequent_diagnostics")

FAMILY = "apriltag_36h11"
FRAME = "epuck1/camera_optical_frame"
TRUTH = random_scene(np.random.default_rng(4), family_named(FAMILY), 8, Look())[1][0]


def _markers(message: Any, *_: object) -> Iterator[ForeignMarker]:
    for one in message.detections:
        yield ForeignMarker(one.id, "tag36h11", np.reshape(one.corners_px, (4, 2)))


STAND_IN = replace(
    KINDS["apriltag"], message_type="swarm_loc_msgs/msg/MarkerDetectionArray", markers=_markers
)
"""Of a type that is installed everywhere; test_foreign_markers.py reads those of the other detectors."""


def test_markers_become_detections(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(KINDS, "apriltag", STAND_IN)
    parameters = overrides(family=FAMILY, rectified=False, marker_length=TRUTH.length)
    ros.add(MarkerBridgeNode(parameter_overrides=parameters))
    reports: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
    detections: list[MarkerDetectionArray] = ros.listen(MarkerDetectionArray, "detections")

    def said() -> str:
        return str(newest_status(reports, "marker_bridge").message)

    ros.until(lambda: said() == "no messages received on /camera_info")
    info = CameraInfo(height=HEIGHT, width=WIDTH, distortion_model="plumb_bob", d=[0.0] * 5, k=CAMERA.ravel())
    info.header.frame_id = FRAME
    publisher = ros.tester.create_publisher(CameraInfo, "camera_info", qos_profile_sensor_data)
    ros.publish_until(publisher, info, lambda: said() == "no messages received on /apriltag_detections")

    found = MarkerDetectionArray(
        detections=[MarkerDetection(id=TRUTH.marker_id, corners_px=TRUTH.corners.ravel())]
    )
    found.header.stamp.sec, found.header.frame_id = 7, "elsewhere"
    publisher = ros.tester.create_publisher(
        MarkerDetectionArray, "apriltag_detections", qos_profile_sensor_data
    )
    ros.publish_until(
        publisher,
        found,
        lambda: "dropped: foreign_frame" in values_of(newest_status(reports, "marker_bridge")),
    )
    assert not detections
    found.header.frame_id = FRAME
    ros.publish_until(publisher, found, lambda: detections)
    assert (detections[0].header.frame_id, detections[0].header.stamp.sec) == (FRAME, 7)
    (row,) = detections[0].detections
    place = row.pose.pose.position
    assert (place.x, place.y, place.z) == pytest.approx(tuple(TRUTH.position), abs=1e-3)
    assert np.linalg.eigvalsh(np.reshape(row.pose.covariance, (6, 6)))[0] > 0.0
    ros.until(lambda: said() == "detecting")


def test_all_is_compiled_before_markers_come(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(KINDS, "apriltag", STAND_IN)
    compiled: list[bool] = []
    monkeypatch.setattr(marker_nodes, "precompile", lambda: compiled.append(True))
    ros.add(MarkerBridgeNode())
    assert compiled


@pytest.mark.parametrize(
    ("source", "package"), [("apriltag", "apriltag-msgs"), ("aruco_opencv", "aruco-opencv-msgs")]
)
@pytest.mark.skipif(any(map(find_spec, ("apriltag_msgs", "aruco_opencv_msgs"))), reason="they are installed")
def test_a_detector_whose_messages_are_missing_ends_the_start(ros: Ros, source: str, package: str) -> None:
    with pytest.raises(UserError, match=f"install ros-jazzy-{package}, or build"):
        ros.add(MarkerBridgeNode(parameter_overrides=overrides(source=source)))


def test_a_family_that_no_source_finds_ends_the_start(ros: Ros) -> None:
    with pytest.raises(ParameterError, match="family = 'artoolkit_bch_thin' must be one of apriltag_16h5, "):
        ros.add(MarkerBridgeNode(parameter_overrides=overrides(family="artoolkit_bch_thin")))
