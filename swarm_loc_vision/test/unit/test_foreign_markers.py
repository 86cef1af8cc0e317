"""Markers of other detectors: their conventions of corners and poses, and what is dropped."""

import json
import sys
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from camera_messages import FRAME, camera_info, header
from compiled_code import compiled_since, printed_by_process, signatures
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.vision.scenes import CAMERA, Look, Truth, random_scene
from swarm_loc_estimator.common.messages.cdr import DETECTIONS, decode
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_vision.common.images import ImageError
from swarm_loc_vision.markers.detector import precompile
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.foreign_markers import ForeignMarkers, ForeignParameters
from swarm_loc_vision.markers.pose import PoseSettings, square

TAG = "apriltag_36h11"
LENGTH = 0.05
DISTORTION = (0.1, -0.05, 0.001, -0.002, 0.0)


def tag(marker_id: int, corners: NDArray[Any], family: str = "tag36h11") -> SimpleNamespace:
    """An apriltag_msgs/AprilTagDetection with corners (4, 2) as AprilTag gives them."""
    points = [SimpleNamespace(x=float(u), y=float(v)) for u, v in corners]
    return SimpleNamespace(id=marker_id, family=family, hamming=0, corners=points)


def by_apriltag(truth: Truth) -> SimpleNamespace:
    """The tag of a scene, with AprilTag's corners: counter-clockwise from the lower left, centres at 0.5."""
    return tag(truth.marker_id, truth.corners[[3, 2, 1, 0]] + 0.5)


def tags(*found: SimpleNamespace, frame: str = FRAME) -> SimpleNamespace:
    return SimpleNamespace(header=header(frame), detections=found)


def by_aruco(truth: Truth, size: float, quarters: int = 0) -> SimpleNamespace:
    """An aruco_opencv_msgs/MarkerPose as aruco_opencv finds it, with one size for all markers."""
    found, turns, shifts, _ = cv2.solvePnPGeneric(
        square(size), np.roll(truth.corners, -quarters, axis=0), CAMERA, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    assert found
    x, y, z, w = Rotation.from_rotvec(np.ravel(turns[0])).as_quat()
    place = dict(zip("xyz", np.ravel(shifts[0]).tolist(), strict=True))
    pose = SimpleNamespace(position=SimpleNamespace(**place), orientation=SimpleNamespace(x=x, y=y, z=z, w=w))
    return SimpleNamespace(marker_id=truth.marker_id, pose=pose)


def bridge(info: SimpleNamespace | None = None, **parameters: Any) -> ForeignMarkers:
    """A bridge that knows the camera."""
    given: dict[str, Any] = {"family": TAG, "rectified": False, **parameters}
    markers = ForeignMarkers(ForeignParameters(**given))
    markers.calibrate(info or camera_info())
    return markers


def rows_of(data: bytes) -> np.ndarray[Any, np.dtype[np.void]]:
    """The detections of a message."""
    message = decode(data, DETECTIONS)
    assert (message.header.frame_id, message.header.stamp.nanosec) == (FRAME, 5)
    rows = np.zeros(len(message.detections), DETECTION_DTYPE)
    for name, stored in zip(DETECTION_DTYPE.names or (), message.detections.dtype.names, strict=True):
        rows[name] = message.detections[stored].reshape(rows[name].shape)
    return rows


def scene(family: str = TAG) -> tuple[np.ndarray[Any, Any], list[Truth], tuple[str, ...]]:
    """An image, its markers, and their sides as a parameter."""
    image, truths = random_scene(np.random.default_rng(7), family_named(family), 8, Look())
    assert len({truth.marker_id for truth in truths}) == len(truths) >= 6
    return image, truths, tuple(f"{truth.marker_id}:{truth.length:.6f}" for truth in truths)


def check_poses(rows: np.ndarray[Any, Any], truths: list[Truth], depth: float, turn: float) -> None:
    """Compare with the truth: position relative to the depth, and rotation [rad] of either solution."""
    assert sorted(rows["id"]) == sorted(truth.marker_id for truth in truths)
    for truth in truths:
        (row,) = rows[rows["id"] == truth.marker_id]
        assert np.linalg.norm(row["position"] - truth.position) < depth * truth.position[2]
        solutions = Rotation.from_quat([row["orientation"], row["alternative_orientation"]])
        turns = (solutions.inv() * Rotation.from_matrix(truth.rotation)).magnitude()
        assert turns[: 2 if np.isfinite(row["alternative_ratio"]) else 1].min() < turn
        assert row["corners_px"] == pytest.approx(truth.corners, abs=1.0)
        assert np.linalg.eigvalsh(row["covariance"])[0] > 0.0
        assert np.isnan(row["id_margin"])
        assert row["family"] == family_named(TAG).code


def test_corners_of_apriltag_give_the_true_poses() -> None:
    _, truths, lengths = scene()
    markers = bridge(lengths=lengths)
    check_poses(rows_of(markers.detect(tags(*map(by_apriltag, truths)))), truths, 1e-3, 0.01)
    assert (markers.markers, markers.misfits, +markers.drops) == (len(truths), 0, {})


def test_corners_that_the_library_of_apriltag_finds_are_understood() -> None:
    library = pytest.importorskip("pupil_apriltags")
    library.Detector.__del__ = lambda _: None  # it frees its families twice: the process would end in a crash
    image, truths, lengths = scene()
    found = library.Detector(families="tag36h11", nthreads=1, quad_decimate=1.0).detect(image)
    rows = rows_of(bridge(lengths=lengths).detect(tags(*(tag(one.tag_id, one.corners) for one in found))))
    seen = [truth for truth in truths if truth.marker_id in rows["id"]]
    assert len(seen) >= len(truths) - 1
    check_poses(rows, seen, 0.02, 0.2)


@pytest.mark.parametrize(("family", "quarters"), [("aruco_mip_36h12", 0), (TAG, 2)])
def test_poses_of_aruco_get_the_size_of_each_marker(family: str, quarters: int) -> None:
    _, truths, lengths = scene(family)
    markers = bridge(source="aruco_opencv", family=family, lengths=lengths, source_marker_length=0.123)
    found = SimpleNamespace(
        header=header(), markers=[by_aruco(truth, 0.123, quarters) for truth in truths], boards=[]
    )
    rows = rows_of(markers.detect(found))
    rows["family"] = family_named(TAG).code
    check_poses(rows, truths, 2e-3, 0.02)


def test_the_distortion_is_removed_unless_images_are_rectified() -> None:
    _, (truth, *_), _ = scene()
    lengths = (f"{truth.marker_id}:{truth.length:.6f}",)
    points = square(truth.length) @ truth.rotation.T + truth.position
    bent, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA, np.array(DISTORTION))
    bent = bent.reshape(4, 2)
    assert np.abs(bent - truth.corners).max() > 0.3
    straight = points[:, :2] / points[:, 2:] * 0.9 * CAMERA[0, 0] + 0.9 * CAMERA[:2, 2]
    for rectified, corners in ((False, bent), (True, straight)):
        markers = bridge(camera_info(distortion=DISTORTION), rectified=rectified, lengths=lengths)
        (row,) = rows_of(markers.detect(tags(tag(truth.marker_id, corners[::-1] + 0.5))))
        assert row["position"] == pytest.approx(truth.position, abs=1e-4)
        assert row["corners_px"] == pytest.approx(corners, abs=1e-3)


