"""The likelihood of brightness matrices: solutions, covariances, saturated and blocked readings."""

from dataclasses import replace

import numpy as np
import pytest
from core_geometry import nees, slopes_of
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from ir_world import (
    ANGLES,
    RHO,
    differing_gains,
    droplet,
    pair_of,
    pose_errors,
    random_poses,
    readings_of,
    units,
    wrapped,
)
from scipy.integrate import quad

from bench.droplet.cramer_rao import information
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import add_spread, expected_brightness, new_start_workspace
from swarm_loc_estimator.infrared.cost import SATURATED, Pair, cost_of, new_cost_workspace
from swarm_loc_estimator.infrared.gains import Exchanges, estimate_gains
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.infrared.search import IrOutcome, IrSolutions, ReadingsError
from swarm_loc_estimator.swarm.ir_board import (
    IrGains,
    IrPlatform,
    PairGains,
    TabulatedCurve,
    load_ir_platform,
)

ALIKE = MaximumLikelihood(droplet())
DIFFERING = MaximumLikelihood(droplet(0.1))


def errors_at_the_bound(solutions: IrSolutions, poses: FloatArray, platform: IrPlatform) -> FloatArray:
    """Errors (k, 3) of solutions, which are those of the Cramer-Rao bound, as the covariances say."""
    assert np.all(solutions.outcomes == IrOutcome.FOUND)
    errors = pose_errors(solutions.poses, poses)
    bound = np.mean(np.diagonal(np.linalg.inv(information(platform, poses)), axis1=1, axis2=2), axis=0)
    assert np.all(np.sqrt(np.mean(errors**2, axis=0) / bound) < 1.1)
    squares = nees(errors, solutions.covariances)
    assert 2.5 < np.mean(squares) < 4.0
    assert 2.0 < np.median(squares) < 2.7  # 2.37 in theory
    assert np.mean(solutions.misfits) == pytest.approx(1.0, abs=0.03)
    return errors


@pytest.mark.parametrize("centimetres", [6, 10, 13, 16, 20, 28])
def test_errors_are_those_of_the_cramer_rao_bound_and_the_covariance_says_so(centimetres: int) -> None:
    """Also at 12 to 15 cm, where one start from the closed form ends in wrong minima."""
    poses = random_poses(1500, centimetres, low=0.01 * centimetres, high=0.01 * centimetres)
    solutions = ALIKE.solve(readings_of(droplet(), poses, centimetres))
    errors = errors_at_the_bound(solutions, poses, droplet())
    assert np.max(np.abs(errors[:, 0])) < 0.025


@pytest.mark.parametrize("centimetres", [8, 14, 20, 28])
def test_elements_that_differ_by_an_unknown_amount_are_in_the_covariance(centimetres: int) -> None:
    poses = random_poses(1000, centimetres, low=0.01 * centimetres, high=0.01 * centimetres)
    gains = differing_gains(len(poses), 6, 0.1, centimetres)
    readings = readings_of(droplet(), poses, centimetres, gains)
    honest, naive = DIFFERING.solve(readings), ALIKE.solve(readings)
    errors = pose_errors(honest.poses, poses)
    assert 2.0 < np.mean(nees(errors, honest.covariances)) < 5.0
    assert np.mean(np.abs(errors[:, 0])) < np.mean(np.abs(honest.poses[:, 0] * 0.05)) + 0.002
    found = naive.outcomes == IrOutcome.FOUND
    over_sure = nees(pose_errors(naive.poses, poses)[found], naive.covariances[found])
    assert np.mean(over_sure) > 30.0  # the test above is one


def test_known_gains_are_as_good_as_elements_that_are_alike() -> None:
    poses = random_poses(800, 1, low=0.2, high=0.2)
    gains = differing_gains(len(poses), 6, 0.1, 1)
    solutions = DIFFERING.solve(readings_of(droplet(), poses, 1, gains), gains)
    errors = pose_errors(solutions.poses, poses)
    assert np.mean(np.abs(errors[:, 0])) < 0.0008
    assert 2.5 < np.mean(nees(errors, solutions.covariances)) < 4.0


