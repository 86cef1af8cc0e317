"""Gains are kept where they help exchanges that they were not estimated from, and else refused."""

import numpy as np
import pytest
from ir_world import droplet, random_poses

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.gains import Exchanges
from swarm_loc_estimator.offline.calibration.infrared.gains import (
    ALIKE,
    GAINS,
    UNKNOWN,
    held_out_likelihoods,
    helpful_gains,
)
from swarm_loc_estimator.swarm.ir_board import IrGains, IrPlatform, PairGains, load_ir_platform

PAPER, REAL = droplet(0.1), load_ir_platform("droplet_2016")
ROBOTS, N = 3, 6


def exchanged(
    truly: IrPlatform, spread: float, count: int, seed: int, *, known: bool = False
) -> tuple[FloatArray, Exchanges]:
    """True factors (2, robots, n) of elements that differ by `spread`, and what robots read.

    They stand elsewhere at every exchange; readings err, and are blocked, as the board says.
    """
    rng = np.random.default_rng([seed, count])
    factors = np.exp(spread * rng.standard_normal((2, ROBOTS, N)))
    receiver = rng.integers(0, ROBOTS, count)
    transmitter = (receiver + rng.integers(1, ROBOTS, count)) % ROBOTS
    poses = random_poses(count, seed, 0.06, 0.2)
    gains = PairGains(factors[0, receiver], factors[1, transmitter], np.zeros((count, 4)))
    light = expected_brightness(truly, poses, gains)
    light[rng.uniform(size=light.shape) < truly.blocked_share] = 0.0
    light *= np.exp(truly.curve_sigma * rng.standard_normal(light.shape))
    light += truly.noise * rng.standard_normal(light.shape)
    limits = np.full(light.shape[:2], truly.saturation)
    told = poses if known else np.full_like(poses, np.nan)
    return factors, Exchanges(receiver, transmitter, np.minimum(light, truly.saturation), limits, told)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("seed", [21, 22])
def test_gains_of_elements_that_differ_help(seed: int, known: bool) -> None:
    assert helpful_gains(PAPER, ROBOTS, exchanged(PAPER, 0.1, 120, seed, known=known)[1]).all()


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("seed", [23, 24])
def test_gains_of_elements_that_do_not_differ_are_refused(seed: int, known: bool) -> None:
    """Also on a board that reads with a noise of tens of percent."""
    assert not helpful_gains(PAPER, ROBOTS, exchanged(PAPER, 0.0, 120, seed, known=known)[1]).any()
    assert not helpful_gains(REAL, ROBOTS, exchanged(REAL, 0.0, 200, seed, known=known)[1]).any()


@pytest.mark.parametrize("seed", [25, 26])
def test_gains_that_hold_in_one_stretch_of_time_only_are_refused(seed: int) -> None:
    """Elements that differ in each quarter of the recording by other amounts, as errors of a board do."""
    parts = [exchanged(PAPER, 0.1, 40, 10 * seed + quarter)[1] for quarter in range(4)]
    joined = Exchanges(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    assert not helpful_gains(PAPER, ROBOTS, joined).any()


@pytest.mark.parametrize("seed", [27, 28])
def test_a_robot_whose_elements_change_is_refused_alone(seed: int) -> None:
    """The first robot's elements differ in every quarter by other amounts, by more than the board says."""
    _, exchanges = exchanged(PAPER, 0.1, 200, seed)
    readings, quarter = exchanges.readings.copy(), np.arange(200) // 50
    rng = np.random.default_rng(seed)
    for k in range(4):
        sensor, emitter = np.exp(0.2 * rng.standard_normal((2, N)))
        readings[(quarter == k) & (exchanges.receiver == 0)] *= sensor[:, None]
        readings[(quarter == k) & (exchanges.transmitter == 0)] *= emitter
    kept = helpful_gains(PAPER, ROBOTS, exchanges._replace(readings=readings))
    assert kept.tolist() == [False, True, True]


@pytest.mark.parametrize("known", [False, True])
def test_exchanges_are_likelier_by_true_gains(known: bool) -> None:
    factors, exchanges = exchanged(PAPER, 0.1, 60, 31, known=known)
    true = tuple(IrGains(tuple(s.tolist()), tuple(e.tolist()), 0.01) for s, e in np.swapaxes(factors, 0, 1))
    logs = held_out_likelihoods(PAPER, true, exchanges)
    told = np.isfinite(logs).all(axis=(1, 2))
    assert told.mean() > 0.95
    for other in (ALIKE, UNKNOWN):
        assert np.mean(logs[told, GAINS, GAINS] - logs[told, other, other]) > 1.0


def test_what_is_never_seen_says_nothing() -> None:
    _, exchanges = exchanged(PAPER, 0.1, 40, 29)
    dark = exchanges._replace(readings=np.zeros_like(exchanges.readings))
    gains = (IrGains.unknown(PAPER),) * ROBOTS
    assert np.isnan(held_out_likelihoods(PAPER, gains, dark)).all()
    assert not helpful_gains(PAPER, ROBOTS, dark).any()


def test_the_order_of_robots_does_not_matter() -> None:
    """All orders of three follow from an exchange of two and a cycle."""
    _, exchanges = exchanged(PAPER, 0.03, 60, 30)
    one = helpful_gains(PAPER, ROBOTS, exchanges)
    for places in np.array([[1, 0, 2], [1, 2, 0]]):
        receiver, transmitter = places[exchanges.receiver], places[exchanges.transmitter]
        two = helpful_gains(PAPER, ROBOTS, exchanges._replace(receiver=receiver, transmitter=transmitter))
        np.testing.assert_array_equal(one, two[places])