def test_surer_corners_give_surer_poses() -> None:
    _, (truth, *_), _ = scene()
    covariances = [
        rows_of(bridge(corner_sigma_px=sigma).detect(tags(by_apriltag(truth))))["covariance"][0]
        for sigma in (0.1, 0.2)
    ]
    assert covariances[1] == pytest.approx(4.0 * covariances[0], rel=0.05)


def test_what_cannot_be_used_is_counted() -> None:
    _, (truth, *_), _ = scene()
    good = by_apriltag(truth)
    wrong_way = tag(truth.marker_id, truth.corners + 0.5)
    markers = bridge(ids=(str(truth.marker_id),))
    found = tags(
        good,
        tag(truth.marker_id, truth.corners[::-1], "tag25h9"),
        tag((truth.marker_id + 1) % 500, truth.corners[::-1]),
        tag(-1, truth.corners[::-1]),
        tag(truth.marker_id, truth.corners[::-1] * np.nan),
        wrong_way,
    )
    assert len(rows_of(markers.detect(found))) == 1
    assert +markers.drops == {"other_family": 1, "unknown_id": 2, "not_finite": 1, "corner_order": 1}
    behind = by_aruco(truth, LENGTH)
    behind.pose.position.z *= -1.0
    aruco = bridge(source="aruco_opencv", family="aruco_mip_36h12")
    nothing = SimpleNamespace(header=header(), markers=[behind], boards=[])
    nothing.markers[0].marker_id = 3
    assert len(rows_of(aruco.detect(nothing))) == 0
    assert +aruco.drops == {"not_finite": 1}


@pytest.mark.parametrize(
    ("source", "family", "last"),
    [
        ("apriltag", "aruco_mip_36h12", "apriltag_standard_41h12"),
        ("apriltag", "artoolkit_bch_thin", "apriltag_standard_41h12"),
        ("aruco_opencv", "apriltag_standard_41h12", "aruco_7x7_1000"),
        ("aruco_opencv", "apriltag_36h11_thick", "aruco_7x7_1000"),
    ],
)
def test_a_family_that_the_source_does_not_find_is_one_sentence(source: str, family: str, last: str) -> None:
    said = rf"parameter family = '{family}' must be one that {source} finds: apriltag_16h5, .*, {last}\."
    with pytest.raises(ParameterError, match=said):
        ForeignMarkers(ForeignParameters(source=source, family=family))


def test_messages_need_a_calibration_of_their_frame() -> None:
    markers = ForeignMarkers(ForeignParameters(family=TAG))
    with pytest.raises(ImageError, match="no camera_info was received yet"):
        markers.detect(tags())
    markers.calibrate(camera_info())
    with pytest.raises(ImageError, match="in frame 'map', but camera_info in 'camera_optical_frame'"):
        markers.detect(tags(frame="map"))
    assert markers.drops == {"no_calibration": 1, "foreign_frame": 1}
    assert len(rows_of(markers.detect(tags()))) == 0


def test_nothing_is_compiled_once_markers_come() -> None:
    assert printed_by_process(__file__) == []


def compiled_late() -> list[str]:
    """What is compiled for markers though all is warm; in a process of its own."""
    precompile()
    _, truths, lengths = scene()
    before = signatures()
    bridge(camera_info(distortion=DISTORTION), lengths=lengths).detect(tags(*map(by_apriltag, truths)))
    bridge(lengths=lengths, settings=PoseSettings(tilt_sigma=0.1)).detect(tags(*map(by_apriltag, truths)))
    aruco = bridge(camera_info(distortion=DISTORTION), source="aruco_opencv", lengths=lengths)
    found = [by_aruco(truth, LENGTH, 2) for truth in truths]
    aruco.detect(SimpleNamespace(header=header(), markers=found, boards=[]))
    return compiled_since(before)


if __name__ == "__main__":
    json.dump(compiled_late(), sys.stdout)