def test_a_common_error_of_gains_widens_the_range_most() -> None:
    poses = random_poses(300, 2, low=0.2, high=0.2)
    readings = readings_of(droplet(), poses, 2)
    ones = (1.0,) * 6
    own, both = (
        DIFFERING.solve(readings, PairGains.of([gains] * 300, [gains] * 300))
        for gains in (IrGains(ones, ones, 0.01), IrGains(ones, ones, 0.01, 0.05))
    )
    # brightness falls with the square of r - 3 cm, r = 15.6 cm: 1 % of it is 0.06 cm
    sigma = np.sqrt(np.median(both.covariances[:, 0, 0] - own.covariances[:, 0, 0]))
    assert sigma == pytest.approx(0.5 * np.sqrt(2.0) * 0.05 * 0.126, rel=0.15)
    assert np.median(both.covariances[:, 1, 1] / own.covariances[:, 1, 1]) < 1.2


def test_readings_that_are_missing_are_left_out() -> None:
    poses = random_poses(800, 3, low=0.1, high=0.25)
    readings = readings_of(droplet(), poses, 3)
    readings[np.random.default_rng(3).random(readings.shape) < 0.3] = np.nan
    solutions = ALIKE.solve(readings)
    found = solutions.outcomes == IrOutcome.FOUND
    assert np.mean(found) > 0.97  # of some, all that was bright is missing
    assert 2.5 < np.mean(nees(pose_errors(solutions.poses, poses), solutions.covariances)[found]) < 5.0


@pytest.mark.parametrize("left_out", [0, 1])
def test_one_power_alone_will_do(left_out: int) -> None:
    """The far one saturates within 15 cm; what does not saturate there still tells the pose."""
    poses = random_poses(500, 4 + left_out, low=0.08, high=0.12)
    readings = readings_of(droplet(), poses, 4)
    readings[:, left_out] = np.nan
    solutions = ALIKE.solve(readings)
    found = solutions.outcomes == IrOutcome.FOUND
    assert np.mean(found) > 0.97
    errors = pose_errors(solutions.poses, poses)[found]
    assert np.mean(np.abs(errors[:, 0])) < 0.003
    assert np.median(nees(errors, solutions.covariances[found])) < 3.5


def test_noise_relative_to_readings_is_weighed() -> None:
    platform = replace(droplet(), relative_noise=0.03)
    poses = random_poses(1000, 7, low=0.1, high=0.25)
    solutions = MaximumLikelihood(platform).solve(readings_of(platform, poses, 7))
    assert 2.5 < np.mean(nees(pose_errors(solutions.poses, poses), solutions.covariances)) < 4.0


def test_readings_that_fit_badly_widen_the_covariance() -> None:
    poses = random_poses(300, 8, low=0.2, high=0.2)
    readings = expected_brightness(droplet(), poses)
    noise = np.random.default_rng(8).standard_normal(readings.shape)
    one, three = (ALIKE.solve(np.minimum(readings + factor * noise, 255.0)) for factor in (1.0, 3.0))
    assert np.median(three.misfits / one.misfits) == pytest.approx(9.0, rel=0.1)
    grown = three.covariances[:, 0, 0] / one.covariances[:, 0, 0]
    assert np.median(grown) == pytest.approx(9.0, rel=0.2)


def test_the_share_that_lasts_is_what_exchanges_with_other_noise_have_in_common() -> None:
    poses = random_poses(4000, 18, low=0.12, high=0.24)
    gains = differing_gains(len(poses), 6, 0.1, 18)
    once, again = (DIFFERING.solve(readings_of(droplet(), poses, seed, gains)) for seed in (18, 19))
    found = (once.outcomes == IrOutcome.FOUND) & (again.outcomes == IrOutcome.FOUND)
    one, other = (pose_errors(s.poses, poses)[found] for s in (once, again))
    variances = np.diagonal(once.covariances[found], axis1=1, axis2=2)
    core = (np.abs(one) < 4.0 * np.sqrt(variances)).all(axis=1) & (other**2 < 16.0 * variances).all(axis=1)
    scaled = 1.0 / variances[core]  # every pair counts alike
    common = np.mean(one[core] * other[core] * scaled, axis=0) / np.mean(one[core] ** 2 * scaled, axis=0)
    np.testing.assert_allclose(common, once.systematic_share[found][core].mean(axis=0), atol=0.12)
    assert (once.systematic_share[found] > 0.0).all()
    assert (once.systematic_share[found] <= 1.0).all()
    exact = MaximumLikelihood(droplet()).solve(readings_of(droplet(), poses[:50], 18))
    assert (exact.systematic_share[exact.outcomes == IrOutcome.FOUND] == 0.0).all()


