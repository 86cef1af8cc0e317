"""The closed form, and that each correction of the printed equations is needed."""

from __future__ import annotations

import numpy as np
import pytest
from ir_world import ANGLES, RHO, droplet, emitter_20, random_poses, readings_of, sensor_19, units, wrapped

from bench.droplet.closed_form import ClosedForm, IrEstimator
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.search import IrOutcome
from swarm_loc_estimator.swarm.ir_board import IrGains, PairGains, load_ir_platform

PRINTED = ("(1)", "(10)", "(11)", "(12)", "(18)", "wrap")


def by_the_paper(matrix: FloatArray, as_printed: str = "") -> FloatArray:
    """Eqs (5)-(18) in plain numpy, one of them as printed: range [m], bearing, heading [rad]."""
    sensors, emitters = units(ANGLES), units(ANGLES)
    theta = np.arctan2(*(matrix.sum(axis=1) @ sensors)[::-1])
    big_phi = np.arctan2(*(matrix.sum(axis=0) @ emitters)[::-1])
    phi = wrapped(big_phi + theta + np.pi if as_printed == "(10)" else theta + np.pi - big_phi)
    i, j = np.unravel_index(matrix.argmax(), matrix.shape)
    sensor, emitter = sensors[i], units(ANGLES[j] + (0.0 if as_printed == "(1)" else phi))

    def distance(alpha: float, beta: float) -> float:
        if as_printed != "wrap":
            alpha, beta = (float(wrapped(np.array(angle))) for angle in (alpha, beta))
        light = matrix[i, j] / (sensor_19(np.array(alpha)) * emitter_20(np.array(beta)))
        return float(np.sqrt(14000.0 / (light + 1.0)) + 3.0) / 100.0

    r = distance(theta - ANGLES[i], theta - ANGLES[j] - phi - np.pi)  # (13)-(15)
    between = (r + 2.0 * RHO) * units(np.array(theta)) + RHO * (emitter - sensor)  # (16), (1)
    along = np.arctan2(between[1], between[0])
    if as_printed == "(11)":
        along = np.arctan(between[1] / between[0])
    turned_by = theta if as_printed == "(12)" else phi
    r = distance(along - ANGLES[i], along + np.pi - ANGLES[j] - turned_by)
    corrected = float(np.linalg.norm(r * units(np.array(along)) + RHO * (sensor - emitter)))
    scalar = float(np.linalg.norm(r + RHO * (sensor - emitter)))
    return np.array([scalar if as_printed == "(18)" else corrected, theta, phi])


def mean_errors(found: FloatArray, poses: FloatArray) -> FloatArray:
    """Mean absolute errors [cm, deg, deg]."""
    errors = found - poses
    errors[:, 1:] = np.degrees(wrapped(errors[:, 1:]))
    errors[:, 0] *= 100.0
    return np.asarray(np.mean(np.abs(errors), axis=0))


def test_it_is_the_papers_closed_form_with_its_corrections() -> None:
    platform, poses = droplet(), random_poses(300, 1, low=0.16)
    readings = readings_of(platform, poses, 1)
    found = ClosedForm(platform).solve(readings).poses
    by_hand = np.array([by_the_paper(matrix) for matrix in readings[:, 0]])
    np.testing.assert_allclose(found[:, 0], by_hand[:, 0], atol=2e-4)
    np.testing.assert_allclose(wrapped(found[:, 1:] - by_hand[:, 1:]), 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("printed", "column", "worse_by"),
    [
        ("(1)", 0, 1.0),
        ("(10)", 2, 60.0),
        ("(10)", 0, 4.0),
        ("(11)", 0, 1.0),
        ("(12)", 0, 3.0),
        ("(18)", 0, 2.0),
    ],
)
def test_every_correction_is_needed(printed: str, column: int, worse_by: float) -> None:
    """Each printed equation alone costs centimetres or tens of degrees at 20 cm, as the errata have it."""
    platform, poses = droplet(), random_poses(1000, 2, low=0.2, high=0.2)
    readings = readings_of(platform, poses, 2)
    right = mean_errors(ClosedForm(platform).solve(readings).poses, poses)
    with np.errstate(all="ignore"):
        wrong = mean_errors(np.array([by_the_paper(matrix, printed) for matrix in readings[:, 0]]), poses)
    assert wrong[column] > right[column] + worse_by


def test_angles_must_be_wrapped_before_19_and_20() -> None:
    platform, poses = droplet(), random_poses(1000, 3, low=0.2, high=0.2)
    readings = readings_of(platform, poses, 3)
    right = mean_errors(ClosedForm(platform).solve(readings).poses, poses)
    wrong = mean_errors(np.array([by_the_paper(matrix, "wrap") for matrix in readings[:, 0]]), poses)
    assert wrong[0] > right[0] + 1.0


