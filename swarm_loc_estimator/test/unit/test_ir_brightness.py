"""The model of brightness: its values, slopes and cost, and the gains of elements."""

import math

import numpy as np
import pytest
from core_geometry import nees, slopes_of
from ir_world import droplet, droplet_matrix, pair_of, pose_errors, random_poses, readings_of

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.infrared.brightness import expected_brightness, expected_with_slopes
from swarm_loc_estimator.infrared.cost import CostWorkspace, Pair, cost_of, new_cost_workspace
from swarm_loc_estimator.infrared.gains import Exchanges, GainsError, GainsFit, estimate_gains
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.offline.calibration.infrared.gains import (
    ALIKE,
    GAINS,
    UNKNOWN,
    held_out_likelihoods,
    helpful_gains,
)
from swarm_loc_estimator.swarm.ir_board import (
    PACKAGED,
    IrGains,
    IrModel,
    IrPlatform,
    PairGains,
    load_ir_platform,
)


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


@pytest.mark.parametrize("name", PACKAGED)
def test_slopes_are_those_of_the_readings(name: str) -> None:
    platform = load_ir_platform(name)
    poses = random_poses(40, 3, low=0.1)
    numeric = slopes_of(lambda change: expected_brightness(platform, poses + change), 3, (1e-8, 1e-7, 1e-7))
    np.testing.assert_allclose(expected_with_slopes(platform, poses)[1], numeric, rtol=2e-4, atol=1e-3)


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


def costs_at(model: IrModel, pair: Pair, pose: FloatArray) -> tuple[float, CostWorkspace]:
    work = new_cost_workspace(model.amplitudes.shape[0], model.angles.size, False)
    return cost_of(model, pair, pose, work, work.gradients[0], work.hessians[0]), work


def test_what_a_dead_element_reads_does_not_count() -> None:
    model, pose = droplet().model, random_poses(1, 6, low=0.1)[0]
    readings = readings_of(droplet(), pose[None], 6)[0]
    gains = np.ones((2, 6))
    gains[0, 2], gains[1, 4] = math.nan, math.nan
    missing = readings.copy()
    missing[:, 2], missing[:, :, 4] = math.nan, math.nan
    dead, _ = costs_at(model, pair_of(model, readings, 255.0, gains), pose)
    without, _ = costs_at(model, pair_of(model, missing, 255.0), pose)
    assert dead == without


ROBOTS = 3


def recorded(
    count: int, seed: int, *, known: bool, low: float = 0.08, high: float = 0.28
) -> tuple[FloatArray, Exchanges]:
    """True log-gains (2, robots, n), and what robots read of each other."""
    rng = np.random.default_rng(seed)
    logs = 0.1 * rng.standard_normal((2, ROBOTS, 6))
    receiver = rng.integers(0, ROBOTS, count)
    transmitter = (receiver + rng.integers(1, ROBOTS, count)) % ROBOTS
    poses = random_poses(count, seed, low, high)
    readings = readings_of(droplet(), poses, seed, pairs_of(logs, receiver, transmitter))
    saturation = np.full(readings.shape[:2], droplet().saturation)
    told = poses if known else np.full_like(poses, np.nan)
    return logs, Exchanges(receiver, transmitter, readings, saturation, told)


def pairs_of(logs: FloatArray, receiver: IntArray, transmitter: IntArray) -> PairGains:
    factors = np.exp(logs)
    return PairGains(factors[0, receiver], factors[1, transmitter], np.zeros((len(receiver), 4)))