def with_a_robot_between(poses: FloatArray, seed: int) -> tuple[FloatArray, FloatArray]:
    """Readings (k, modes, n, n) with a third robot between, and the share of light that it blocks (k,)."""
    rng = np.random.default_rng(seed)
    clear = expected_brightness(droplet(), poses, differing_gains(len(poses), 6, 0.1, seed))
    ahead = units(poses[:, 1])
    along = rng.uniform(0.048, poses[:, 0] - 0.048)
    aside = rng.uniform(-0.06, 0.06, len(poses))
    third = along[:, None] * ahead + aside[:, None] * np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
    sensors = RHO * units(ANGLES)[None, :, None]
    emitters = ((poses[:, :1] * ahead)[:, None] + RHO * units(ANGLES + poses[:, 2:]))[:, None]
    way, there = emitters - sensors, third[:, None, None] - sensors
    part = np.clip(np.sum(there * way, axis=-1) / np.sum(way**2, axis=-1), 0.0, 1.0)
    blocked = np.linalg.norm(there - part[..., None] * way, axis=-1) < RHO
    light = clear[:, 0]
    share = np.sum(light * blocked, axis=(1, 2)) / np.sum(light, axis=(1, 2))
    noisy = np.where(blocked[:, None], 0.0, clear) + rng.standard_normal(clear.shape)
    return np.minimum(noisy, droplet().saturation), share


def test_a_robot_between_that_blocks_some_of_the_light_does_not_mislead() -> None:
    poses = random_poses(3000, 16, low=0.12, high=0.28)
    readings, share = with_a_robot_between(poses, 16)
    unaware = MaximumLikelihood(replace(droplet(0.1), blocked_share=0.0))
    for low, high, limit in ((0.001, 0.05, 4.5), (0.05, 0.2, 8.0)):
        some = (share > low) & (share < high)
        assert some.sum() > 200
        mean = []
        for estimator in (DIFFERING, unaware):
            solutions = estimator.solve(readings[some])
            found = solutions.outcomes == IrOutcome.FOUND
            errors = pose_errors(solutions.poses, poses[some])[found]
            mean.append(np.mean(nees(errors, solutions.covariances[found])))
        assert mean[0] < limit
        assert mean[1] > 1.5 * mean[0]


def test_alternatives_are_likely_to_their_odds() -> None:
    """With unknown gains, some poses have another one nearly as likely, which now and then is true."""
    poses = random_poses(4000, 9, low=0.22, high=0.3)
    gains = differing_gains(len(poses), 6, 0.1, 9)
    solutions = DIFFERING.solve(readings_of(droplet(), poses, 9, gains))
    given_one = np.isfinite(solutions.alternatives[:, 0])
    assert np.all((solutions.odds >= 0.0) & (solutions.odds <= 1.0))
    assert 0.01 < np.mean(given_one) < 0.3
    likely = given_one & (solutions.odds > 0.2)
    assert likely.sum() > 50
    off = [
        np.linalg.norm(pose_errors(found[likely], poses[likely])[:, 1:], axis=1)
        for found in (solutions.poses, solutions.alternatives)
    ]
    # of poses with odds around 1/2, a third should be the other one
    assert 0.1 < np.mean(off[1] < off[0]) < 0.6


