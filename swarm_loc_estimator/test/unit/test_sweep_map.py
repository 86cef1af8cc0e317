"""Maps by lidars: correlative matches, loops, odometry that says nothing, and robots with unknown starts."""

import math

import numpy as np
import pytest

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import between, compose
from swarm_loc_estimator.mapping.correlation import PoseWindow, field_of, match, outline, score_at
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.scans import Scan, ScanStop
from swarm_loc_estimator.mapping.settings import MapperSettings
from swarm_loc_estimator.mapping.sweep_map import LoopTie, SweepMap

REACH, NOISE, STEP_NS = 8.0, 0.01, 1_000_000_000
SIGMA = NOISE / REACH**2
UNKNOWN = np.full(3, np.inf)
_OUTER, _INNER = (0.0, 0.0, 16.0, 11.0), (3.0, 3.0, 12.0, 8.6)


def _box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


RING = np.array(
    [
        *_box(*_OUTER),
        *_box(*_INNER),
        *_box(5.0, 0.0, 5.6, 0.7),
        *_box(15.2, 4.0, 16.0, 5.5),
        *_box(9.0, 10.2, 10.5, 11.0),
        *_box(0.0, 6.0, 0.5, 6.4),
        *_box(7.5, 2.4, 8.5, 3.0),
    ]
)
"""Walls (S, 4) of a corridor around a block, with pillars."""


