"""Locating a robot from clues alone: clues against transform chains, fixes against the truth behind them."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from core_geometry import nees, planar, pose_of
from core_messages import SECOND, T0
from hypothesis import given, settings
from hypothesis import strategies as st

from swarm_loc_estimator.core import fix, locate, se2
from swarm_loc_estimator.core.clues import (
    CLUE_DTYPE,
    NO_CLUES,
    THE_MAP,
    ClueArray,
    OtherSide,
    refreshed,
    with_clue,
)
from swarm_loc_estimator.core.measurements import MEASUREMENT_DTYPE, NOBODY, Kind, MeasurementArray
from swarm_loc_estimator.core.odometry import OdometryTracks
from swarm_loc_estimator.core.parameters import ParameterTable
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.state import BeliefArrays, SwarmState
from swarm_loc_estimator.core.swarm import Landmark, Robot

SEEDS = st.integers(0, 10**6)
SIGMA, TURN_SIGMA = 0.01, 0.05
NO_NOISE = np.zeros((3, 3))
EXACT = np.zeros(2)
LONG_NS = 3600 * SECOND
ORIGIN = OtherSide(1, 3, np.zeros(3), np.zeros(3), NO_NOISE)
"""Robot 1 at the origin."""


def any_pose(rng: np.random.Generator) -> FloatArray:
    return np.array([*rng.uniform(-2, 2, 2), rng.uniform(-3, 3)])


def sighting(
    rng: np.random.Generator, sees: bool, kind: Kind, camera: FloatArray
) -> tuple[MeasurementArray, FloatArray]:
    """What robot 0, at a random place, sees of a robot 1 at the origin, or is seen as; and where it is.

    The camera (2,) is turned and stretches distances.
    """
    robot, sensor, marker = any_pose(rng), any_pose(rng), any_pose(rng)
    turned = np.add(sensor, [0.0, 0.0, camera[0]])
    observer, target = (planar(robot), np.eye(3)) if sees else (np.eye(3), planar(robot))
    seen = pose_of(np.linalg.inv(observer @ planar(turned)) @ target @ planar(marker))
    seen[:2] *= 1.0 + camera[1]
    one = np.zeros(1, dtype=MEASUREMENT_DTYPE)
    one["observer"], one["target"] = (0, 1) if sees else (1, 0)
    one["kind"], one["sensor"], one["marker"], one["stamp_ns"], one["has_heading"] = (
        kind,
        sensor,
        marker,
        T0,
        1,
    )
    one["value"] = (
        seen if kind == Kind.CARTESIAN else [math.hypot(*seen[:2]), math.atan2(seen[1], seen[0]), seen[2]]
    )
    one["covariance"] = np.diag([4e-4, 1e-4, 1e-2])
    return one, robot


@settings(max_examples=40)
@given(
    seed=SEEDS,
    sees=st.booleans(),
    kind=st.sampled_from([Kind.CARTESIAN, Kind.POLAR]),
    yaw=st.floats(-0.2, 0.2),
    stretch=st.floats(-0.2, 0.2),
)
def test_a_clue_lies_on_the_map_where_the_true_transform_puts_it(
    seed: int, sees: bool, kind: Kind, yaw: float, stretch: float
) -> None:
    rng, camera = np.random.default_rng(seed), np.array([yaw, stretch])
    one, robot = sighting(rng, sees, kind, camera)
    transform = any_pose(rng)
    track = pose_of(np.linalg.inv(planar(transform)) @ planar(robot))
    one["has_alternative"], one["alternative"] = 1, one["value"] + [0.0, 0.0, 0.7]
    (clue,) = with_clue(NO_CLUES, one, camera, 0, track, NO_NOISE, ORIGIN, LONG_NS)
    place = planar(transform) @ [clue["local_x"], clue["local_y"], 1.0]
    np.testing.assert_allclose(place[:2], [clue["map_x"], clue["map_y"]], atol=1e-9)
    off = np.array([clue["turn"], clue["other_turn"]]) - transform[2]
    np.testing.assert_allclose(np.cos(off), [1.0, math.cos(0.7)], atol=1e-9)
    assert (clue["marker_id"], clue["other"], clue["column"]) == (0, 1, 3)


@pytest.mark.parametrize("sees", [True, False])
@pytest.mark.parametrize("kind", [Kind.CARTESIAN, Kind.POLAR])
def test_a_clue_is_as_unsure_as_sampled_sightings_and_located_robots(kind: Kind, sees: bool) -> None:
    rng = np.random.default_rng(int(kind) + 2 * sees)
    camera = np.array([0.1, 0.3])
    one, robot = sighting(rng, sees, kind, camera)
    spread = np.diag([1e-4, 2e-4, 3e-4])
    samples, value = [], one["value"].copy()
    for _ in range(4000):
        one["value"] = value + rng.multivariate_normal(np.zeros(3), one["covariance"][0])
        base = rng.multivariate_normal(np.zeros(3), spread)
        other = OtherSide(1, 3, base, base, NO_NOISE)
        (clue,) = refreshed(
            with_clue(NO_CLUES, one, camera, 0, robot, NO_NOISE, other, LONG_NS), belief_of(base, spread)
        )
        samples.append([clue[name] for name in ("local_x", "local_y", "map_x", "map_y")])
    sampled = np.cov(np.array(samples).T)
    local, there = (
        np.array([[clue[f"{side}_xx"], clue[f"{side}_xy"]], [clue[f"{side}_xy"], clue[f"{side}_yy"]]])
        for side in ("local", "map")
    )
    tolerance = 0.12 * np.abs(sampled).max()
    np.testing.assert_allclose(local, sampled[:2, :2], atol=tolerance)
    np.testing.assert_allclose(there, sampled[2:, 2:], atol=tolerance)


def belief_of(transform: FloatArray, spread: FloatArray) -> BeliefArrays:
    """Of robots 0, which waits, and 1, which is believed to be at `transform` with an error like `spread`."""
    state = SwarmState(ParameterTable.of([Robot("a"), Robot("b")]))
    state.enter(1, transform, spread, np.zeros((2, 3, 3)), T0)
    return state.arrays()


def test_a_clue_moves_with_what_is_believed_of_the_robot_on_the_other_side() -> None:
    """As if that had been known when it was noted; what its track has gathered since makes it less sure."""
    rng = np.random.default_rng(3)
    then, now, spread, drift = any_pose(rng), any_pose(rng), np.diag([1e-4, 2e-4, 3e-4]), 1e-4 * np.eye(3)
    one, robot = sighting(rng, True, Kind.CARTESIAN, EXACT)
    track = any_pose(rng)
    clues = [
        refreshed(
            with_clue(
                NO_CLUES,
                one,
                EXACT,
                0,
                robot,
                NO_NOISE,
                OtherSide(1, 3, se2.compose(transform, track), transform, noise),
                LONG_NS,
            ),
            belief_of(now, spread),
        )[0]
        for transform, noise in ((then, NO_NOISE), (now, NO_NOISE), (then, drift))
    ]
    for name in ("local_x", "map_x", "map_y", "map_xx", "map_xy", "map_yy", "turn_variance"):
        np.testing.assert_allclose(clues[0][name], clues[1][name], atol=1e-12)
    assert math.cos(clues[0]["turn"] - clues[1]["turn"]) == pytest.approx(1.0)
    assert clues[2]["turn_variance"] == pytest.approx(clues[0]["turn_variance"] + 1e-4)
    assert clues[2]["map_xx"] > clues[0]["map_xx"] + 0.9e-4
    np.testing.assert_array_equal(clues[2]["shared"], spread)


def test_clues_of_a_robot_that_was_lost_do_not_count() -> None:
    one, robot = sighting(np.random.default_rng(0), True, Kind.CARTESIAN, EXACT)
    clues = with_clue(NO_CLUES, one, EXACT, 0, robot, NO_NOISE, ORIGIN, LONG_NS)
    assert refreshed(clues, SwarmState(ParameterTable.of([Robot("a"), Robot("b")])).arrays()).size == 0


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
        state, book = SwarmState(ParameterTable.of(robots)), fix.ClueBook(OdometryTracks(robots), 20.0)
        drawn = rng.multivariate_normal(np.zeros(6), prior).reshape(2, 3)
        for robot in range(2):
            estimate = se2.compose(se2.exp(-drawn[robot]), true[robot])
            state.enter(robot, estimate, np.eye(3), np.zeros((2, 3, 3)), T0)
        state.filter.covariance[:6, :6] = prior
        for k in range(6):
            book.note(state, sight_of(rng, true, k % 2, noise, T0 + k * SECOND))
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
) -> MeasurementArray:
    """What a robot at true[observer] measures of the third, by range, bearing and heading."""
    x, y, heading = se2.between(true[observer], true[2]) + rng.multivariate_normal(np.zeros(3), noise)
    one = np.zeros(1, dtype=MEASUREMENT_DTYPE)
    one["stamp_ns"], one["observer"], one["target"] = stamp_ns, observer, 2
    one["kind"], one["has_heading"] = Kind.POLAR, 1
    distance, bearing = math.hypot(x, y), math.atan2(y, x)
    one["value"] = [distance, bearing, heading]
    cos, sin = math.cos(bearing), math.sin(bearing)
    to_polar = np.array([[cos, sin, 0.0], [-sin / distance, cos / distance, 0.0], [0.0, 0.0, 1.0]])
    one["covariance"] = to_polar @ noise @ to_polar.T
    return one


def clues_of(
    rng: np.random.Generator, transform: FloatArray, marks: FloatArray, headings: Sequence[float] = ()
) -> ClueArray:
    """Noisy clues (k,), 0.1 s apart, of marks (k, 2) in map; with headings off by so much where given."""
    clues = np.zeros(len(marks), dtype=CLUE_DTYPE)
    local = (np.linalg.inv(planar(transform)) @ np.column_stack([marks, np.ones(len(marks))]).T)[:2]
    local += SIGMA * rng.standard_normal(local.shape)
    clues["stamp_ns"] = T0 + np.arange(len(marks)) * SECOND // 10
    clues["local_x"], clues["local_y"] = local
    clues["map_x"], clues["map_y"] = marks.T
    clues["local_xx"] = clues["local_yy"] = SIGMA**2
    clues["turn"] = clues["other_turn"] = math.nan
    clues["turn_variance"] = TURN_SIGMA**2
    if headings:
        clues["turn"] = transform[2] + headings + TURN_SIGMA * rng.standard_normal(len(marks))
    return clues


@settings(max_examples=60)
@given(seed=SEEDS, count=st.integers(5, 20), wrong=st.floats(0.0, 0.35))
def test_the_fix_is_the_truth_also_among_wrong_clues(seed: int, count: int, wrong: float) -> None:
    rng = np.random.default_rng(seed)
    transform = any_pose(rng)
    angles = 2.0 * np.pi * (np.arange(count) * 0.381966) + rng.uniform(0, 6)
    clues = clues_of(rng, transform, np.column_stack([np.cos(angles), np.sin(angles)]))
    bad = rng.permutation(count)[: int(wrong * count)]
    clues["map_x"][bad] += rng.choice([-1.0, 1.0], bad.size) * rng.uniform(0.5, 2.0, bad.size)
    found = locate.locate(clues, NO_NOISE)
    assert found is not None
    assert np.abs(found.transform[:2] - transform[:2]).max() < 0.2
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
    clues = clues_of(rng, transform, marks, headings=[0.0] * 8)
    elsewhere = clues.copy()
    elsewhere["map_x"], elsewhere["map_y"] = (planar(moved) @ np.column_stack([marks, np.ones(8)]).T)[:2]
    elsewhere["turn"] += moved[2]
    a, b = (locate.locate(some, NO_NOISE) for some in (clues, elsewhere))
    assert a is not None
    assert b is not None
    np.testing.assert_allclose(planar(b.transform), planar(moved) @ planar(a.transform), atol=1e-6)


@pytest.mark.parametrize("seed", range(40))
def test_one_heading_against_two_of_one_marker_leaves_the_robot_waiting(seed: int) -> None:
    """Two mirrored headings without their second solutions; the points say nothing, as they are all one."""
    rng = np.random.default_rng(seed)
    clues = clues_of(rng, any_pose(rng), np.tile([0.5, 0.3], (3, 1)), headings=[0.9, 0.0, 0.9])
    assert locate.locate(clues, NO_NOISE) is None


def many_clues(stamps_s: FloatArray, markers: Sequence[int], window_s: float) -> ClueArray:
    """What is kept of sightings of all markers at each stamp."""
    one, clues = np.zeros(1, dtype=MEASUREMENT_DTYPE), NO_CLUES
    one["target"], one["covariance"] = NOBODY, np.eye(3)
    for seconds in stamps_s:
        for marker in markers:
            one["stamp_ns"], one["marker_id"] = T0 + round(seconds * 1e9), marker
            clues = with_clue(clues, one, EXACT, 0, np.zeros(3), NO_NOISE, THE_MAP, round(window_s * 1e9))
    return clues


@settings(max_examples=30)
@given(seed=SEEDS, markers=st.integers(1, 6))
def test_clues_kept_are_few_and_spread_over_time_and_markers(seed: int, markers: int) -> None:
    steps = np.random.default_rng(seed).uniform(0.05, 0.2, 200)
    stamps_s = np.cumsum(steps)
    clues = many_clues(stamps_s, range(markers), 15.0)
    age_s = (clues["stamp_ns"][-1] - clues["stamp_ns"]) * 1e-9
    last_20_s = stamps_s[-1] - stamps_s[-math.ceil(20 / markers)]
    assert clues.size == 20
    assert (np.diff(clues["stamp_ns"]) >= 0).all()
    assert age_s.max() <= 15.0
    for marker in range(markers):
        of_marker = age_s[clues["marker_id"] == marker]
        assert of_marker.min() < 0.25
        assert of_marker.max() > 2.0 * last_20_s
    assert np.mean(age_s < 5.0) > 0.4  # a robot moved by hand meanwhile is soon outvoted


def test_attempts_become_rarer_but_never_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    tracks, robots = OdometryTracks([Robot("a")]), [Robot("a")]
    tracks.extend(np.zeros(2, dtype=np.int64), np.array([T0, T0 + 20 * SECOND]), np.zeros((2, 3)))
    attempts: list[int] = []
    monkeypatch.setattr(fix, "locate", lambda clues, _: attempts.append(int(clues["stamp_ns"][-1])))
    state, book = SwarmState(ParameterTable.of(robots)), fix.ClueBook(tracks, 20.0)
    one = np.zeros(1, dtype=MEASUREMENT_DTYPE)
    one["target"], one["covariance"] = NOBODY, np.eye(3)
    stamps = T0 + np.arange(0, 10 * SECOND, SECOND // 30)
    for one["stamp_ns"][0] in stamps:
        assert book.note(state, one)
    assert attempts[0] == stamps[2]
    gaps_s = np.diff(attempts) * 1e-9
    assert gaps_s[:3].max() < 0.05
    assert gaps_s.max() <= 0.3 + 1 / 30
    assert len(attempts) < 10 / 0.3 + 25
    assert stamps[-1] - attempts[-1] < SECOND // 3


def test_a_landmark_that_is_estimated_is_where_the_belief_has_it() -> None:
    """It is as unsure as that, and a robot located by it is no surer."""
    mark = Landmark(1, 3.0, -2.0, 0.0, 0.4, position_sigma=0.05, yaw_sigma=0.1)
    tracks, state = OdometryTracks([Robot("a")]), SwarmState(ParameterTable.of([Robot("a")], [mark]))
    tracks.extend(np.zeros(2, dtype=np.int64), np.array([T0, T0 + SECOND]), np.zeros((2, 3)))
    state.landmark[0] = moved = np.array([0.3, 0.1, 0.2])
    one = np.zeros(1, dtype=MEASUREMENT_DTYPE)
    one["target"], one["landmark"], one["marker"], one["has_heading"] = NOBODY, 1, [3.0, -2.0, 0.4], 1
    one["covariance"] = np.diag([1e-6, 1e-6, 1e-4])
    one["value"] = [1.0, 0.0, 0.0]
    book = fix.ClueBook(tracks, 20.0)
    for one["stamp_ns"][0] in T0 + np.arange(20) * (SECOND // 20):
        book.note(state, one)
    assert state.tracked[0]
    place = pose_of(planar(moved) @ planar(np.array([3.0, -2.0, 0.4])) @ planar(np.array([-1.0, 0.0, 0.0])))
    np.testing.assert_allclose(state.transform[0], place, atol=1e-3)
    located, survey = (
        np.diag(se2.pose_covariance(place, error))
        for error in (state.filter.covariance[:3, :3], state.landmark_covariance(0))
    )
    assert (survey < located).all()
    assert (located < 3.0 * survey).all()