def errors_of(fit: GainsFit, logs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors of log-gains about their mean (2, robots, n), and of the mean of pairs (robots, robots)."""
    found = np.log([[gains.sensor for gains in fit.gains], [gains.emitter for gains in fit.gains]])
    error = found - logs
    means = error.mean(axis=-1)
    return error - means[..., None], (means[0][:, None] + means[1])[~np.eye(ROBOTS, dtype=bool)]


@pytest.mark.parametrize(("known", "own_limit", "pair_limit"), [(True, 0.008, 0.005), (False, 0.03, 0.03)])
def test_gains_come_out_as_they_are_and_as_sure_as_is_said(
    known: bool, own_limit: float, pair_limit: float
) -> None:
    logs, exchanges = recorded(300, 1, known=known)
    fit = estimate_gains(droplet(0.1), ROBOTS, exchanges)
    own, pair = errors_of(fit, logs)
    assert np.std(own) < own_limit
    assert np.std(pair) < pair_limit
    said = np.array([(gains.sigma, gains.common_sigma) for gains in fit.gains])
    assert 0.4 < np.std(own) / np.sqrt(np.mean(said[:, 0] ** 2)) < 1.8
    assert np.sqrt(np.mean(pair**2)) < 3.0 * np.sqrt(2.0 * np.mean(said[:, 1] ** 2))
    assert np.mean(fit.used) > 0.9
    before, after = (np.sqrt(np.nanmean(residuals**2)) for residuals in (fit.before, fit.after))
    assert after < 1.05
    assert before > 1.3


@pytest.mark.parametrize(("known", "own_limit", "pair_limit"), [(True, 0.01, 0.01), (False, 0.018, 0.055)])
def test_ambient_light_that_was_not_subtracted_does_not_matter(
    known: bool, own_limit: float, pair_limit: float
) -> None:
    logs, exchanges = recorded(300, 8, known=known)
    ambient = np.random.default_rng(8).uniform(0.0, 1.5, (300, 1, 6, 1))
    fit = estimate_gains(droplet(0.1), ROBOTS, exchanges._replace(readings=exchanges.readings + ambient))
    own, pair = errors_of(fit, logs)
    assert np.std(own) < own_limit
    assert np.sqrt(np.mean(pair**2)) < pair_limit


def test_gains_are_less_sure_of_exchanges_that_contradict_each_other() -> None:
    """Robots that move while they exchange: poses that are a little off."""
    logs, exchanges = recorded(300, 9, known=True)
    rng = np.random.default_rng(9)
    shaken = exchanges.poses + rng.standard_normal((300, 3)) * [0.001, 0.03, 0.03]
    fit = estimate_gains(droplet(0.1), ROBOTS, exchanges._replace(poses=shaken))
    own, _ = errors_of(fit, logs)
    said = np.sqrt(np.mean([gains.sigma**2 for gains in fit.gains]))
    assert 0.5 < np.std(own) / said < 1.8


def test_calibrated_robots_measure_better() -> None:
    """As much as is asked of a Droplet at 20 cm: 10 % mismatch costs half a centimetre, then a tenth."""
    logs, exchanges = recorded(600, 2, known=False)
    fit = estimate_gains(droplet(0.1), ROBOTS, exchanges)
    poses = random_poses(600, 3, low=0.2, high=0.2)
    zero, one = np.zeros(600, int), np.ones(600, int)
    readings = readings_of(droplet(), poses, 3, pairs_of(logs, zero, one))
    estimator = MaximumLikelihood(droplet(0.1))
    gains = PairGains.of([fit.gains[0]] * 600, [fit.gains[1]] * 600)
    before, after = estimator.solve(readings), estimator.solve(readings, gains)
    errors = pose_errors(after.poses, poses)
    assert np.mean(np.abs(errors[:, 0])) < 0.4 * np.mean(np.abs(before.poses[:, 0] - 0.2))
    assert np.mean(nees(errors, after.covariances)) < 6.0


def test_far_robots_alone_leave_the_common_gain_open_and_that_is_said() -> None:
    logs, exchanges = recorded(200, 4, known=False, low=0.2, high=0.28)
    fit = estimate_gains(droplet(0.1), ROBOTS, exchanges)
    _, pair = errors_of(fit, logs)
    said = np.sqrt(2.0 * np.mean([gains.common_sigma**2 for gains in fit.gains]))
    assert said > 0.02
    assert np.sqrt(np.mean(pair**2)) < 3.0 * said
    with_poses = estimate_gains(droplet(0.1), ROBOTS, recorded(200, 4, known=True, low=0.2, high=0.28)[1])
    assert np.mean([gains.common_sigma for gains in with_poses.gains]) < 0.3 * said


def test_a_robot_that_took_part_in_nothing_is_as_unsure_as_before() -> None:
    exchanges = recorded(100, 5, known=True)[1]
    alone = (exchanges.receiver < 2) & (exchanges.transmitter < 2)
    exchanges = Exchanges._make(column[alone] for column in exchanges)
    fit = estimate_gains(droplet(0.1), ROBOTS, exchanges)
    np.testing.assert_allclose(fit.gains[2].sensor, 1.0)
    np.testing.assert_allclose(fit.gains[2].emitter, 1.0)
    total = np.hypot(fit.gains[2].sigma, fit.gains[2].common_sigma)
    assert total == pytest.approx(0.1, rel=1e-6)


def test_exchanges_that_went_wrong_do_not_matter() -> None:
    logs, exchanges = recorded(300, 6, known=True)
    rng = np.random.default_rng(6)
    exchanges.readings[:30] = rng.permuted(exchanges.readings[:30], axis=3)
    exchanges.readings[30:60] = rng.standard_normal((30, 2, 6, 6))
    exchanges.readings[60:80] = np.nan
    fit = estimate_gains(droplet(0.1), ROBOTS, exchanges)
    own, pair = errors_of(fit, logs)
    assert np.std(own) < 0.01
    assert np.std(pair) < 0.01
    assert not fit.used[30:80].any()
    assert np.mean(fit.used[:30]) < 0.5


def test_matrices_that_tell_nothing_are_refused_in_one_sentence() -> None:
    exchanges = recorded(20, 7, known=False)[1]
    with pytest.raises(GainsError, match="element_sigma of the platform is 0, so that all gains are 1"):
        estimate_gains(droplet(), ROBOTS, exchanges)
    exchanges.readings[:] = 0.0
    with pytest.raises(GainsError, match="None of 20 exchanges determines a pose"):
        estimate_gains(droplet(0.1), ROBOTS, exchanges)


PAPER, REAL = droplet(0.1), load_ir_platform("droplet_2016")
N = 6


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
