"""The sparse filter: agrees with the dense one, also in small swarms and with parameters; solves in parts."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from core_messages import SECOND, T0
from core_run import SPARSE, distances, on_time, play, settled, ticks
from core_world import Plan, World, simulate
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.joint_filter import Robots
from swarm_loc_estimator.filter.measurements import NOBODY, LossReason, Measurements
from swarm_loc_estimator.filter.prediction import new_scratch, predict
from swarm_loc_estimator.filter.sparse import ordering
from swarm_loc_estimator.filter.sparse.factor import Factor, new_factor, solve, write_fronts, write_rows
from swarm_loc_estimator.filter.sparse.ordering import (
    Order,
    Pattern,
    Situation,
    adjacency,
    dissect,
    ordered,
    pattern_of,
    wanted_rows,
)
from swarm_loc_estimator.filter.sparse.sparse_filter import SparseFilter
from swarm_loc_estimator.filter.state import InitialPose, SwarmState
from swarm_loc_estimator.filter.update import related_columns
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.swarm.calibration_states import (
    CAMERA_OFFSET,
    CAMERA_SCALE,
    CAMERA_YAW,
    DRIVES,
    ParameterTable,
)
from swarm_loc_estimator.swarm.error_models import OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings

START = np.diag([1e-4, 1e-4, 4e-4])


def grid(count: int) -> FloatArray:
    side = int(np.ceil(np.sqrt(count)))
    index = np.arange(count)
    places: FloatArray = 0.5 * np.column_stack([index % side, index // side]).astype(float)
    return places


def neighbours(places: FloatArray, reach: float = 0.8) -> IntArray:
    gap = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    return np.argwhere((gap < reach) & (gap > 0.0))


def test_what_is_contradicted_is_estimated() -> None:
    robots, mark = [Robot(name, camera=CameraMount()) for name in "ab"], Landmark(1, 1.0, 0.5, yaw=0.0)
    table = ParameterTable.of(robots, [mark], in_blocks=True)
    state = SwarmState(table, joint=SparseFilter(table))
    for robot in range(2):
        state.initialize(robot, InitialPose(np.array([robot, 0.0, 0.0]), START), Preintegrated.begin(0))
    before = state.filter.block(np.arange(3))
    state.augment(0, np.zeros(3))
    assert np.linalg.eigvalsh(state.filter.block(np.arange(3)) - before).min() > 1e-4
    estimated = table.sigma[0] > 0.0
    assert estimated[CAMERA_YAW]
    assert (state.parameter_sigma(0)[estimated] > 0.01).all()
    assert not state.parameter_sigma(0)[~estimated].any()
    assert not state.parameter_sigma(1).any()
    state.augment(2, np.zeros(3))
    column, yaw = state.landmark_column(0), int(state.arrays().table.column[0, CAMERA_YAW])
    assert np.linalg.eigvalsh(state.landmark_covariance(0)).min() > 1e-5
    assert isinstance(state.filter, SparseFilter)
    related = np.array([[0, column, yaw], [0, 3, yaw]])
    cross_covariance = np.ones((2, 3, 6))
    state.filter.prepare_update(related, Robots(np.zeros((2, 2)), state.tracked), cross_covariance)
    np.testing.assert_allclose(cross_covariance, 0.0, atol=1e-12)
    jacobian = np.zeros((1, 3, 8))
    jacobian[0, :, :3], jacobian[0, :, 3:6] = -np.eye(3), np.eye(3)
    jacobian[0, 2, 6] = 1.0
    columns = np.array([[0, 1, 2, column, column + 1, column + 2, yaw, 0]])
    correction = state.filter.update(columns, jacobian, np.full((1, 3), 0.01), 1e-4 * np.eye(3)[None])
    assert correction[0] < 0.0 < correction[column]
    assert correction[yaw] > 0.0
    assert not correction[3:6].any()


@pytest.mark.parametrize("yaw_sigma", [0.0, 0.01])
def test_a_large_swarm_is_sparse_whether_it_is_calibrated_or_not(yaw_sigma: float) -> None:
    robots = tuple(Robot(f"r{k}", camera=CameraMount(yaw_sigma=yaw_sigma)) for k in range(3))
    assert Estimator(Swarm(robots, ()), Settings(sparse_from=3)).hint == ""
    one_by_one = Settings(sparse_from=3, fusion_period_s=0.0)
    assert "because fusion_period_s is 0" in Estimator(Swarm(robots, ()), one_by_one).hint


NOISE = np.diag([4e-4, 4e-4, 1e-3])
ODOMETRY = OdometryModel(
    distance_scale_sigma=0.05, turn_scale_sigma=0.1, turn_bias_sigma=0.02, turn_bias_time_s=3.0
)
CALIBRATED = Robot(
    "",
    odometry=ODOMETRY,
    camera=CameraMount(yaw_sigma=0.03, yaw_time_s=2.0),
    sensor=SensorModel(distance_scale_sigma=0.04, range_offset_sigma=0.03),
)
KINDS = (
    CALIBRATED,
    replace(CALIBRATED, odometry=OdometryModel()),
    replace(CALIBRATED, camera=CameraMount(), sensor=SensorModel()),
    replace(CALIBRATED, camera=CameraMount(yaw_sigma=0.03, yaw_time_s=4.0), sensor=SensorModel()),
    Robot("", camera=CameraMount(yaw_sigma=0.03, yaw_time_s=1.0)),
    Robot("", camera=CameraMount()),
)
"""Everything is estimated of the first, of others only something, of the last nothing."""


class Both:
    """A dense and a sparse filter of the same robots and landmarks, given the same.

    Attributes:
        exact: The last correction by the dense filter.
    """

    def __init__(
        self, robots: int, seed: int, kinds: tuple[Robot, ...] = KINDS, places: FloatArray | None = None
    ) -> None:
        self.rng = np.random.default_rng(seed)
        described = [replace(kinds[k % len(kinds)], name=f"r{k}") for k in range(robots)]
        marks = [
            Landmark(k, float(x), float(y), yaw=0.5, position_sigma=0.02 * (k < 2))
            for k, (x, y) in enumerate(self.rng.uniform(-3.0, 3.0, (3, 2)))
        ]
        tables = [ParameterTable.of(described, marks, in_blocks=sparse) for sparse in (False, True)]
        self.states = SwarmState(tables[0]), SwarmState(tables[1], joint=SparseFilter(tables[1]))
        drawn = self.rng.uniform(0.0, 5.0, (robots, 2)) if places is None else places
        self.poses = np.column_stack([drawn, self.rng.uniform(-3.0, 3.0, robots)])
        self.now_ns = 0
        self.covariance, self.jacobian = np.zeros((robots, 3, 3)), np.zeros((robots, 3, DRIVES))
        for robot in range(robots):
            self.start(robot)

    def start(self, robot: int, others: IntArray | None = None) -> None:
        """Give a robot a pose of its own, or one that errs as others do, too."""
        at = Preintegrated(self.now_ns, self.covariance[robot], self.jacobian[robot])
        start = se2.error_covariance(self.poses[robot], START)
        chosen = np.zeros(0, dtype=np.int64) if others is None else others
        shares = np.tile(np.eye(3) / max(1, chosen.size), (chosen.size, 1, 1))
        for state in self.states:
            state.initialize(robot, InitialPose(self.poses[robot], start, 3 * chosen, shares), at)

    def drive(self) -> None:
        """Let robots drive, some of them twice."""
        self.now_ns += 200_000_000
        for robot in self.rng.integers(0, len(self.poses), 2 * len(self.poses)).tolist():
            self.now_ns += 1_000_000
            self.covariance[robot] += np.diag([1e-6, 1e-7, 1e-6])
            self.jacobian[robot] += self.rng.normal(0.0, 0.1, (3, DRIVES))
            to = Preintegrated(self.now_ns, self.covariance[robot].copy(), self.jacobian[robot].copy())
            for state in self.states:
                if state.tracked[robot]:
                    predict(state.arrays(), robot, to, new_scratch())

    def update(self, pairs: IntArray) -> tuple[FloatArray, FloatArray]:
        """Use a measurement of each pair (m, 2), N + l being landmark l; return the sparse filter's gaps.

        Returns:
            Gaps of the corrections by the dense filter's columns, and of `cross_covariance` (m, 3, 6).
        """
        robots = len(self.poses)
        columns = Measurements.empty(len(pairs))
        columns.observer[:] = pairs[:, 0]
        columns.target[:] = np.where(pairs[:, 1] < robots, pairs[:, 1], NOBODY)
        columns.landmark[:] = np.where(pairs[:, 1] < robots, NOBODY, pairs[:, 1] - robots)
        chains = self.rng.normal(0.0, 1.0, (len(pairs), 3, 6))
        innovation = self.rng.normal(0.0, 0.02, (len(pairs), 3))
        related = [related_columns(columns, state.arrays()) for state in self.states]
        dense, sparse = (state.filter for state in self.states)
        assert isinstance(sparse, SparseFilter)
        tracked = self.states[1].tracked
        cross_covariance = np.zeros((len(pairs), 3, 6))
        sparse.prepare_update(related[1], Robots(self.poses[:, :2], tracked.copy()), cross_covariance)
        gaps = []
        for k, (observer, target, _) in enumerate(related[0].tolist()):
            exact = np.zeros((3, 6))
            if target >= 0:
                exact[:, :3] = dense.covariance[observer : observer + 3, target : target + 3]
                camera = self.states[0].arrays().table.column[pairs[k, 0], CAMERA_YAW:]
                for c in np.flatnonzero(camera >= 0):
                    exact[:, 3 + c] = dense.covariance[target : target + 3, camera[c]]
                    gaps.append(cross_covariance[k, :, 3 + c] - exact[:, 3 + c])
                gaps.append((cross_covariance[k, :, :3] - exact[:, :3]).reshape(-1))
        corrections = []
        for state, first in zip(self.states, related, strict=True):
            table = state.arrays().table
            used, jacobian = np.zeros((len(pairs), 9), dtype=np.int64), np.zeros((len(pairs), 3, 9))
            for k, (observer, target, _) in enumerate(first.tolist()):
                used[k, :3], jacobian[k, :, :3] = observer + np.arange(3), -chains[k, :, :3]
                if target >= 0:
                    used[k, 3:6], jacobian[k, :, 3:6] = target + np.arange(3), chains[k, :, :3]
                for place, parameter in enumerate((CAMERA_YAW, CAMERA_SCALE, CAMERA_OFFSET), 6):
                    estimated = int(table.column[pairs[k, 0], parameter])
                    if estimated >= 0:
                        used[k, place], jacobian[k, :, place] = estimated, chains[k, :, place - 3]
            noise = np.tile(NOISE, (len(pairs), 1, 1))
            corrections.append(state.filter.update(used, jacobian, innovation, noise))
        self.exact = corrections[0]
        return self.in_dense(corrections[1]) - self.exact, np.concatenate(gaps)

    def columns(self) -> tuple[IntArray, IntArray]:
        """Columns (n,) of the same in either filter, of all that is estimated."""
        out = []
        for state in self.states:
            table, robots = state.arrays().table, np.flatnonzero(state.tracked)
            surveyed = table.survey_column[table.survey_column >= 0]
            own = np.concatenate([3 * robots, surveyed])[:, None] + np.arange(3)
            out.append(np.concatenate([own.reshape(-1), table.column[table.column >= 0]]))
        return out[0], out[1]

    def in_dense(self, correction: FloatArray) -> FloatArray:
        """A sparse correction, and where it is not a number what the dense filter has beside it."""
        dense, sparse = self.columns()
        out = np.zeros(self.states[0].filter.covariance.shape[0])
        out[dense] = correction[sparse]
        return out

    def assert_equal(self, tolerance: float) -> None:
        """Poses with their parameters, and landmarks, are as certain in both."""
        dense, sparse = self.states
        assert isinstance(sparse.filter, SparseFilter)
        for robot in np.flatnonzero(dense.tracked).tolist():
            estimated = np.flatnonzero(dense.arrays().table.column[robot] >= 0)
            columns = np.concatenate(
                [3 * robot + np.arange(3), dense.arrays().table.column[robot, estimated]]
            )
            exact = dense.filter.block(columns)
            own = np.concatenate([np.arange(3), 3 + estimated])
            nearly = sparse.filter.marginal[robot][np.ix_(own, own)]
            scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
            np.testing.assert_allclose(nearly / scale, exact / scale, atol=tolerance)
            sigmas = [state.parameter_sigma(robot) for state in self.states]
            np.testing.assert_allclose(sigmas[1], sigmas[0], rtol=tolerance)
        for landmark in range(2):
            exact, nearly = (state.landmark_covariance(landmark) for state in self.states)
            scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
            np.testing.assert_allclose(nearly / scale, exact / scale, atol=tolerance)


def test_many_fronts_are_nearly_exact() -> None:
    """Of a hundred robots, each of which measures those beside it, and one an exact landmark."""
    both = Both(100, 0, (Robot(""),), grid(100))
    pairs = np.concatenate([neighbours(grid(100)), [[0, 102]]])
    for _ in range(60):
        both.drive()
        correction, _ = both.update(pairs[both.rng.uniform(size=len(pairs)) < 0.4])
    columns = 3 * np.arange(100)[:, None] + np.arange(3)
    exact, nearly = (np.array([state.filter.block(one) for one in columns]) for state in both.states)
    ratio = np.trace(nearly, axis1=1, axis2=2) / np.trace(exact, axis1=1, axis2=2)
    assert 0.9 < ratio.min() < ratio.max() < 1.1
    assert np.linalg.norm(correction) < 0.1 * np.linalg.norm(both.exact)


def step_of_all(both: Both, step: int) -> tuple[FloatArray, FloatArray]:
    """A step in which all see all; in some steps robots leave, join or are contradicted."""
    both.drive()
    if step in (8, 20):
        for state in both.states:
            for source in {8: (0,), 20: (6, 7, 8)}[step]:
                state.augment(source, both.poses[source % 6])
    if step == 12:
        for state in both.states:
            state.deinitialize(2, LossReason.COMMAND, both.now_ns)
    if step == 16:
        both.start(2, np.array([0, 3]))
    there = np.flatnonzero(both.states[0].tracked)
    marks = [(robot, 6 + mark) for robot in there for mark in range(3)]
    return both.update(np.array(list(itertools.permutations(there, 2)) + marks))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", [*KINDS[:4], KINDS[-1]])
def test_with_one_calibrated_robot_it_is_exact(kind: Robot, seed: int) -> None:
    """The pattern is full: that robot's parameters depend on nothing but poses in it."""
    both = Both(6, seed, (kind, *5 * [Robot("")]))
    for step in range(30):
        correction, cross_covariance = step_of_all(both, step)
        np.testing.assert_allclose(correction, 0.0, atol=1e-12)
        np.testing.assert_allclose(cross_covariance, 0.0, atol=1e-12)
        both.assert_equal(1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_with_many_calibrated_robots_it_is_nearly_exact(seed: int) -> None:
    """That parameters of two robots depend on each other, given all poses, is left out."""
    both = Both(6, seed)
    for step in range(30):
        correction, _ = step_of_all(both, step)
        sigma = np.sqrt(np.diag(both.states[0].filter.covariance))
        assert np.abs(correction / sigma).max() < 0.2
        both.assert_equal(0.1)


def test_before_the_first_update_moves_are_exact() -> None:
    """What robots' parameters have moved is in the covariances of all pairs that are measured."""
    both = Both(6, 1)
    for _ in range(2):
        both.drive()
        _, cross_covariance = both.update(np.array(list(itertools.permutations(range(6), 2))))
        np.testing.assert_allclose(cross_covariance, 0.0, atol=1e-12)


COUNT = 60


def situation(pairs: list[tuple[int, int]]) -> Situation:
    no_blocks = Order(np.zeros(0, dtype=np.int64), np.zeros(1, dtype=np.int64))
    return Situation(np.arange(COUNT), no_blocks, grid(COUNT), np.array(pairs, dtype=np.int64).reshape(-1, 2))


PAIR = st.tuples(st.integers(0, COUNT - 1), st.integers(0, COUNT - 1))


@given(st.lists(st.lists(PAIR, max_size=6), min_size=12, max_size=12), st.lists(PAIR, max_size=6))
def test_the_next_order_does_not_depend_on_what_is_measured_then(
    earlier: list[list[tuple[int, int]]], late: list[tuple[int, int]]
) -> None:
    before = None
    for pairs in earlier:
        now = situation(pairs)
        one, other = ordered(now, before), ordered(situation(pairs + late), before)
        if before is not None and before.updates >= ordering._ORDERED_AGAIN:
            assert one.order is other.order
            assert one.near.pairs is other.near.pairs
        for a, b in pairs + late:  # whatever the order is, all pairs lie in the pattern
            assert in_pattern(other, a, b)
        before = one


def in_pattern(one: ordering.Ordering, a: int, b: int) -> bool:
    pattern = one.pattern
    f, g = sorted((int(pattern.front[a]), int(pattern.front[b])))
    later = a if pattern.front[a] == g else b
    return f == g or later in pattern.border[pattern.border_begin[f] : pattern.border_begin[f + 1]]


@pytest.mark.parametrize("grown", [0.0, math.inf])
def test_who_is_near_whom_is_found_out_again_however_soon_orders_are_replaced(
    monkeypatch: pytest.MonkeyPatch, grown: float
) -> None:
    monkeypatch.setattr(ordering, "_GROWN", grown)
    robot, now = 0, None
    for update in range(3 * ordering._NEAR_AGAIN):
        here = situation([])
        here.places[robot] = (3.6, 0.1 + 0.05 * min(update, ordering._NEAR_AGAIN))
        now = ordered(here, now)
    assert now is not None
    for a, b in now.near.pairs:
        if robot in (a, b):
            assert np.linalg.norm(here.places[a] - here.places[b]) < 2.0
    assert now.near.updates <= ordering._NEAR_AGAIN + ordering._ORDERED_AGAIN


def random_pattern(rng: np.random.Generator) -> Pattern:
    """That of pairs of bodies near each other, some bodies having been eliminated before all others."""
    places, first = rng.uniform(0.0, 1.0, (COUNT, 2)), rng.permutation(COUNT)[:8]
    near = np.argsort(np.linalg.norm(places[:, None] - places, axis=2), axis=1)[:, 1:4]
    pairs = np.column_stack([np.repeat(np.arange(COUNT), 3), near.reshape(-1)])
    graph = adjacency(COUNT, pairs)
    rest = dissect(np.setdiff1d(np.arange(COUNT), first), places, graph)
    begin = np.concatenate([[0, 2, 3, 5, 6, 7], 8 + rest.begin])
    return pattern_of(Order(np.concatenate([first, rest.body]), begin), graph)


def random_factor(rng: np.random.Generator, pattern: Pattern) -> tuple[Factor, FloatArray]:
    """A factor, and the covariance (3 n, 3 n) that it says."""
    factor, size = new_factor(pattern), 3 * COUNT
    depends, own = np.eye(size), np.zeros((size, size))
    for f in range(pattern.fronts):
        pivots = columns_of(pattern.pivot[pattern.pivot_begin[f] : pattern.pivot_begin[f + 1]])
        border = columns_of(pattern.border[pattern.border_begin[f] : pattern.border_begin[f + 1]])
        gain, root = rng.normal(0.0, 0.1, (border.size, pivots.size)), rng.normal(0.0, 1.0, 2 * [pivots.size])
        spread = root @ root.T + np.eye(pivots.size)
        factor.gain[factor.gain_begin[f] : factor.gain_begin[f + 1]] = gain.reshape(-1)
        factor.spread[factor.spread_begin[f] : factor.spread_begin[f + 1]] = spread.reshape(-1)
        depends[np.ix_(pivots, border)] = -gain.T
        own[np.ix_(pivots, pivots)] = spread
    inverse = np.linalg.inv(depends)
    return factor, inverse @ own @ inverse.T


def columns_of(bodies: IntArray) -> IntArray:
    columns: IntArray = (3 * bodies[:, None] + np.arange(3)).reshape(-1)
    return columns


@pytest.mark.parametrize("seed", range(8))
def test_a_factor_says_all_covariances_that_a_new_pattern_wants(seed: int) -> None:
    rng = np.random.default_rng(seed)
    factor, exact = random_factor(rng, random_pattern(rng))
    solved = np.eye(3 * COUNT)
    solve(factor, solved)
    np.testing.assert_allclose(solved, exact, atol=1e-10)

    new, place = random_pattern(rng), rng.permutation(COUNT)
    beside = np.where(rng.random(COUNT) < 0.3, rng.integers(0, COUNT, COUNT), -1)
    covariance = np.full((COUNT, COUNT, 3, 3), np.nan)
    write_fronts(factor, covariance)
    write_rows(factor, 0, *wanted_rows(factor.pattern, new, place, 0, beside), covariance)
    for f in range(new.fronts):
        pivots = new.pivot[new.pivot_begin[f] : new.pivot_begin[f + 1]]
        border = new.border[new.border_begin[f] : new.border_begin[f + 1]]
        for a in pivots.tolist():
            moved = beside[a] >= 0
            of_a = place[[a, *([beside[a]] if moved else [])]]
            for b in [*pivots.tolist(), *border.tolist()]:
                of_b = place[[b, *([beside[b]] if beside[b] >= 0 else [])]] if b != a else of_a
                found = covariance[np.ix_(of_a, of_b)].transpose(0, 2, 1, 3).reshape(3 * of_a.size, -1)
                wanted = exact[np.ix_(columns_of(of_a), columns_of(of_b))]
                np.testing.assert_allclose(found, wanted, atol=1e-10)


def run(world: World, settings: Settings = SPARSE, period_s: float = 0.2) -> tuple[Estimator, list[Estimate]]:
    estimator = Estimator(world.swarm, settings)
    end_ns = int(world.stamp_ns[-1])
    return estimator, play(estimator, on_time(world), ticks(T0, end_ns, period_s))


def misled(world: World, liar: int, from_ns: int, by: tuple[float, float]) -> World:
    """The world where one robot sees all that it sees off by so much, in its camera's frame [m]."""
    events = []
    for event in world.events:
        detections = event.detections
        if event.robot == liar and detections.size and event.stamp_ns >= from_ns:
            detections = detections.copy()
            detections["position"][:, 0] += by[0]
            detections["position"][:, 2] += by[1]
        events.append(replace(event, detections=detections))
    return replace(world, events=tuple(events))


@pytest.mark.parametrize("seed", range(3))
def test_false_sightings_of_one_robot_are_gated_and_the_robot_is_named(seed: int) -> None:
    as_in_a_large_swarm = replace(SPARSE, policy=Policy(reopen_all_up_to=2))
    plan = Plan(5, 14.0, landmarks=6)
    world = misled(simulate(plan, 700 + seed), 2, T0 + 6 * SECOND, (0.5, 0.3))
    estimator, estimates = run(world, as_in_a_large_swarm)
    named = set()
    for estimate in estimates[-5:]:
        named |= {one.about for one in estimator.contradictions(estimate.stamp_ns)}
    assert settled(estimator)["GATED"] > 10
    honest = [k for k in range(5) if k != 2]
    assert world.swarm.robots[2].name in named
    assert not named & {world.swarm.robots[k].name for k in honest}
    assert distances(world, estimates)[:, honest].max() < 0.1


def test_where_descriptions_contradict_everything_is_estimated_anew() -> None:
    world = misled(simulate(Plan(5, 14.0, landmarks=6), 701), 2, T0 + 6 * SECOND, (0.5, 0.3))
    estimator, estimates = run(world)
    state = estimator._timeline.state
    assert state.is_doubted
    assert (state.arrays().table.column[:, 1:CAMERA_OFFSET] >= 0).all()
    assert all(state.landmark_column(k) >= 0 for k in range(6))
    assert distances(world, estimates)[:, [0, 1, 3, 4]].max() < 0.1


@pytest.mark.parametrize(("others", "ago_s", "is_doubted"), [(1, 30, False), (2, 30, True), (2, 61, False)])
def test_a_survey_is_doubted_as_a_whole_where_a_third_landmark_contradicts_it_within_a_minute(
    others: int, ago_s: int, is_doubted: bool
) -> None:
    world = simulate(Plan(3, 4.0, landmarks=8), 720)
    estimator, _ = run(world)
    state, now_ns = estimator._timeline.state.copy(), int(world.stamp_ns[-1])
    state.contradicted_ns[3 : 3 + others] = now_ns - ago_s * SECOND
    estimator._fusion._augment(state, 3 + others, now_ns)
    assert state.is_doubted == is_doubted
    opened = [state.landmark_column(k) >= 0 for k in range(8)]
    assert opened == [is_doubted or k == others for k in range(8)]