@pytest.mark.parametrize("name", ["epuck_twelve", "three", "uneven"])
def test_any_number_of_elements_at_any_angles_will_do(name: str) -> None:
    angles = np.linspace(-3.0, 3.0, 25)
    wide = TabulatedCurve(
        tuple(angles), tuple(np.cos(0.5 * angles) ** 2)
    )  # lobes as the Droplet's leave gaps
    platforms: dict[str, IrPlatform] = {
        "epuck_twelve": replace(load_ir_platform("epuck_twelve"), element_sigma=0.0),
        "three": replace(droplet(), angles=(0.0, 2.1, -2.1), sensor=wide, emitter=wide),
        "uneven": replace(droplet(), angles=(0.1, 0.9, 1.6, 3.0, -2.3, -1.5, -0.6)),
    }
    platform = platforms[name]
    poses = random_poses(500, 10, low=0.12, high=0.25)
    solutions = MaximumLikelihood(platform).solve(readings_of(platform, poses, 10))
    found = solutions.outcomes == IrOutcome.FOUND
    assert np.mean(found) > 0.95
    errors = pose_errors(solutions.poses, poses)[found]
    assert np.median(np.abs(errors[:, 0])) < 0.005
    assert 1.8 < np.median(nees(errors, solutions.covariances[found])) < 3.2