def ranges(walls: FloatArray, pose: FloatArray, angle: FloatArray) -> FloatArray:
    """Distances (n,) of walls in directions (n,) from a pose (3,); infinite beyond the range [m]."""
    heading = pose[2] + angle
    ray = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    begin, way = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    cross = ray[:, None, 0] * way[:, 1] - ray[:, None, 1] * way[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (begin[:, 0] * way[:, 1] - begin[:, 1] * way[:, 0]) / cross
        along = (begin[:, 0] * ray[:, None, 1] - begin[:, 1] * ray[:, None, 0]) / cross
    found = np.where((far > 0.0) & (along >= 0.0) & (along <= 1.0), far, np.inf).min(axis=1)
    return np.where(found < REACH, found, np.inf)


def sweep(
    rng: np.random.Generator, pose: FloatArray, odometry: FloatArray, stamp_ns: int, walls: FloatArray = RING
) -> ScanStop:
    """A sweep of 180 beams over 270 degrees."""
    angle = np.linspace(-0.75 * math.pi, 0.75 * math.pi, 180)
    far = ranges(walls, pose, angle) + NOISE * rng.standard_normal(len(angle))
    nothing = np.zeros(len(angle))
    return ScanStop.of_sweep(stamp_ns, odometry, Scan(nothing, 1.0 / far, angle), SIGMA, REACH)


def laps(count: float) -> FloatArray:
    """Poses (n, 3) every half metre of a drive around the ring."""
    corners = np.array([(1.5, 1.5), (14.0, 1.5), (14.0, 9.8), (1.5, 9.8)])
    poses = []
    for k in range(round(4 * count)):
        here, there = corners[k % 4], corners[(k + 1) % 4]
        heading = math.atan2(*(there - here)[::-1])
        shares = np.arange(0.0, 1.0, 0.5 / math.dist(here, there))
        poses += [[*(here + share * (there - here)), heading] for share in shares]
    return np.array(poses)


def drive(
    mapper: CooperativeMapper,
    robot: int,
    path: FloatArray,
    rng: np.random.Generator,
    jump: int = -1,
    stops: slice = slice(None),
) -> FloatArray:
    """Drive along poses (n, 3) by wheels that are 3 % off; returns these poses relative to the first."""
    pose, odometry = np.zeros(3), []
    for k, true in enumerate(path):
        if k:
            step = between(path[k - 1], true) * [1.03, 1.0, 0.97] + rng.normal(0.0, [0.01, 0.01, 0.015])
            step[2] += 1.3 * (k == jump)
            pose = compose(pose, step)
        odometry.append(pose)
    for k in range(len(path))[stops]:
        mapper.add_sweep(robot, sweep(np.random.default_rng(k), path[k], odometry[k], k * STEP_NS))
    return between(path[0], path)


def driven(
    path: FloatArray, seed: int, settings: MapperSettings | None = None, jump: int = -1
) -> tuple[CooperativeMapper, FloatArray]:
    """The mapper after the drive of a robot with a known start, and the true poses (n, 3) of its stops."""
    mapper = CooperativeMapper(settings) if settings else CooperativeMapper()
    robot = mapper.join(np.zeros(3), np.full(3, 1e-3))
    return mapper, drive(mapper, robot, path, np.random.default_rng(seed), jump)


def off(mapper: CooperativeMapper, robot: int, truth: FloatArray) -> FloatArray:
    """Distances (n,) of the stops of a robot from true poses (n, 3)."""
    mine = mapper.graph.robot[: mapper.graph.count] == robot
    away: FloatArray = mapper.graph.poses[mine, :2] - truth[:, :2]
    return np.asarray(np.hypot(*away.T))


@pytest.mark.parametrize("seed", range(5))
def test_the_search_finds_what_trying_all_poses_finds_unless_it_scores_less_than_is_of_use(seed: int) -> None:
    rng = np.random.default_rng(seed)
    field, window = field_of(rng.uniform(-3.0, 3.0, (60, 2))), PoseWindow(0.4, 0.2, math.inf, math.inf)
    points, pose = rng.uniform(-2.5, 2.5, (40, 2)), rng.uniform(-0.5, 0.5, 3)
    found = match(field, points, pose, window)
    offsets = np.stack(np.meshgrid(*[np.arange(-0.4, 0.41, 0.05)] * 2, np.arange(-0.2, 0.21, 0.02)), -1)
    best = max(score_at(field, points, pose + one) for one in offsets.reshape(-1, 3))
    assert found.score > 0.9 * best  # turns are tried in other steps
    again = match(field, points, pose, window, least=0.99 * found.score)
    assert again.score == found.score
    assert again.pose.tolist() == found.pose.tolist()
    assert match(field, points, pose, window, least=1.5 * found.score).score == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_a_match_is_right_within_its_covariance_and_knows_nothing_along_a_corridor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    room, corridor = (
        np.array(_box(-2.0, -1.5, 3.0, 2.0)),
        np.array([(-9.0, -1.0, 9.0, -1.0), (9.0, 1.0, -9.0, 1.0)]),
    )
    angle = np.linspace(-math.pi, math.pi, 240)
    for walls, is_open in ((room, False), (corridor, True)):
        true = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(-0.1, 0.1)])
        parts = []
        for pose in (np.zeros(3), true):
            far = ranges(walls, pose, angle) + NOISE * rng.standard_normal(len(angle))
            parts.append((np.stack([np.cos(angle), np.sin(angle)], -1) * far[:, None])[np.isfinite(far)])
        found = match(field_of(parts[0]), parts[1], np.zeros(3), PoseWindow(0.6, 0.3, math.inf, math.inf))
        error = found.pose - true
        assert error @ np.linalg.solve(found.covariance, error) < 16.0
        assert abs(error[1]) < 0.03
        assert (math.sqrt(found.covariance[0, 0]) > 1.0) == is_open


@pytest.mark.parametrize("seed", range(3))
def test_loops_are_closed(seed: int) -> None:
    mapper, truth = driven(laps(1.5), seed)
    mapper.finish()
    assert mapper.counters["loops_closed"] >= 10
    assert off(mapper, 0, truth).max() < 0.25  # nothing tells how long a plain wall is but the wheels
    for tie in mapper.sweeps.loops:
        assert np.abs(between(truth[tie.begin], truth[tie.end]) - tie.pose)[:2].max() < 0.2
    assert not len(mapper.sweeps.doubts())


