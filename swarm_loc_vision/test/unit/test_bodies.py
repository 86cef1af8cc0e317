"""Faces of one robot together."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from bench.vision.scenes import CAMERA, project
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Robot
from swarm_loc_vision.markers.pose import Seen, marker_poses, robot_body, solve_bodies, square, up_of

INTRINSICS = np.array([CAMERA[0, 0], CAMERA[1, 1], CAMERA[0, 2], CAMERA[1, 2]])
LENGTH, SIGMA_PX = 0.03, 0.1
FACES = tuple(
    Face(f"face{k}", k, 0.035 * math.cos(yaw), 0.035 * math.sin(yaw), 0.06, yaw)
    for k, yaw in enumerate(2.0 * math.pi * np.arange(5) / 5)
)
BODY = {k: replace(at, sigma=0.0) for k, at in robot_body(Robot("epuck", faces=FACES)).items()}
OPTICAL_FROM_LEVEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def sighting(seed: int, body_shift: float = 0.0, sigma: float = 0.0) -> tuple[Seen, FloatArray, FloatArray]:
    """Two faces of a robot that sit off by `sigma` each way, and its pose in the camera frame."""
    rng = np.random.default_rng(seed)
    yaw = math.pi + math.pi / 5 + rng.uniform(-0.2, 0.2)  # between two faces
    rotation = OPTICAL_FROM_LEVEL @ Rotation.from_euler("z", yaw).as_matrix()
    position = np.array([rng.uniform(-0.2, 0.2), 0.04, rng.uniform(0.5, 1.0)])
    facing = [k for k, at in BODY.items() if (rotation @ at.rotation)[2, 2] < -0.4]
    corners = []
    for k in facing:
        at = BODY[k]
        shifted = at.position + sigma * np.random.default_rng([seed, k]).standard_normal(3)
        shifted += body_shift if k == facing[0] else 0.0
        seen = project(rotation @ at.rotation, position + rotation @ shifted, square(LENGTH))
        corners.append(seen + SIGMA_PX * rng.normal(size=(4, 2)))
    count = len(facing)
    covariance = np.tile(SIGMA_PX**2 * np.eye(8), (count, 1, 1))
    lengths = np.full(count, LENGTH)
    poses, _ = marker_poses(np.stack(corners), covariance, lengths, INTRINSICS)
    return Seen(np.array(facing), np.stack(corners), covariance, lengths, poses), rotation, position


def test_two_faces_have_one_pose_without_flips() -> None:
    nees, alone, together = [], [], []
    for seed in range(60):
        seen, rotation, position = sighting(seed)
        assert len(seen.id) >= 2
        true_turn = [rotation @ BODY[int(k)].rotation for k in seen.id]
        alone += [_angle(seen.poses.rotation[i, 0], turn) for i, turn in enumerate(true_turn)]
        solve_bodies(seen, [BODY], INTRINSICS, None)
        together += [_angle(seen.poses.rotation[i, 0], turn) for i, turn in enumerate(true_turn)]
        nees.append(nees_of(seen, rotation, position))
        assert (seen.poses.chi2[:, 1] > seen.poses.chi2[:, 0] + 100.0).all()
    assert max(together) < 0.06
    assert np.mean(np.square(together)) < 0.2 * np.mean(np.square(alone))
    assert 4.0 < np.median(nees) < 6.5  # the surplus over what the corners say is published


def nees_of(seen: Seen, rotation: FloatArray, position: FloatArray, sigma: float = 0.0) -> float:
    """Weighed square of the error of the first face, which has the pose of all that sit off by `sigma`."""
    at = BODY[int(seen.id[0])]
    error = np.concatenate(
        [
            seen.poses.position[0, 0] - position - rotation @ at.position,
            Rotation.from_matrix(seen.poses.rotation[0, 0] @ (rotation @ at.rotation).T).as_rotvec(),
        ]
    )
    covariance = seen.poses.covariance[0, 0] + np.diag([sigma**2] * 3 + [0.0] * 3)
    return float(error @ np.linalg.solve(covariance / len(seen.id), error))


def _angle(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(Rotation.from_matrix(a @ b.T).as_rotvec()))


@pytest.mark.parametrize(("told", "counts"), [(0.0, 0.0005), (0.003, 0.003)])
def test_a_description_says_how_exactly_faces_sit(told: float, counts: float) -> None:
    faces = tuple(replace(face, position_sigma=told) for face in FACES)
    assert {at.sigma for at in robot_body(Robot("epuck", faces=faces)).values()} == {counts}


def test_faces_that_sit_off_as_told_have_a_common_pose_as_sure_as_it_says() -> None:
    sigma, count = 0.003, 60
    unsure = {k: replace(at, sigma=sigma) for k, at in BODY.items()}
    nees = []
    for seed in range(count):
        seen, rotation, position = sighting(seed, sigma=sigma)
        alone = seen.poses.position.copy()
        solve_bodies(seen, [unsure], INTRINSICS, None)
        assert (seen.poses.position != alone).any()
        nees.append(nees_of(seen, rotation, position, sigma))
    assert (
        3.0 * count < sum(nees) < chi2.ppf(0.9999, 6 * count)
    )  # the surplus over what fits makes less of it


def test_the_covariance_leaves_out_how_exactly_faces_sit() -> None:
    exact, told = 0.0005, 0.003
    sideways = []
    for seed in range(20):
        seen, _, _ = sighting(seed, sigma=told)
        solve_bodies(seen, [{k: replace(at, sigma=told) for k, at in BODY.items()}], INTRINSICS, None)
        covariance = seen.poses.covariance[0, 0]
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
        sideways.append(covariance[0, 0])  # where corners say most
    assert min(sideways) > exact**2
    assert np.median(sideways) < (0.5 * told) ** 2


def test_faces_that_do_not_fit_stay_on_their_own() -> None:
    seen, _, _ = sighting(0, body_shift=0.02)
    before = [column.copy() for column in seen.poses]
    solve_bodies(seen, [BODY], INTRINSICS, None)
    assert all((now == then).all() for now, then in zip(seen.poses, before, strict=True))


def test_an_id_seen_twice_is_not_trusted() -> None:
    seen, _, _ = sighting(0)
    seen.id[:] = seen.id[0]
    before = seen.poses.position.copy()
    solve_bodies(seen, [BODY], INTRINSICS, None)
    assert (seen.poses.position == before).all()


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.4, 0.3, 0.0), (-0.2, -0.1, 0.25)])
def test_up_follows_the_mount(angles: tuple[float, float, float]) -> None:
    yaw, pitch, roll = angles
    body_from_camera = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    expected = OPTICAL_FROM_LEVEL @ body_from_camera.T @ [0.0, 0.0, 1.0]
    assert up_of(CameraMount(yaw=yaw, pitch=pitch, roll=roll)) == pytest.approx(expected)


def test_faces_stand_upright_and_look_along_their_yaw() -> None:
    at = robot_body(Robot("r", faces=(Face("front", 3, 0.1, 0.2, 0.3, 0.5),)))[3]
    assert np.linalg.det(at.rotation) == pytest.approx(1.0)
    assert at.rotation[:, 2] == pytest.approx([math.cos(0.5), math.sin(0.5), 0.0])
    assert at.rotation[:, 1] == pytest.approx([0.0, 0.0, 1.0])
    assert at.position == pytest.approx([0.1, 0.2, 0.3])
