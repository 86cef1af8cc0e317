"""Fixed cameras and lying markers: conversion against an independent composition in three dimensions."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from core_geometry import homogeneous, planar, pose_of, seen, wrapped
from core_messages import POSE, POSE_TWO, POSITION, SECOND, T0, detection, joined
from lost_world import Alone
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE, encode_detections
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.filter.measurements import NO_MEASUREMENTS, NOBODY, Measurements
from swarm_loc_estimator.filter.models import CARTESIAN, predict
from swarm_loc_estimator.nodes.estimator_diagnostics import _CAUSES, Diagnostics
from swarm_loc_estimator.nodes.parameters import EstimatorParameters
from swarm_loc_estimator.sensors.camera import (
    _FLOOR_M,
    _FLOOR_RAD,
    _FLOOR_SHARE,
    DetectionRows,
    SightingConverter,
)
from swarm_loc_estimator.sensors.inputs import Batch, Ingest, live_topics
from swarm_loc_estimator.sensors.sensor import DropCounts
from swarm_loc_estimator.swarm.error_models import RandomWalk, SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, FixedCamera, Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.estimate import Estimate
from swarm_loc_estimator.timeline.estimator import Estimator, Status
from swarm_loc_estimator.timeline.settings import Policy, Settings

EXACT = SensorModel(residual_position_sigma=0.002, residual_heading_sigma=0.01)
CAMERAS = (
    FixedCamera("straight", 0.3, -0.2, 2.5, sensor=EXACT),
    FixedCamera("aslant", -1.0, 0.5, 2.2, yaw=0.7, pitch=1.1, roll=0.2, sensor=EXACT),
    FixedCamera("low", 2.0, 1.0, 0.8, yaw=-2.4, pitch=0.5, roll=-0.4, sensor=EXACT),
)
TOP = Face("top", 3, 0.01, -0.02, 0.1, 0.4, size=0.05, position_sigma=0.001, lies=True)
MUTE = Face("mute", 4, -0.02, 0.01, 0.1, None, size=0.05, lies=True)
SIDE = Face("side", 5, 0.03, 0.0, 0.04, 0.2)
MARK = Landmark(9, 0.0, 0.0, 0.0, 0.3)
BASE = np.array([0.4, 0.3, 2.1])
SWARM = Swarm((Robot("a", faces=(TOP, MUTE, SIDE)), Robot("b")), (MARK,), CAMERAS)
SPREAD = np.diag(np.square([1e-4, 1e-4, 5e-3, 0.02, 0.02, 0.003]))
SPREAD[2, 3] = SPREAD[3, 2] = 0.5 * math.sqrt(SPREAD[2, 2] * SPREAD[3, 3])


def in_view(face: Face, camera: FixedCamera, base: FloatArray = BASE, *, up: bool = False) -> FloatArray:
    """The pose (4, 4) of a face in the optical frame of a fixed camera, which may be turned to the sky."""
    mount = CameraMount(
        0.0, 0.0, camera.z, 0.0, pitch=-camera.pitch if up else camera.pitch, roll=camera.roll
    )
    x, y, theta = base
    on_robot = homogeneous(face.x, face.y, face.z, face.yaw or 0.0)
    if not face.lies:  # z out of the face, y up
        on_robot[:3, :3] = on_robot[:3, :3] @ np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    return seen([camera.x, camera.y, camera.yaw], mount, homogeneous(x, y, 0.0, theta) @ on_robot)


def looked(marker_id: int, pose: FloatArray, content: int = POSE) -> NDArray[np.void]:
    one = detection(marker_id, pose, content)
    one["covariance"] = SPREAD
    return one


def converted(
    detections: NDArray[np.void], camera: int = 0, swarm: Swarm = SWARM
) -> tuple[Measurements, dict[str, list[int]]]:
    count, drops = detections.size, DropCounts(len(swarm.sources))
    received = np.frombuffer(detections.tobytes(), dtype=DETECTION_DTYPE)
    sources, stamps = np.full(count, len(swarm.robots) + camera), np.full(count, T0)
    found = SightingConverter(swarm, drops).convert(DetectionRows(sources, stamps, received, stamps))
    dropped: dict[str, list[int]] = {reason: [] for reason in drops.total}
    for source, counts in enumerate(drops.of_robot):
        for reason, number in counts.items():
            dropped[reason] += number * [source]
    return found, dropped


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("camera", range(3))
@pytest.mark.parametrize("face", [TOP, MUTE, SIDE])
def test_a_face_in_view_comes_back_as_the_robots_pose(face: Face, camera: int, seed: int) -> None:
    base = BASE + np.random.default_rng(seed).uniform(-0.2, 0.2, 3)
    one, dropped = converted(looked(face.id, in_view(face, CAMERAS[camera], base)), camera)
    assert dropped == {}
    assert (one.observer[0], one.target[0], one.received_from[0]) == (NOBODY, 0, 2 + camera)
    assert SWARM.surveyed[one.mount[0]] == CAMERAS[camera]
    assert one.model[0] == CARTESIAN
    assert one.has_heading[0] == (face is not MUTE)
    predicted, _ = predict(one, np.zeros((1, 3)), base[None])
    np.testing.assert_allclose(wrapped(one.value - predicted)[0, : 3 - (face is MUTE)], 0.0, atol=2e-9)


@pytest.mark.parametrize("camera", range(3))
def test_a_position_alone_gives_the_place_on_the_plane(camera: int) -> None:
    near = in_view(TOP, CAMERAS[camera])
    near[:3, 3] *= 1.01  # the distance is not used
    one, _ = converted(looked(TOP.id, near, POSITION), camera)
    predicted, _ = predict(one, np.zeros((1, 3)), BASE[None])
    np.testing.assert_allclose(one.value[0, :2], predicted[0, :2], atol=1e-9)
    assert one.has_heading[0] == 0
    assert one.covariance[0, 2].tolist() == [0.0, 0.0, 1.0]


def test_a_robots_camera_sees_lying_markers_of_others() -> None:
    mount = CameraMount(0.02, 0.0, 0.4, 0.3, pitch=0.8)
    swarm = Swarm((Robot("a", faces=(TOP,)), Robot("b", camera=mount)))
    observer = np.array([0.0, 0.1, 0.5])
    x, y, theta = BASE
    tag = homogeneous(x, y, 0.0, theta) @ homogeneous(TOP.x, TOP.y, TOP.z, TOP.yaw or 0.0)
    stamp, look = np.array([T0]), joined([looked(TOP.id, seen(observer, mount, tag))])
    found = SightingConverter(swarm).convert(DetectionRows(np.array([1]), stamp, look, stamp))
    assert found.observer[0] == 1
    assert found.systematic_share.tolist() == [[0.0, 0.0, 0.0]]
    predicted, _ = predict(found, observer[None], BASE[None])
    np.testing.assert_allclose(found.value, predicted, atol=1e-9)


def perturbed(pose: FloatArray, step: FloatArray) -> FloatArray:
    """A pose moved and turned about the axes of the camera by a step (6,)."""
    moved: FloatArray = pose.copy()
    moved[:3, 3] += step[:3]
    moved[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ moved[:3, :3]
    return moved


@pytest.mark.parametrize("camera", range(3))
def test_the_covariance_is_that_of_the_pose_propagated(camera: int) -> None:
    pose, step = in_view(TOP, CAMERAS[camera]), 1e-6
    ends = [
        [converted(looked(TOP.id, perturbed(pose, sign * axis)), camera)[0].value[0] for sign in (1, -1)]
        for axis in step * np.eye(6)
    ]
    slopes = np.array([wrapped(ahead - behind) / (2.0 * step) for ahead, behind in ends]).T
    one, _ = converted(looked(TOP.id, pose), camera)
    floor = _FLOOR_M + _FLOOR_SHARE * (CAMERAS[camera].z - TOP.z)
    position = TOP.position_sigma**2 + EXACT.residual_position_sigma**2 + floor**2
    heading = EXACT.residual_heading_sigma**2 + _FLOOR_RAD**2
    expected = slopes @ SPREAD @ slopes.T + np.diag([position, position, heading])
    np.testing.assert_allclose(one.covariance[0], expected, rtol=1e-5, atol=1e-10)
    assert not one.systematic_share.any()  # the pose of the camera is estimated


def test_tilt_and_distance_of_a_marker_move_its_place_by_no_more_than_its_pixels() -> None:
    """Under the camera, a face that seems tilted has the same corners in the image but for perspective."""
    pose = in_view(TOP, CAMERAS[0], np.array([CAMERAS[0].x, CAMERAS[0].y, 2.1]))
    straight, _ = converted(looked(TOP.id, pose))
    tilted, dropped = converted(looked(TOP.id, perturbed(pose, np.array([0, 0, 0, 0.05, -0.03, 0.0]))))
    assert dropped == {}
    off = wrapped(tilted.value - straight.value)[0]
    assert np.abs(off[:2]).max() < 1e-4
    assert abs(off[2]) < math.radians(0.1)


def test_of_two_mirrored_poses_the_one_that_lies_is_used() -> None:
    pose = in_view(TOP, CAMERAS[1])
    one = looked(TOP.id, perturbed(pose, np.array([0, 0, 0, 0.9, 0.0, 0.0])), POSE_TWO)
    one["alternative_position"], one["alternative_orientation"] = looked(TOP.id, pose)[
        ["position", "orientation"]
    ][0]
    found, dropped = converted(one, 1)
    assert dropped == {}
    assert not found.has_second[0]
    expected, _ = converted(looked(TOP.id, pose), 1)
    np.testing.assert_allclose(found.value, expected.value, atol=1e-12)


def turned_over(pose: FloatArray) -> FloatArray:
    pose = pose.copy()
    pose[:3, :3] = pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    return pose


@pytest.mark.parametrize(
    ("marker_id", "pose", "reason"),
    [
        (TOP.id, turned_over(in_view(TOP, CAMERAS[0])), "face_down"),
        (TOP.id, perturbed(in_view(TOP, CAMERAS[0]), np.array([0, 0, 0, 0.6, 0, 0])), "not_flat"),
        (TOP.id, perturbed(in_view(TOP, CAMERAS[0]), np.array([0, 0, -0.6, 0, 0, 0])), "not_flat"),
        (TOP.id, in_view(TOP, CAMERAS[0], up=True), "face_down"),
        (TOP.id, np.full((4, 4), np.nan), "non_finite"),
        (MARK.id, in_view(TOP, CAMERAS[0]), "fixed_on_fixed"),
        (77, in_view(TOP, CAMERAS[0]), "unknown_id"),
    ],
)
def test_what_cannot_be_used_has_a_reason(marker_id: int, pose: FloatArray, reason: str) -> None:
    with np.errstate(invalid="ignore"):
        one = looked(TOP.id, np.eye(4)) if np.isnan(pose).any() else looked(marker_id, pose)
    if np.isnan(pose).any():
        one["position"] = np.nan
    found, dropped = converted(one)
    assert (found.size, dropped) == (0, {reason: [2]})


def test_a_camera_that_looks_to_the_sky_drops_what_lies_below_it() -> None:
    """Its description says so, but its detections are those of a camera that looks down."""
    sky = replace(CAMERAS[0], pitch=-math.pi / 2)
    found, dropped = converted(looked(TOP.id, in_view(TOP, CAMERAS[0])), 0, replace(SWARM, cameras=(sky,)))
    assert (found.size, dropped) == (0, {"face_down": [2]})


@pytest.mark.parametrize("first", [-1.0, 0.0])
def test_a_covariance_that_is_not_known_is_that_of_the_description(first: float) -> None:
    """In ROS, -1 says so, and drivers that fill in none send zeros."""
    one = detection(TOP.id, in_view(TOP, CAMERAS[0]))
    one["covariance"] = 0.0
    one["covariance"][..., 0, 0] = first
    found, _ = converted(one)
    sensor = CAMERAS[0].sensor
    heading = found.covariance[0, 2, 2] - sensor.residual_heading_sigma**2 - _FLOOR_RAD**2
    assert math.sqrt(heading) == pytest.approx(sensor.heading_sigma, rel=0.05)
    assert math.sqrt(found.covariance[0, 0, 0]) == pytest.approx(sensor.left_sigma, rel=0.1)


STANDING = Robot("a", camera=None, faces=(TOP, SIDE), stands=True, random_walk=RandomWalk(1e-10, 1e-10))


def watched(
    looks: list[tuple[int, int, NDArray[np.void]]], swarm: Swarm, settings: Settings | None = None
) -> list[Estimate]:
    """Estimates after each look: second, number of the camera, detection."""
    estimator, found = Estimator(swarm, settings or Settings()), []
    for second, camera, one in looks:
        stamp_ns = T0 + second * SECOND
        source, stamp = np.array([len(swarm.robots) + camera]), np.array([stamp_ns])
        rows = DetectionRows(source, stamp, joined([one]), stamp)
        estimator.receive(Batch.of(stamp_ns, stamp_ns, detections=rows))
        found.append(estimator.tick(stamp_ns))
    return found


def in_map_of(one: Measurements, camera: FixedCamera) -> tuple[FloatArray, FloatArray]:
    """Covariances of base_link in map by the noise of a measurement, and by the pose of its camera."""
    step, sensor = 1e-6, one.sensor[0]

    def placed(value: FloatArray, at: FloatArray) -> FloatArray:
        return pose_of(planar(at) @ planar(value) @ np.linalg.inv(planar(one.marker[0])))

    def slopes(of: Callable[[FloatArray], FloatArray]) -> FloatArray:
        ends = [wrapped(of(axis) - of(-axis)) / (2.0 * step) for axis in step * np.eye(3)]
        found: FloatArray = np.array(ends).T
        return found

    by_value = slopes(lambda change: placed(one.value[0] + change, sensor))
    by_camera = slopes(lambda change: placed(one.value[0], sensor + change))
    of_camera = np.diag(np.square([camera.position_sigma, camera.position_sigma, camera.yaw_sigma]))
    return by_value @ one.covariance[0] @ by_value.T, by_camera @ of_camera @ by_camera.T


def test_three_sightings_locate_a_robot_and_the_fourth_confirms_it() -> None:
    swarm, look = Swarm((STANDING,), (), CAMERAS), looked(TOP.id, in_view(TOP, CAMERAS[1]))
    found = watched([(second, 1, look) for second in range(4)], swarm)
    waiting, assumed, tracked = Status.WAITING, Status.UNCONFIRMED, Status.TRACKED
    assert [one.status[0] for one in found] == [waiting, waiting, assumed, tracked]
    np.testing.assert_allclose(wrapped(found[2].poses[0] - BASE), 0.0, atol=1e-6)
    noise, of_camera = in_map_of(converted(look, 1, swarm)[0], CAMERAS[1])
    suspect = np.diag(np.square([0.03, 0.03, 0.06]))  # until others agree
    expected = np.diag(of_camera + noise / 3.0)  # the alignment neglects what position and heading share
    np.testing.assert_allclose(np.diag(found[2].covariances[0] - suspect), expected, rtol=0.05)


@pytest.mark.parametrize("shake", [0.0, 1e-5])
@pytest.mark.parametrize(
    "settings",
    [Settings(), Settings(policy=Policy(large_from=1, batch_from=1)), Settings(sparse_from=2)],
    ids=["order", "batch", "sparse"],
)
def test_many_sightings_are_no_surer_than_the_pose_of_their_camera_and_what_repeats(
    settings: Settings, shake: float
) -> None:
    """Half of the variance of a sighting repeats while a robot stands, however many there are."""
    swarm, pose = Swarm((STANDING, Robot("b")), (), CAMERAS), in_view(TOP, CAMERAS[0])
    rng = np.random.default_rng(0)
    looks = [looked(TOP.id, perturbed(pose, shake * rng.standard_normal(6))) for _ in range(100)]
    *_, last = watched([(second, 0, look) for second, look in enumerate(looks)], swarm, settings)
    noise, of_camera = (np.diag(one) for one in in_map_of(converted(looks[0], 0, swarm)[0], CAMERAS[0]))
    found = np.diag(last.covariances[0])
    # the same value again is no news, so the mean of the first ones stays as it is
    assert (found > of_camera + (0.2 if shake == 0.0 else 0.45) * noise).all()
    assert (found < of_camera + 0.6 * noise).all()


def test_between_cameras_that_disagree_a_standing_robot_jumps_once_and_not_beyond_the_middle() -> None:
    """The second camera errs by 3 mm, one of its standard deviations; then both places are estimated."""
    cameras = tuple(replace(one, position_sigma=0.003) for one in CAMERAS)
    off = BASE + np.array([0.003, 0.0, 0.0])
    both = looked(TOP.id, in_view(TOP, cameras[0])), looked(TOP.id, in_view(TOP, cameras[1], off))
    order = [0] * 20 + [1] * 20 + [0] * 10 + [1] * 10
    looks = [(second, camera, both[camera]) for second, camera in enumerate(order)]
    poses = np.array([one.poses[0] for one in watched(looks, Swarm((STANDING,), (), cameras))])[2:]
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    assert np.argmax(steps) == 20 - 3
    assert steps.max() < 0.0015
    assert np.delete(steps, np.argmax(steps)).max() < 0.0005
    assert 0.0005 < poses[-1, 0] - BASE[0] < 0.0025


def test_an_upright_face_with_two_poses_does_not_locate_alone() -> None:
    one = looked(SIDE.id, in_view(SIDE, CAMERAS[2]), POSE_TWO)
    (only,) = watched([(0, 2, one)], Swarm((STANDING,), (), CAMERAS))
    assert only.status[0] == Status.WAITING


def test_a_described_camera_has_a_topic_that_is_missed_and_its_drops_are_named() -> None:
    swarm = Swarm((STANDING,), (), CAMERAS[:2])
    ingest = Ingest(swarm, topics=live_topics(swarm, shared=False))
    diagnostics = Diagnostics(swarm, ingest, EstimatorParameters(), Alone(" (no publisher)"), [])
    data = encode_detections("straight", T0, np.zeros(0, DETECTION_DTYPE))
    message = SerializedMessage(ingest.handle_of["straight/detections"], data, T0)
    list(ingest.read(MessageBatch.of([message])))
    (estimate,) = watched([(0, 1, looked(TOP.id, in_view(TOP, CAMERAS[1])))], swarm)
    nothing = (NO_MEASUREMENTS, np.zeros(0, dtype=np.uint8), np.zeros(0))
    drops: list[dict[str, int]] = [{}, {"not_flat": 3, "unknown_id": 2}, {}]
    _, straight, aslant, whole = diagnostics.reports(T0, estimate, nothing, {}, drops)
    assert straight.name == "straight"
    assert straight.message == f"dropped 3 of its data: they {_CAUSES['not_flat']}"
    assert straight.values["dropped: unknown_id"] == 2
    assert straight.values["detections received"] == "1"
    assert aslant.message == "no messages received on aslant/detections (no publisher)"
    assert whole.message == aslant.message


def test_with_shared_topics_fixed_cameras_keep_their_own() -> None:
    names = [topic.name for topic in live_topics(SWARM, shared=True)]
    assert [name for name in names if "detections" in name] == [
        *("straight/detections", "aslant/detections", "low/detections"),
        *("aerial/detections", "swarm/detections"),
    ]