@pytest.mark.parametrize("seed", range(3))
def test_loops_that_contradict_the_others_are_taken_back(seed: int) -> None:
    """Three ties in a row say that the robot is a metre beside the way on which all others lead."""
    mapper, truth = driven(laps(1.5), seed)
    mapper.finish()
    before, loops = mapper.graph.poses.copy(), list(mapper.sweeps.loops)
    root, first = 50.0 * np.eye(3), mapper.graph.count - 3
    right = [LoopTie(k, first + k, between(truth[k], truth[first + k]), root, 40.0) for k in range(3)]
    mapper.sweeps.believe([tie._replace(pose=tie.pose + np.array([0.0, 1.0, 0.0])) for tie in right])
    assert mapper.sweeps.taken_back == 3
    assert mapper.sweeps.loops == loops
    assert mapper.graph.poses == pytest.approx(before)
    mapper.finish()
    assert mapper.graph.poses == pytest.approx(before, abs=2e-3)
    mapper.sweeps.believe(right)
    assert mapper.sweeps.loops == [*loops, *right]


@pytest.mark.parametrize("seed", range(3))
def test_the_last_solution_ties_what_was_seen_at_other_times(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even where no loop was closed; another one changes nothing."""
    monkeypatch.setattr(SweepMap, "_close_loops", lambda *_: None)
    mapper, truth = driven(laps(2.0), seed)
    half = mapper.graph.count // 2

    def apart() -> float:
        """How far the laps are off each other, which both are off the truth [m]."""
        error = mapper.graph.poses[:, :2] - truth[:, :2]
        return float(np.hypot(*(error[half : 2 * half] - error[:half]).T).mean())

    before = apart()
    mapper.finish()
    after, poses = apart(), mapper.graph.poses.copy()
    assert after < 0.2 * before
    mapper.finish()
    assert mapper.graph.poses == pytest.approx(poses, abs=2e-3)


@pytest.mark.parametrize(
    ("tear", "at_least"), [((0.6, 0.6, 0.0), 3), ((0.35, 0.0, 0.0), 2), ((0.0, 0.0, 0.15), 2)]
)
def test_a_map_that_is_torn_is_in_doubt_there(tear: tuple[float, float, float], at_least: int) -> None:
    mapper, _ = driven(laps(2.0), 1)
    mapper.finish()
    half, count = mapper.graph.count // 2, mapper.graph.count
    mapper.graph.states[half:count, :3] = compose(tear, mapper.graph.states[half:count, :3])
    assert len(mapper.sweeps.doubts()) >= at_least


@pytest.mark.parametrize("seed", range(3))
def test_a_sweep_that_fitted_nothing_is_in_doubt_until_others_say_the_same(seed: int) -> None:
    """The first sweep of the second lap is taken from where nothing is known, and moved into the ring."""
    mapper, _ = driven(laps(2.0), seed)
    mapper.finish()
    node = mapper.graph.count // 2
    mapper.sweeps.refused.append(node)
    assert not len(mapper.sweeps.doubts())
    mapper.graph.states[node, :2] += 0.5
    assert np.abs(mapper.sweeps.doubts() - mapper.graph.states[node, :2]).max() < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_odometry_that_jumps_is_contradicted(seed: int) -> None:
    mapper, truth = driven(laps(0.5), seed, jump=6)
    assert mapper.sweeps.contradicted
    assert off(mapper, 0, truth).max() < 0.3


@pytest.mark.parametrize("seed", range(3))
def test_walls_that_beams_graze_have_no_gaps_and_nothing_stands_in_a_doorway(seed: int) -> None:
    """A wall along the way, a post before a wall far behind it, and an open door."""
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 361)
    walls = np.array(
        [(-9.0, -1.0, 9.0, -1.0), (3.0, 0.1, 3.0, 0.4), (7.0, -1.0, 7.0, 2.0), (0.0, 2.0, 2.0, 2.0)]
    )
    walls = np.append(walls, [(2.9, 2.0, 9.0, 2.0)], axis=0)
    far = ranges(walls, np.zeros(3), angle)
    met = np.isfinite(far)
    far = np.where(met, far, REACH) + NOISE * np.random.default_rng(seed).standard_normal(len(angle))
    points = outline(far[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1), met, 0.08)
    lower = np.sort(points[(np.abs(points[:, 1] + 1.0) < 0.05) & (points[:, 0] < 6.8), 0])  # to the corner
    assert np.diff(lower).max() < 0.2
    assert lower.max() > 6.5
    in_door = (points[:, 0] > 2.2) & (points[:, 0] < 2.7) & (np.abs(points[:, 1] - 2.0) < 0.1)
    behind_post = (points[:, 0] > 3.2) & (points[:, 0] < 6.7) & (np.abs(points[:, 1] - 0.25) < 0.5)
    assert not (in_door | behind_post).any()


@pytest.mark.parametrize("turn", [-0.16, 0.08, 0.16])
def test_along_a_corridor_odometry_counts_also_where_a_slip_has_turned_it(turn: float) -> None:
    corridor = np.array([(0.0, 0.0, 40.0, 0.0), (0.0, 2.0, 40.0, 2.0)])
    mapper, rng, odometry = CooperativeMapper(), np.random.default_rng(3), np.zeros(3)
    robot = mapper.join(np.zeros(3), np.full(3, 1e-3))
    for k in range(12):
        if k:
            odometry = compose(
                odometry, [math.cos(turn), math.sin(turn), turn] if k == 6 else [1.0, 0.0, 0.0]
            )
        pose = np.array([10.0 + k, 1.0, 0.0])
        mapper.add_sweep(robot, sweep(rng, pose, odometry, k * STEP_NS, corridor))
    assert mapper.graph.poses[:12, 0] == pytest.approx(np.arange(12.0), abs=0.1)
    assert mapper.graph.poses[:12, 1] == pytest.approx(np.zeros(12), abs=0.05)


def test_a_robot_with_an_unknown_start_is_located_in_the_map_of_another_one() -> None:
    mapper, truth = driven(laps(1.25), 2)
    second = mapper.join(np.zeros(3), UNKNOWN)
    path = laps(2.0)[40:90]
    drive(mapper, second, path, np.random.default_rng(5), stops=slice(3))
    assert mapper.tracks[second].located is None
    assert mapper.pose(second) is None
    cells = int(mapper.occupancy().occupied.sum())
    drive(mapper, second, path, np.random.default_rng(5), stops=slice(3, None))
    located = mapper.tracks[second].located
    assert located is not None
    assert located.pose[:2] == pytest.approx(between(laps(1.0)[0], path[-1])[:2], abs=0.25)
    assert off(mapper, 0, truth).max() < 0.25
    assert cells > 500


def test_stops_without_a_sweep_are_taken_back_wherever_they_are_in_the_graph() -> None:
    mapper = CooperativeMapper()
    for node in (0, 1000):
        mapper.sweeps.drop(node)
    assert not mapper.sweeps.drawn


def test_a_full_graph_locates_robots_without_growing() -> None:
    mapper, truth = driven(laps(2.0), 3, MapperSettings(max_stops=90))
    assert mapper.graph.count == 91
    located = mapper.tracks[0].located
    assert located is not None
    assert located.pose[:2] == pytest.approx(truth[-1, :2], abs=0.15)


def test_a_large_map_has_larger_cells() -> None:
    mapper, _ = driven(laps(1.0), 4, MapperSettings(max_cells=60_000))
    occupancy = mapper.occupancy()
    assert occupancy.log_odds.size <= 60_000
    assert occupancy.cell == pytest.approx(0.08)
    x, y = occupancy.centres(occupancy.occupied).T
    assert np.ptp(x) > 15.5
    assert np.ptp(y) > 10.5
