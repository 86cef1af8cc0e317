"""Sway and noise of cameras are told apart by what different markers have in common."""

import numpy as np
import pytest

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.offline.calibration.models import with_noise
from swarm_loc_estimator.offline.calibration.sightings import sway_of
from swarm_loc_estimator.swarm.error_models import SensorModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm


def sightings(seed: int, sway: float, time_s: float, noise: float) -> tuple[FloatArray, IntArray, FloatArray]:
    """Times, markers and bearing errors of a camera that sways and sees two of five markers at a time."""
    rng = np.random.default_rng(seed)
    images = 0.2 * np.arange(3000)
    yaw, yaws = sway * rng.standard_normal(), []
    kept = np.exp(-0.2 / time_s)
    for _ in images:
        yaws.append(yaw)
        yaw = kept * yaw + np.sqrt(1.0 - kept**2) * sway * rng.standard_normal()
    marker = np.concatenate([rng.permutation(5)[:2] for _ in images])
    bearing = np.repeat(yaws, 2) + noise * rng.standard_normal(2 * images.size)
    return np.repeat(images, 2), marker, bearing


@pytest.mark.parametrize("time_s", [3.0, 10.0])
@pytest.mark.parametrize(("sway", "noise"), [(0.02, 0.01), (0.005, 0.01)])
def test_the_sway_of_a_camera_is_recovered(sway: float, noise: float, time_s: float) -> None:
    found = np.array([sway_of(*sightings(seed, sway, time_s, noise)) for seed in range(6)])
    assert np.median(found[:, 0]) == pytest.approx(sway, rel=0.15)
    assert np.median(found[:, 1]) == pytest.approx(time_s, rel=0.35)


def test_noise_of_single_sightings_is_no_sway() -> None:
    assert sway_of(*sightings(1, 0.0, 5.0, 0.01)) == (0.0, 0.0)
    time_s, marker, bearing = sightings(2, 0.02, 5.0, 0.01)
    assert sway_of(time_s, np.zeros_like(marker), bearing) == (0.0, 0.0)  # one marker tells nothing


def test_noise_that_is_scaled_keeps_its_ratios_between_robots() -> None:
    sensors = (SensorModel(bearing_sigma=0.01), SensorModel(bearing_sigma=0.04))
    swarm = Swarm(tuple(Robot(f"r{k}", sensor=sensor) for k, sensor in enumerate(sensors)))
    scaled = with_noise(swarm, {"bearing_sigma": 0.06, "turn_drift": 1e-3})
    assert [robot.sensor.bearing_sigma for robot in scaled.robots] == pytest.approx([0.03, 0.12])
    assert {robot.odometry.turn_drift for robot in scaled.robots} == {1e-3}
