"""Parameters of robots and surveyed landmarks in the sparse filter, beside the dense one."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.joint_filter import Robots
from swarm_loc_estimator.filter.measurements import NOBODY, LossReason, Measurements
from swarm_loc_estimator.filter.prediction import new_scratch, predict
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
from swarm_loc_estimator.swarm.swarm import CameraMount, Landmark, Robot

START = np.diag([1e-4, 1e-4, 4e-4])
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
    """A dense and a sparse filter of the same robots and landmarks, given the same."""

    def __init__(self, robots: int, seed: int, kinds: tuple[Robot, ...] = KINDS) -> None:
        self.rng = np.random.default_rng(seed)
        described = [replace(kinds[k % len(kinds)], name=f"r{k}") for k in range(robots)]
        marks = [
            Landmark(k, float(x), float(y), yaw=0.5, position_sigma=0.02 * (k < 2))
            for k, (x, y) in enumerate(self.rng.uniform(-3.0, 3.0, (3, 2)))
        ]
        tables = [ParameterTable.of(described, marks, in_blocks=sparse) for sparse in (False, True)]
        self.states = SwarmState(tables[0]), SwarmState(tables[1], joint=SparseFilter(tables[1]))
        self.poses = np.column_stack(
            [self.rng.uniform(0.0, 5.0, (robots, 2)), self.rng.uniform(-3.0, 3.0, robots)]
        )
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
        return self.in_dense(corrections[1]) - corrections[0], np.concatenate(gaps)

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


def play(both: Both, step: int) -> tuple[FloatArray, FloatArray]:
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
@pytest.mark.parametrize("kind", KINDS[:4])
def test_with_one_calibrated_robot_it_is_exact(kind: Robot, seed: int) -> None:
    """The pattern is full: that robot's parameters depend on nothing but poses in it."""
    both = Both(6, seed, (kind, *5 * [Robot("")]))
    for step in range(30):
        correction, cross_covariance = play(both, step)
        np.testing.assert_allclose(correction, 0.0, atol=1e-12)
        np.testing.assert_allclose(cross_covariance, 0.0, atol=1e-12)
        both.assert_equal(1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_with_many_calibrated_robots_it_is_nearly_exact(seed: int) -> None:
    """That parameters of two robots depend on each other, given all poses, is left out."""
    both = Both(6, seed)
    for step in range(30):
        correction, _ = play(both, step)
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
