"""Initialization: constraints against transform chains, alignments against the truth behind them."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from core_geometry import nees, planar, pose_of
from core_messages import SECOND, T0
from hypothesis import given, settings
from hypothesis import strategies as st

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements
from swarm_loc_estimator.filter.models import CARTESIAN, POLAR
from swarm_loc_estimator.filter.state import BeliefArrays, InitialPose, SwarmState
from swarm_loc_estimator.initialization import alignment, initializer
from swarm_loc_estimator.initialization.alignment import CONSTRAINT_DTYPE, ConstraintArray, constraints_of
from swarm_loc_estimator.initialization.window import NO_WINDOW, Window, with_row
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.calibration_states import CAMERA_YAW, ParameterTable
from swarm_loc_estimator.swarm.swarm import Landmark, Robot

SEEDS = st.integers(0, 10**6)
SIGMA, TURN_SIGMA = 0.01, 0.05
NO_NOISE = np.zeros((3, 3))
EXACT = np.zeros(2)


def any_pose(rng: np.random.Generator) -> FloatArray:
    return np.array([*rng.uniform(-2, 2, 2), rng.uniform(-3, 3)])


def sighting(
    rng: np.random.Generator, sees: bool, model: int, camera: FloatArray
) -> tuple[Measurements, FloatArray]:
    """What robot 0, at a random place, sees of a robot 1 at the origin, or is seen as; and where it is.

    The camera (2,) is turned and stretches distances.
    """
    robot, sensor, marker = any_pose(rng), any_pose(rng), any_pose(rng)
    turned = np.add(sensor, [0.0, 0.0, camera[0]])
    observer, target = (planar(robot), np.eye(3)) if sees else (np.eye(3), planar(robot))
    seen = pose_of(np.linalg.inv(observer @ planar(turned)) @ target @ planar(marker))
    seen[:2] *= 1.0 + camera[1]
    one = Measurements.empty(1)
    one.observer[:], one.target[:] = (0, 1) if sees else (1, 0)
    one.model[:], one.stamp_ns[:], one.has_heading[:] = model, T0, True
    one.sensor[:], one.marker[:] = sensor, marker
    one.value[:] = (
        seen if model == CARTESIAN else [math.hypot(*seen[:2]), math.atan2(seen[1], seen[0]), seen[2]]
    )
    one.covariance[:] = np.diag([4e-4, 1e-4, 1e-2])
    return one, robot


@settings(max_examples=40)
@given(
    seed=SEEDS,
    sees=st.booleans(),
    model=st.sampled_from([CARTESIAN, POLAR]),
    yaw=st.floats(-0.2, 0.2),
    stretch=st.floats(-0.2, 0.2),
)
def test_a_constraint_lies_on_the_map_where_the_true_transform_puts_it(
    seed: int, sees: bool, model: int, yaw: float, stretch: float
) -> None:
    rng, camera = np.random.default_rng(seed), np.array([yaw, stretch])
    one, robot = sighting(rng, sees, model, camera)
    transform = any_pose(rng)
    track = pose_of(np.linalg.inv(planar(transform)) @ planar(robot))
    one.has_second[:], one.second[:] = True, one.value + np.array([0.0, 0.0, 0.7])
    (constraint,) = constraints_of(window_of(one, track), 0, belief_of(np.zeros(3), NO_NOISE, camera))
    place = planar(transform) @ [constraint["local_x"], constraint["local_y"], 1.0]
    np.testing.assert_allclose(place[:2], [constraint["map_x"], constraint["map_y"]], atol=1e-9)
    off = np.array([constraint["turn"], constraint["other_turn"]]) - transform[2]
    np.testing.assert_allclose(np.cos(off), [1.0, math.cos(0.7)], atol=1e-9)
    assert constraint["column"] == 3


@pytest.mark.parametrize("sees", [True, False])
@pytest.mark.parametrize("model", [CARTESIAN, POLAR])
def test_a_constraint_is_as_unsure_as_sampled_sightings_and_located_robots(model: int, sees: bool) -> None:
    rng = np.random.default_rng(model + 2 * sees)
    camera = np.array([0.1, 0.3])
    one, robot = sighting(rng, sees, model, camera)
    spread = np.diag([1e-4, 2e-4, 3e-4])
    samples, value = [], one.value.copy()
    for _ in range(1500):
        one.value[:] = value + rng.multivariate_normal(np.zeros(3), one.covariance[0])
        base = rng.multivariate_normal(np.zeros(3), spread)
        (constraint,) = constraints_of(window_of(one, robot), 0, belief_of(base, spread, camera))
        samples.append([constraint[name] for name in ("local_x", "local_y", "map_x", "map_y")])
    sampled = np.cov(np.array(samples).T)
    local, there = (
        np.array(
            [
                [constraint[f"{side}_xx"], constraint[f"{side}_xy"]],
                [constraint[f"{side}_xy"], constraint[f"{side}_yy"]],
            ]
        )
        for side in ("local", "map")
    )
    tolerance = 0.12 * np.abs(sampled).max()
    np.testing.assert_allclose(local, sampled[:2, :2], atol=tolerance)
    np.testing.assert_allclose(there, sampled[2:, 2:], atol=tolerance)


def window_of(
    one: Measurements, track: FloatArray, other_track: FloatArray | None = None, other_noise: float = 0.0
) -> Window:
    """A single sighting from a pose on the track of robot 0, while robot 1 is at one on its own."""
    there = np.zeros(3) if other_track is None else other_track
    return Window(one, track[None], NO_NOISE[None], there[None], other_noise * np.eye(3)[None])


def belief_of(transform: FloatArray, spread: FloatArray, camera: FloatArray = EXACT) -> BeliefArrays:
    """Of robots 0, which waits, and 1, which is believed to be at `transform` with an error like `spread`.

    Both believe that their cameras are turned and stretch distances.
    """
    state = SwarmState(ParameterTable.of([Robot("a"), Robot("b")]))
    state.parameter[:, CAMERA_YAW : CAMERA_YAW + 2] = camera
    state.initialize(1, InitialPose(transform, spread), Preintegrated.begin(T0))
    return state.arrays()


def test_a_constraint_is_less_sure_the_further_the_other_robot_has_driven_since() -> None:
    """It is where the other robot is believed to be now."""
    rng = np.random.default_rng(3)
    now, spread, track = any_pose(rng), np.diag([1e-4, 2e-4, 3e-4]), any_pose(rng)
    one, robot = sighting(rng, True, CARTESIAN, EXACT)
    (still,), (driven,) = (
        constraints_of(window_of(one, robot, track, drift), 0, belief_of(now, spread))
        for drift in (0.0, 1e-4)
    )
    for name in ("local_x", "map_x", "map_y", "turn"):
        assert still[name] == driven[name]
    place = planar(now) @ planar(track) @ [*one.marker[0, :2], 1.0]
    np.testing.assert_allclose(place[:2], [still["map_x"], still["map_y"]], atol=1e-12)
    assert driven["turn_variance"] == pytest.approx(still["turn_variance"] + 1e-4)
    assert driven["map_xx"] > still["map_xx"] + 0.9e-4
    np.testing.assert_array_equal(driven["shared"], spread)


def test_constraints_of_a_robot_that_was_lost_do_not_count() -> None:
    one, robot = sighting(np.random.default_rng(0), True, CARTESIAN, EXACT)
    state = SwarmState(ParameterTable.of([Robot("a"), Robot("b")]))
    assert constraints_of(window_of(one, robot), 0, state.arrays()).size == 0


@pytest.mark.parametrize("seed", range(3))
def test_what_enters_errs_as_those_do_that_it_was_located_by(seed: int) -> None:
    """The joint covariance against sampling: two robots that err alike in part, a third that both see."""
    rng = np.random.default_rng(seed)
    robots = [Robot(name, stands=True) for name in "abc"]
    true = np.array([[0.3, 0.1, 0.4], [-0.2, 0.4, -1.0], [0.1, -0.3, 2.0]])
    half = 0.02 * rng.standard_normal((6, 6))
    prior, noise = half @ half.T, np.diag([0.01, 0.01, 0.02]) ** 2
    errors, believed, count = [], [], 300
    for _ in range(count):
        state, waiting = (
            SwarmState(ParameterTable.of(robots)),
            initializer.Initializer(OdometryTracks(robots), 20.0),
        )
        drawn = rng.multivariate_normal(np.zeros(6), prior).reshape(2, 3)
        for robot in range(2):
            estimate = se2.compose(se2.exp(-drawn[robot]), true[robot])
            state.initialize(robot, InitialPose(estimate, np.eye(3)), Preintegrated.begin(T0))
        state.filter.covariance[:6, :6] = prior
        for k in range(6):
            waiting.note(state, sight_of(rng, true, k % 2, noise, T0 + k * SECOND))
        assert state.tracked[2]
        errors.append(se2.log(se2.compose(true, se2.inverse(state.transform))).ravel())
        believed.append(state.filter.covariance.copy())
    claimed, sampled = np.mean(believed, axis=0), np.array(errors).T @ np.array(errors) / count
    normal = [e @ np.linalg.solve(covariance, e) for e, covariance in zip(errors, believed, strict=True)]
    assert 0.75 < np.mean(normal) / 9.0 < 1.15  # sampled to 0.03; what scatters by chance counts as unsure
    scale = np.sqrt(np.diag(claimed))
    np.testing.assert_allclose(sampled / np.outer(scale, scale), claimed / np.outer(scale, scale), atol=0.3)


def sight_of(
    rng: np.random.Generator, true: FloatArray, observer: int, noise: FloatArray, stamp_ns: int
) -> Measurements:
    """What a robot at true[observer] measures of the third, by range, bearing and heading."""
    x, y, heading = se2.between(true[observer], true[2]) + rng.multivariate_normal(np.zeros(3), noise)
    one = Measurements.empty(1)
    one.stamp_ns[:], one.observer[:], one.target[:] = stamp_ns, observer, 2
    one.model[:], one.has_heading[:] = POLAR, True
    distance, bearing = math.hypot(x, y), math.atan2(y, x)
    one.value[:] = [distance, bearing, heading]
    cos, sin = math.cos(bearing), math.sin(bearing)
    to_polar = np.array([[cos, sin, 0.0], [-sin / distance, cos / distance, 0.0], [0.0, 0.0, 1.0]])
    one.covariance[:] = to_polar @ noise @ to_polar.T
    return one.row(0)


def made_up(
    rng: np.random.Generator, transform: FloatArray, marks: FloatArray, headings: Sequence[float] = ()
) -> ConstraintArray:
    """Noisy constraints (k,) of marks (k, 2) in map; headings off by so much where given."""
    constraints = np.zeros(len(marks), dtype=CONSTRAINT_DTYPE)
    local = (np.linalg.inv(planar(transform)) @ np.column_stack([marks, np.ones(len(marks))]).T)[:2]
    local += SIGMA * rng.standard_normal(local.shape)
    constraints["local_x"], constraints["local_y"] = local
    constraints["map_x"], constraints["map_y"] = marks.T
    constraints["local_xx"] = constraints["local_yy"] = SIGMA**2
    constraints["turn"] = constraints["other_turn"] = math.nan
    constraints["turn_variance"] = TURN_SIGMA**2
    if headings:
        constraints["turn"] = transform[2] + headings + TURN_SIGMA * rng.standard_normal(len(marks))
    return constraints


@settings(max_examples=60)
@given(seed=SEEDS, count=st.integers(5, 20), wrong=st.floats(0.0, 0.35))
def test_the_fix_is_the_truth_also_among_wrong_constraints(seed: int, count: int, wrong: float) -> None:
    rng = np.random.default_rng(seed)
    transform = any_pose(rng)
    angles = 2.0 * np.pi * (np.arange(count) * 0.381966) + rng.uniform(0, 6)
    constraints = made_up(rng, transform, np.column_stack([np.cos(angles), np.sin(angles)]))
    bad = rng.permutation(count)[: int(wrong * count)]
    constraints["map_x"][bad] += rng.choice([-1.0, 1.0], bad.size) * rng.uniform(0.5, 2.0, bad.size)
    found = alignment.align(constraints, NO_NOISE)
    assert found is not None
    assert np.abs(found.transform[:2] - transform[:2]).max() < 0.2
    assert nees(error_of(found.transform, transform), found.covariance) < 45.0


@pytest.mark.parametrize("seed", range(5))
def test_odometry_that_comes_late_after_a_dropout_was_assumed_leaves_a_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    transform, swerve = any_pose(rng), rng.uniform(0.2, 0.8, 3)
    constraints = made_up(rng, transform, rng.uniform(-1.0, 1.0, (12, 2)))
    constraints["track_noise"][6:] = np.outer(swerve, swerve) + 1e-3 * np.eye(3)
    found = alignment.align(constraints, 1e-3 * np.eye(3))
    assert found is not None
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0
    assert nees(error_of(found.transform, transform), found.covariance) < 45.0


def error_of(transform: FloatArray, truth: FloatArray) -> FloatArray:
    """The right-invariant error (3,), to first order."""
    error: FloatArray = pose_of(planar(truth) @ np.linalg.inv(planar(transform)))
    return error


@settings(max_examples=30)
@given(seed=SEEDS)
def test_the_fix_moves_with_the_map(seed: int) -> None:
    rng = np.random.default_rng(seed)
    transform, moved = any_pose(rng), any_pose(rng)
    marks = rng.uniform(-1, 1, (8, 2))
    constraints = made_up(rng, transform, marks, headings=[0.0] * 8)
    elsewhere = constraints.copy()
    elsewhere["map_x"], elsewhere["map_y"] = (planar(moved) @ np.column_stack([marks, np.ones(8)]).T)[:2]
    elsewhere["turn"] += moved[2]
    a, b = (alignment.align(some, NO_NOISE) for some in (constraints, elsewhere))
    assert a is not None
    assert b is not None
    np.testing.assert_allclose(planar(b.transform), planar(moved) @ planar(a.transform), atol=1e-6)


@pytest.mark.parametrize("seed", range(40))
def test_one_heading_against_two_of_one_marker_leaves_the_robot_waiting(seed: int) -> None:
    """Two mirrored headings without their second solutions; the points say nothing, as they are all one."""
    rng = np.random.default_rng(seed)
    constraints = made_up(rng, any_pose(rng), np.tile([0.5, 0.3], (3, 1)), headings=[0.9, 0.0, 0.9])
    assert alignment.align(constraints, NO_NOISE) is None


def kept_of(stamps_s: FloatArray, markers: Sequence[int], window_s: float) -> Measurements:
    """What is kept of sightings of all markers at each stamp."""
    window = NO_WINDOW
    for seconds in stamps_s:
        for marker in markers:
            one = Measurements.empty(1)
            one.observer[:], one.stamp_ns[:], one.reading[:] = 0, T0 + round(seconds * 1e9), marker
            window = with_row(window, window_of(one, np.zeros(3)), round(window_s * 1e9), 20)
    return window.measured


@settings(max_examples=30)
@given(seed=SEEDS, markers=st.integers(1, 6))
def test_sightings_kept_are_few_and_spread_over_time_and_markers(seed: int, markers: int) -> None:
    steps = np.random.default_rng(seed).uniform(0.05, 0.2, 200)
    stamps_s = np.cumsum(steps)
    kept = kept_of(stamps_s, range(markers), 15.0)
    age_s = (kept.stamp_ns[-1] - kept.stamp_ns) * 1e-9
    last_20_s = stamps_s[-1] - stamps_s[-math.ceil(20 / markers)]
    assert kept.size == 20
    assert (np.diff(kept.stamp_ns) >= 0).all()
    assert age_s.max() <= 15.0
    for marker in range(markers):
        of_marker = age_s[kept.reading == marker]
        assert of_marker.min() < 0.25
        assert of_marker.max() > 2.0 * last_20_s
    assert np.mean(age_s < 5.0) > 0.4  # a robot moved by hand meanwhile is soon outvoted


def test_attempts_become_rarer_but_never_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    tracks, robots = OdometryTracks([Robot("a")]), [Robot("a")]
    tracks.extend(np.zeros(2, dtype=np.int64), np.array([T0, T0 + 20 * SECOND]), np.zeros((2, 3)))
    attempts: list[int] = []
    monkeypatch.setattr(
        initializer, "constraints_of", lambda window, *_: attempts.append(int(window.measured.stamp_ns[-1]))
    )
    monkeypatch.setattr(initializer, "align", lambda *_: None)
    state, waiting = SwarmState(ParameterTable.of(robots)), initializer.Initializer(tracks, 20.0)
    one = Measurements.empty(1)
    one.observer[:], one.target[:], one.covariance[:] = 0, NOBODY, np.eye(3)
    stamps = T0 + np.arange(0, 10 * SECOND, SECOND // 30)  # every fourth one is a constraint
    for one.stamp_ns[0] in stamps:
        assert waiting.note(state, one.row(0))
    assert attempts[0] == stamps[8]
    gaps_s = np.diff(attempts) * 1e-9
    assert gaps_s[:3].max() < 0.15
    assert gaps_s.max() <= 0.3 + 4 / 30
    assert len(attempts) < 10 / 0.3 + 25
    assert stamps[-1] - attempts[-1] < 4 * SECOND // 10


def test_a_landmark_that_is_estimated_is_where_the_belief_has_it() -> None:
    """It is as unsure as that, and a robot located by it is no surer."""
    mark = Landmark(1, 3.0, -2.0, 0.0, 0.4, position_sigma=0.05, yaw_sigma=0.1)
    tracks, state = OdometryTracks([Robot("a")]), SwarmState(ParameterTable.of([Robot("a")], [mark]))
    tracks.extend(np.zeros(2, dtype=np.int64), np.array([T0, T0 + SECOND]), np.zeros((2, 3)))
    state.landmark[0] = moved = np.array([0.3, 0.1, 0.2])
    one = Measurements.empty(1)
    one.observer[:], one.target[:], one.landmark[:] = 0, NOBODY, 0
    one.marker[:], one.has_heading[:] = [3.0, -2.0, 0.4], True
    one.covariance[:] = np.diag([1e-6, 1e-6, 1e-4])
    one.value[:] = [1.0, 0.0, 0.0]
    waiting = initializer.Initializer(tracks, 20.0)
    for one.stamp_ns[0] in T0 + np.arange(20) * (SECOND // 20):
        waiting.note(state, one.row(0))
    assert state.tracked[0]
    place = pose_of(planar(moved) @ planar(np.array([3.0, -2.0, 0.4])) @ planar(np.array([-1.0, 0.0, 0.0])))
    np.testing.assert_allclose(state.transform[0], place, atol=1e-3)
    located, survey = (
        np.diag(se2.pose_covariance(place, error))
        for error in (state.filter.covariance[:3, :3], state.landmark_covariance(0))
    )
    assert (survey < located).all()
    assert (located < 3.0 * survey).all()
