"""Expected readings, their slopes, and what goes wrong with eqs (1)-(4) as printed."""

import numpy as np
import pytest
from ir_world import droplet, droplet_matrix, random_poses

from swarm_loc_estimator.infrared.brightness import expected_brightness, expected_with_slopes
from swarm_loc_estimator.swarm.ir_board import PACKAGED, IrGains, PairGains, load_ir_platform


def test_readings_are_those_of_the_corrected_equations() -> None:
    poses = random_poses(200, 1, low=0.09)
    corrected = np.array([droplet_matrix(pose) for pose in poses])
    np.testing.assert_allclose(expected_brightness(droplet(), poses)[:, 0], corrected, rtol=1e-5)


@pytest.mark.parametrize("part", ["turn_emitters", "wrap"])
def test_readings_are_not_those_of_the_printed_equations(part: str) -> None:
    """(1) as printed does not turn the emitters by phi; (2), (3) feed unwrapped angles to (19), (20)."""
    poses = random_poses(200, 2, low=0.09)
    printed = np.array([droplet_matrix(pose, **{part: False}) for pose in poses])
    error = np.abs(expected_brightness(droplet(), poses)[:, 0] - printed).max(axis=(1, 2))
    assert np.median(error) > 5.0


def test_robots_that_face_each_other_read_most_with_the_elements_between_them() -> None:
    bright = expected_brightness(droplet(), [0.15, np.radians(30.0), np.radians(180.0)])[0, 0]
    assert np.unravel_index(bright.argmax(), bright.shape) == (5, 5)


@pytest.mark.parametrize("name", PACKAGED)
def test_slopes_are_those_of_the_readings(name: str) -> None:
    platform = load_ir_platform(name)
    poses = random_poses(40, 3, low=0.1)
    slopes = expected_with_slopes(platform, poses)[1]
    for column, step in enumerate((1e-8, 1e-7, 1e-7)):
        ahead, behind = poses.copy(), poses.copy()
        ahead[:, column] += step
        behind[:, column] -= step
        numeric = (expected_brightness(platform, ahead) - expected_brightness(platform, behind)) / (
            2.0 * step
        )
        np.testing.assert_allclose(slopes[..., column], numeric, rtol=2e-4, atol=1e-3)


def test_turning_both_robots_by_one_element_shifts_the_matrix() -> None:
    platform, step = droplet(), np.radians(60.0)
    pose = np.array([0.13, 0.4, -1.0])
    # both bodies are turned by a step, so the elements' numbers go round once
    before = expected_brightness(platform, pose)[0]
    sensors = expected_brightness(platform, pose + np.array([0.0, step, step]))[0]
    np.testing.assert_allclose(np.roll(before, -1, axis=1), sensors, rtol=1e-6)
    emitters = expected_brightness(platform, pose + np.array([0.0, 0.0, -step]))[0]
    np.testing.assert_allclose(np.roll(before, -1, axis=2), emitters, rtol=1e-6)


def test_gains_multiply_readings_and_slopes() -> None:
    platform = droplet()
    rng = np.random.default_rng(4)
    one, two = (IrGains(tuple(rng.uniform(0.8, 1.2, 6)), tuple(rng.uniform(0.8, 1.2, 6))) for _ in range(2))
    poses = random_poses(2, 5)
    gains = PairGains.of([one, two], [two, one])
    plain, with_gains = expected_with_slopes(platform, poses), expected_with_slopes(platform, poses, gains)
    factor = np.array([np.outer(one.sensor, two.emitter), np.outer(two.sensor, one.emitter)])[:, None]
    np.testing.assert_allclose(with_gains[0], plain[0] * factor)
    np.testing.assert_allclose(with_gains[1], plain[1] * factor[..., None])


def test_contact_and_coincidence_stay_finite() -> None:
    readings, slopes = expected_with_slopes(droplet(), [[0.0, 0.0, 0.0], [0.044, 0.5236, 3.1416]])
    assert np.isfinite(readings).all()
    assert np.isfinite(slopes).all()
