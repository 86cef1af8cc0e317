"""The fit of a board: slopes against differences, curves and yaw found again, dead sensors."""

from dataclasses import replace

import numpy as np
import pytest
from ir_world import random_poses

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.infrared.brightness import curve_at, expected_brightness
from swarm_loc_estimator.offline.calibration.infrared.board import (
    BoardReadings,
    _Problem,
    errors_of,
    fit_board,
    turned,
    without_dead,
)
from swarm_loc_estimator.swarm.ir_board import PairGains, load_ir_platform

PLATFORM = load_ir_platform("droplet_2016")
ROBOTS = 4
YAW = np.radians([0.0, 4.0, -3.0, 2.0])
FACTORS = np.array([1.2, 0.8, 1.1, 0.9, 1.25, 0.85])


def recorded(count: int, seed: int) -> BoardReadings:
    """Robot 0 reads the others, which turn and whose truth is off by `YAW`; a few readings are blocked."""
    rng = np.random.default_rng(seed)
    transmitter = rng.integers(1, ROBOTS, count)
    receiver = np.zeros(count, dtype=np.int64)
    told = random_poses(count, seed, low=0.05, high=0.2)
    true = turned(told, YAW[receiver], YAW[transmitter])
    gains = PairGains(np.tile(FACTORS, (count, 1)), np.ones((count, 6)), np.zeros((count, 4)))
    light = expected_brightness(PLATFORM, true, gains)[:, 0]
    light = np.where(rng.uniform(size=light.shape) < 0.05, 0.0, light)
    light = light * np.exp(0.1 * rng.standard_normal(light.shape)) + 15.0 * rng.standard_normal(light.shape)
    readings = np.minimum(light, PLATFORM.saturation)
    return BoardReadings(receiver, transmitter, readings, told, np.arange(count, dtype=np.int64))


def values(curve: FloatArray) -> FloatArray:
    """Relative to straight ahead."""
    relative: FloatArray = curve / curve[0]
    return relative


def test_slopes_are_those_of_differences() -> None:
    problem = _Problem(replace(PLATFORM, curve_sigma=0.2), recorded(120, 1), ROBOTS)
    rng = np.random.default_rng(1)
    at = problem.first_unknowns()
    at = at + 0.03 * rng.standard_normal(at.size)
    slopes, step = problem.slopes(at), 1e-6
    for k in range(at.size):
        ahead, behind = at.copy(), at.copy()
        ahead[k] += step
        behind[k] -= step
        difference = (problem.residuals(ahead) - problem.residuals(behind)) / (2.0 * step)
        np.testing.assert_allclose(slopes[:, k], difference, atol=5e-3)


@pytest.mark.parametrize("seed", [2, 3])
def test_curves_yaw_and_gains_are_found_again(seed: int) -> None:
    model = fit_board(load_ir_platform("droplet_2016"), recorded(500, seed), ROBOTS)
    angles = np.radians([20.0, 40.0, 50.0, 60.0])
    for name in ("sensor", "emitter"):
        found, true = (
            np.array([curve_at(getattr(one, name).table(), a)[0] for a in (0.0, *angles)])
            for one in (model.platform, PLATFORM)
        )
        np.testing.assert_allclose(values(found), values(true), rtol=0.15)
    np.testing.assert_allclose(np.degrees(model.truth_yaw), np.degrees(YAW), atol=1.5)
    np.testing.assert_allclose(values(model.sensor_gains[0]), values(FACTORS), rtol=0.1)
    assert 10.0 < model.platform.noise < 20.0


def dark_sensor(data: BoardReadings, sensor: int, seed: int) -> BoardReadings:
    """The same, of one sensor of robot 0 nothing but noise."""
    readings = data.readings.copy()
    readings[:, sensor] = 15.0 * np.random.default_rng(seed).standard_normal(readings[:, sensor].shape)
    return data._replace(readings=readings)


@pytest.mark.parametrize("seed", [4, 5])
def test_a_dead_sensor_is_found_and_left_out_though_the_curves_to_begin_with_are_wrong(seed: int) -> None:
    paper, data = load_ir_platform("droplet"), dark_sensor(recorded(300, seed), 2, seed)
    narrow = replace(PLATFORM, sensor=paper.sensor, emitter=paper.emitter)
    elements, alive = without_dead(fit_board(narrow, data, ROBOTS).platform, data, ROBOTS)
    assert np.argwhere(elements.dead).tolist() == [[0, 0, 2]]
    assert np.isnan(alive.readings[:, 2]).all()
    assert np.isfinite(alive.readings[:, [0, 1, 3, 4, 5]]).all()
    assert not without_dead(PLATFORM, recorded(300, seed), ROBOTS)[0].dead.any()


@pytest.mark.parametrize("seed", [6, 7])
def test_sensors_that_nobody_faced_are_not_called_dead(seed: int) -> None:
    """All robots are ahead of the receiver; its sensors 2 and 3 look back."""
    data = recorded(600, seed)
    ahead = select(data, np.abs(data.poses[:, 1]) < 1.2)
    brightest = np.quantile(ahead.readings.max(axis=2), 0.95, axis=0)
    assert brightest[[2, 3]].max() < 0.2 * np.median(brightest)
    elements, _ = without_dead(fit_board(PLATFORM, ahead, ROBOTS).platform, ahead, ROBOTS)
    assert not elements.dead.any()


def with_stray_light(data: BoardReadings, share: float, seed: int) -> BoardReadings:
    """The same with light by way of bodies and floor, a share of the brightest reading of each exchange."""
    brightest = data.readings.max(axis=(1, 2), keepdims=True)
    light = share * brightest * np.random.default_rng(seed).standard_normal(data.readings.shape)
    return data._replace(readings=np.minimum(data.readings + light, PLATFORM.saturation))


@pytest.mark.parametrize("seed", [8, 9])
def test_a_board_that_knows_of_stray_light_is_less_overconfident(seed: int) -> None:
    data = with_stray_light(recorded(400, seed), 0.06, seed)
    model = fit_board(PLATFORM, data, ROBOTS)
    nees = {
        stray: errors_of(replace(model, platform=replace(model.platform, stray_noise=stray)), data).nees
        for stray in (0.0, 0.06)
    }
    assert np.mean(nees[0.06]) < 0.6 * np.mean(nees[0.0])