def cost_at(pair: Pair, at: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    work = new_cost_workspace(2, 6, at.size > 3)
    gradient, hessian = work.gradients[0], work.hessians[0]
    cost = cost_of(droplet().model, pair, at, work, gradient, hessian)
    return cost, gradient.copy(), np.tril(hessian) + np.tril(hessian, -1).T


@pytest.mark.parametrize("seed", range(4))
def test_the_costs_gradient_is_its_slope(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = random_poses(1, seed, low=0.08, high=0.16)
    readings = readings_of(droplet(), pose, seed)[0]
    prior = np.array([[100.0, 0.1], [50.0, 0.15]])
    gains = rng.uniform(0.9, 1.1, (2, 6))
    pair = pair_of(droplet().model, readings, 255.0, gains, prior)
    at = np.concatenate([0.05 * rng.standard_normal(12), pose[0] * [1.01, 1.0, 1.0] + [0.0, 0.01, 0.02]])
    _, gradient, hessian = cost_at(pair, at)
    slopes = slopes_of(lambda change: cost_at(pair, at + change)[0], at.size, 1e-7)
    assert gradient == pytest.approx(slopes, rel=1e-3, abs=0.05)
    assert np.linalg.eigvalsh(hessian).min() > 0.0
    prior_part = np.linalg.inv(np.linalg.inv(100.0 * (np.eye(6) - 0.1)))  # what two log-gains have in common
    without = pair_of(droplet().model, np.full_like(readings, np.nan), 255.0, gains, prior)
    np.testing.assert_allclose(cost_at(without, at)[2][:6, :6], prior_part, atol=1e-9)


def bad(value: float) -> FloatArray:
    return np.full((1, 2, 6, 6), value)


def test_what_holds_no_pose_gives_none_and_says_why() -> None:
    mostly_missing = readings_of(droplet(), random_poses(1, 12, low=0.2), 12)
    mostly_missing[:, :, 1:] = np.nan
    one_sensor = np.full_like(mostly_missing, np.nan)
    one_sensor[0, 0, 0] = mostly_missing[0, 0, 0]
    nonsense = np.random.default_rng(12).uniform(0.0, 250.0, (1, 2, 6, 6))
    cases = {
        IrOutcome.TOO_WEAK: [bad(0.0), np.random.default_rng(13).standard_normal((1, 2, 6, 6))],
        IrOutcome.TOO_FEW: [bad(np.nan), bad(-200.0), bad(-np.inf), one_sensor],
        IrOutcome.UNDETERMINED: [bad(255.0), bad(1e9)],
        IrOutcome.MISFIT: [nonsense],
    }
    for outcome, matrices in cases.items():
        for estimator in (ALIKE, DIFFERING):
            solutions = estimator.solve(np.concatenate(matrices))
            assert [IrOutcome(one) for one in solutions.outcomes] == [outcome] * len(matrices)
            assert np.isnan(solutions.poses).all()
            assert np.isnan(solutions.covariances).all()


def test_infinite_readings_count_as_missing() -> None:
    readings = readings_of(droplet(), random_poses(1, 14, low=0.15), 14)
    missing, infinite = readings.copy(), readings.copy()
    missing[0, 0, 2, 3], infinite[0, 0, 2, 3] = np.nan, np.inf
    np.testing.assert_array_equal(ALIKE.solve(missing).poses, ALIKE.solve(infinite).poses)


ANY_READING = st.one_of(
    st.floats(-300.0, 300.0),
    st.sampled_from([0.0, 255.0, 1e300, -1e300, np.nan, np.inf, -np.inf, -273.0, 2451.0]),
)


@settings(max_examples=150, deadline=None)
@given(arrays(np.float64, (1, 2, 6, 6), elements=ANY_READING), st.booleans())
def test_no_readings_whatsoever_give_a_pose_that_is_not_finite(readings: FloatArray, known: bool) -> None:
    estimator = ALIKE if known else DIFFERING
    solutions = estimator.solve(readings)
    if solutions.outcomes[0] == IrOutcome.FOUND:
        assert np.isfinite(solutions.poses).all()
        assert 0.04 < solutions.poses[0, 0] < 2.0
        np.testing.assert_array_equal(solutions.poses[0, 1:], wrapped(solutions.poses[0, 1:]))
        np.linalg.cholesky(solutions.covariances[0])
        assert np.isfinite([solutions.odds, solutions.misfits]).all()
    else:
        assert np.isnan(solutions.poses).all()


@pytest.mark.parametrize("shape", [(2, 6, 6), (1, 1, 6, 6), (1, 2, 6, 5), (1, 2, 8, 8)])
def test_readings_of_another_size_are_refused_in_one_sentence(shape: tuple[int, ...]) -> None:
    with pytest.raises(ReadingsError, match=r"readings have the shape .* but must have \(pairs, 2, 6, 6\)\."):
        ALIKE.solve(np.zeros(shape))


def test_gains_and_saturation_of_another_shape_are_refused() -> None:
    with pytest.raises(ReadingsError, match=r"gains have the shape \(3, 6\) but must have \(2, 6\)\."):
        ALIKE.solve(np.zeros((2, 2, 6, 6)), differing_gains(3, 6, 0.1, 1))
    with pytest.raises(ReadingsError, match=r"saturation has the shape \(2, 3\) but must have \(2, 2\)\."):
        ALIKE.solve(np.zeros((2, 2, 6, 6)), None, np.zeros((2, 3)))


def test_no_pairs_give_no_solutions() -> None:
    assert ALIKE.solve(np.zeros((0, 2, 6, 6))).poses.shape == (0, 3)


LIMIT = 240.0
NEVER_BLOCKED = replace(droplet(), blocked_share=0.0)


def cut_readings(poses: FloatArray, seed: int) -> FloatArray:
    """Readings (k, modes, n, n) of sensors that saturate at 255 less an ambient light of up to 15 counts."""
    ambient = np.random.default_rng([seed, 1]).uniform(0.0, 255.0 - LIMIT, (len(poses), 1, 6, 1))
    bright = readings_of(replace(droplet(), saturation=1e9), poses, seed)
    return np.asarray(np.minimum(bright, 255.0 - ambient))


def limits(readings: FloatArray, limit: float = LIMIT) -> FloatArray:
    return np.full(readings.shape[:2], limit)


def surprise(pose: FloatArray, readings: FloatArray) -> float:
    """Minus the logarithm of the readings' likelihood, tails of the normal distribution integrated."""
    total = 0.0
    for one, bright in zip(
        readings.ravel(), expected_brightness(NEVER_BLOCKED, pose[None]).ravel(), strict=True
    ):
        if one < LIMIT:
            total += 0.5 * (one - bright) ** 2
        else:
            begin = max(LIMIT, bright - 12.0)
            tail, _ = quad(lambda x, b=bright: np.exp(-0.5 * (x - b) ** 2), begin, max(LIMIT, bright) + 12.0)
            total -= np.log(tail / np.sqrt(2.0 * np.pi))
    return float(total)


@pytest.mark.parametrize("seed", range(3))
def test_the_cost_is_that_of_the_likelihood_with_tails_integrated(seed: int) -> None:
    """Also where saturated readings are expected below the limit."""
    pose = random_poses(1, seed, low=0.1, high=0.13)
    readings = cut_readings(pose, seed)[0]
    pair, work = pair_of(NEVER_BLOCKED.model, readings, LIMIT), new_cost_workspace(2, 6, False)
    assert (pair.kinds == SATURATED).any()
    rng = np.random.default_rng(seed)
    for scale in (0.0, 0.003, 0.01, 0.03):
        at = pose[0] + scale * np.array([0.1, 1.0, 1.0]) * rng.standard_normal(3)
        cost = cost_of(NEVER_BLOCKED.model, pair, at, work, work.gradients[0], work.hessians[0])
        assert cost == pytest.approx(surprise(at, readings), rel=1e-6, abs=1e-4)


@pytest.mark.parametrize("centimetres", [7, 10, 13, 16])
def test_errors_are_those_of_the_bound_and_honest(centimetres: int) -> None:
    poses = random_poses(1500, centimetres, low=0.01 * centimetres, high=0.01 * centimetres)
    readings = cut_readings(poses, centimetres)
    solutions = ALIKE.solve(readings, None, limits(readings))
    errors = errors_at_the_bound(solutions, poses, replace(droplet(), saturation=LIMIT))
    normed = errors / np.sqrt(np.diagonal(solutions.covariances, axis1=1, axis2=2))
    assert np.all(np.abs(np.mean(normed, axis=0)) < 4.5 / np.sqrt(len(poses)))


def test_that_a_reading_is_saturated_tells_something() -> None:
    poses = random_poses(1500, 31, low=0.12, high=0.16)
    readings = cut_readings(poses, 31)
    censored = ALIKE.solve(readings, None, limits(readings))
    dropped = ALIKE.solve(np.where(readings >= LIMIT, np.nan, readings))
    assert np.all(censored.outcomes == IrOutcome.FOUND)
    found = dropped.outcomes == IrOutcome.FOUND
    for axis in range(3):
        variances = [solutions.covariances[found, axis, axis] for solutions in (censored, dropped)]
        assert np.mean(variances[0]) < 0.95 * np.mean(variances[1])
        errors = [pose_errors(solutions.poses, poses)[found, axis] for solutions in (censored, dropped)]
        assert np.mean(errors[0] ** 2) < np.mean(errors[1] ** 2)


def test_every_pair_and_power_has_its_own_saturation() -> None:
    poses = random_poses(20, 32, low=0.07, high=0.12)
    readings = readings_of(droplet(), poses, 32)
    saturation = np.random.default_rng(32).uniform([150.0, 50.0], [255.0, 100.0], (20, 2))
    together = ALIKE.solve(readings, None, saturation)
    for k in range(len(poses)):
        alone = ALIKE.solve(readings[k : k + 1], None, saturation[k : k + 1])
        for one, all_of_them in zip(alone, together, strict=True):
            np.testing.assert_array_equal(one[0], all_of_them[k])
    swapped = ALIKE.solve(readings, None, saturation[:, ::-1])
    assert np.mean(swapped.poses[:, 0] == together.poses[:, 0]) < 0.2


def test_gains_are_not_sought_from_saturated_readings() -> None:
    count, rng = 200, np.random.default_rng(34)
    factors = np.exp(0.1 * rng.standard_normal((2, 2, 6)))
    receiver, poses = rng.integers(0, 2, count), random_poses(count, 34, low=0.08, high=0.2)
    pairs = PairGains(factors[0, receiver], factors[1, 1 - receiver], np.zeros((count, 4)))
    readings = np.minimum(readings_of(droplet(), poses, 34, pairs), 150.0)
    errors = []
    for limit in (150.0, 255.0):
        fit = estimate_gains(
            droplet(0.1), 2, Exchanges(receiver, 1 - receiver, readings, limits(readings, limit), poses)
        )
        found = np.array([[gains.sensor for gains in fit.gains], [gains.emitter for gains in fit.gains]])
        logs = np.log(found / factors)
        errors.append(np.std(logs - logs.mean(axis=-1, keepdims=True)))
    assert errors[0] < 0.01
    assert errors[1] > 3.0 * errors[0]


def test_a_limit_far_below_the_platforms_is_as_good_as_a_platform_that_ends_there() -> None:
    """Although the table where searches start ends at the platform's."""
    poses = random_poses(1000, 35, low=0.08, high=0.2)
    readings = np.minimum(readings_of(droplet(), poses, 35), 120.0)
    told = ALIKE.solve(readings, None, limits(readings, 120.0))
    made_so = MaximumLikelihood(replace(droplet(), saturation=120.0)).solve(readings)
    assert np.mean(told.outcomes == IrOutcome.FOUND) > 0.99
    sigmas = np.sqrt(np.diagonal(made_so.covariances, axis1=1, axis2=2))
    apart = np.abs(pose_errors(told.poses, made_so.poses)) / sigmas
    assert np.mean(apart.max(axis=1) < 0.1) > 0.98


BOARD = load_ir_platform("droplet_2016")
ESTIMATOR = MaximumLikelihood(BOARD)
_CHI_SQUARE_99 = 11.345


def with_faults(poses: FloatArray, seed: int) -> FloatArray:
    """Readings (k, 1, 6, 6) of which now and then a whole emitter is dark, or one reading too bright."""
    rng = np.random.default_rng(seed)
    readings = readings_of(BOARD, poses, seed)
    readings *= np.exp(BOARD.relative * rng.standard_normal(readings.shape))
    for k in np.flatnonzero(rng.random(len(poses)) < 0.5).tolist():
        readings[k, 0, :, rng.integers(6)] = BOARD.noise * rng.standard_normal(6)
    bright = rng.random(readings.shape) < 0.01
    readings[bright] += rng.exponential(5.0 * BOARD.noise, readings.shape)[bright]
    return np.minimum(readings, BOARD.saturation)


@pytest.mark.parametrize(
    ("seed", "low", "high", "beyond"),
    [(1, 0.06, 0.18, 0.03), (2, 0.06, 0.18, 0.03), (3, 0.06, 0.18, 0.03), (5, 0.2, 0.3, 0.05)],
)
def test_dark_emitters_and_light_from_elsewhere_do_not_mislead(
    seed: int, low: float, high: float, beyond: float
) -> None:
    """Of faint robots bearing or heading is often another one, and covariances say so."""
    poses = random_poses(600, seed, low=low, high=high)
    solutions = ESTIMATOR.solve(with_faults(poses, seed))
    found = solutions.outcomes == IrOutcome.FOUND
    errors = pose_errors(solutions.poses[found], poses[found])
    assert np.mean(nees(errors, solutions.covariances[found]) > _CHI_SQUARE_99) < beyond
    if high < 0.2:
        assert np.mean(found) > 0.85
        assert np.all(np.median(np.abs(errors), axis=0) < [0.01, np.radians(5.0), np.radians(10.0)])


def test_covariances_say_of_the_same_direction_at_another_range() -> None:
    table = ESTIMATOR._models.table
    work = new_start_workspace(table)
    work.costs[:] = 100.0
    work.costs[3 * table.angles.size + 5, [2, 10]] = 0.0
    pose, covariance = np.array([table.ranges[10], table.angles[3], table.angles[5]]), np.zeros((3, 3))
    add_spread(table, work, pose, covariance)
    near, far = table.ranges[2], table.ranges[10]
    weight = near**2 / (near**2 + far**2)
    assert covariance[0, 0] == pytest.approx(weight * (far - near) ** 2, rel=1e-5)
    np.testing.assert_allclose(covariance[1:, 1:], 0.0, atol=1e-12)


def test_noise_alone_is_no_robot() -> None:
    noise = BOARD.noise * np.random.default_rng(4).standard_normal((500, 1, 6, 6))
    outcomes = ESTIMATOR.solve(noise).outcomes
    assert np.mean(outcomes == IrOutcome.FOUND) < 0.01


@pytest.mark.parametrize("seed", range(4))
def test_the_costs_gradient_is_its_slope_also_of_outliers(seed: int) -> None:
    pose = random_poses(1, seed, low=0.08, high=0.16)
    readings = np.roll(with_faults(pose, seed)[0], 1, axis=1)  # most are outliers now
    pair, work = pair_of(BOARD.model, readings, 1e9), new_cost_workspace(1, 6, False)

    def cost_at(at: FloatArray) -> float:
        return cost_of(BOARD.model, pair, at, work, work.gradients[0], work.hessians[0])

    slopes = slopes_of(lambda change: cost_at(pose[0] + change), 3, 1e-7)
    cost_at(pose[0])
    assert work.gradients[0] == pytest.approx(slopes, rel=1e-3, abs=0.05)