def test_the_bound_16_is_none() -> None:
    """R <= r' + 2 rho is broken in a fifth of all poses."""
    poses = random_poses(1000, 4, low=0.16)
    matrices = readings_of(droplet(), poses, 4)[:, 0]
    broken = 0
    for pose, matrix in zip(poses, matrices, strict=True):
        theta = np.arctan2(*(matrix.sum(axis=1) @ units(ANGLES))[::-1])
        phi = theta + np.pi - np.arctan2(*(matrix.sum(axis=0) @ units(ANGLES))[::-1])
        i, j = np.unravel_index(matrix.argmax(), matrix.shape)
        seen = sensor_19(wrapped(theta - ANGLES[i])) * emitter_20(wrapped(theta + np.pi - ANGLES[j] - phi))
        r = np.sqrt(14000.0 / (matrix[i, j] / seen + 1.0)) / 100.0 + 0.03
        broken += pose[0] > r + 2.0 * RHO
    assert 0.1 < broken / len(poses) < 0.3


def test_it_is_as_accurate_as_the_errata_say() -> None:
    platform, poses = droplet(), random_poses(2000, 5, low=0.2, high=0.2)
    solutions = ClosedForm(platform).solve(readings_of(platform, poses, 5))
    centimetres, bearing, heading = mean_errors(solutions.poses, poses)
    assert centimetres < 0.2
    assert bearing < 5.0
    assert heading < 5.0
    poses = random_poses(3000, 6, low=0.16)
    solutions = ClosedForm(platform).solve(readings_of(platform, poses, 6))
    assert np.mean(np.abs(solutions.poses[:, 0] - poses[:, 0]) < 2.0 * RHO) >= 0.997


def test_near_robots_are_seen_by_the_power_that_does_not_saturate() -> None:
    platform, poses = droplet(), random_poses(500, 7, low=0.08, high=0.08)
    readings = readings_of(platform, poses, 7)
    assert readings[:, 0].max() >= platform.saturation
    assert mean_errors(ClosedForm(platform).solve(readings).poses, poses)[0] < 1.0


def test_errors_are_within_the_covariance() -> None:
    """The covariance is that of all directions at such a range, and wide where far robots may seem near."""
    platform, poses = droplet(), random_poses(2000, 8, low=0.06, high=0.3)
    estimator: IrEstimator = ClosedForm(platform)
    solutions = estimator.solve(readings_of(platform, poses, 8))
    errors = solutions.poses - poses
    errors[:, 1:] = wrapped(errors[:, 1:])
    solved = np.linalg.solve(solutions.covariances, errors[..., None])[..., 0]
    assert 1.0 < np.mean(np.sum(errors * solved, axis=1)) < 5.0
    np.linalg.cholesky(solutions.covariances)


def test_known_gains_are_taken_out_of_the_readings() -> None:
    platform, poses = droplet(0.1), random_poses(500, 9, low=0.2, high=0.2)
    rng = np.random.default_rng(9)
    one = IrGains(tuple(rng.uniform(0.7, 1.3, 6)), tuple(rng.uniform(0.7, 1.3, 6)))
    gains = PairGains.of([one] * len(poses), [one] * len(poses))
    readings = readings_of(platform, poses, 9, gains)
    estimator = ClosedForm(platform)
    known, unknown = estimator.solve(readings, gains), estimator.solve(readings)
    assert mean_errors(known.poses, poses)[0] < 0.3 < mean_errors(unknown.poses, poses)[0]
    assert np.median(unknown.covariances[:, 0, 0]) > 4.0 * np.median(known.covariances[:, 0, 0])


def test_any_number_of_elements_will_do() -> None:
    platform = load_ir_platform("epuck_twelve")
    poses = random_poses(300, 10, low=0.15, high=0.5)
    solutions = ClosedForm(platform).solve(readings_of(platform, poses, 10))
    assert np.all(solutions.outcomes == IrOutcome.FOUND)
    assert np.all(mean_errors(solutions.poses, poses) < [2.0, 5.0, 6.0])


def test_what_holds_no_pose_gives_none() -> None:
    platform = droplet()
    dark, blinding = np.zeros((1, 2, 6, 6)), np.full((1, 2, 6, 6), 255.0)
    missing, negative = np.full((1, 2, 6, 6), np.nan), np.full((1, 2, 6, 6), -200.0)
    solutions = ClosedForm(platform).solve(np.concatenate([dark, blinding, missing, negative]))
    assert [IrOutcome(outcome) for outcome in solutions.outcomes] == [
        IrOutcome.TOO_WEAK,
        IrOutcome.UNDETERMINED,
        IrOutcome.TOO_WEAK,
        IrOutcome.TOO_WEAK,
    ]
    assert np.isnan(solutions.poses).all()
    assert np.isnan(solutions.covariances).all()
