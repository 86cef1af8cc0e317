"""The sparse filter beside the dense one: the same where its pattern is full, nearly so where it is not."""

import numpy as np
import pytest

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.se2 import error_covariance
from swarm_loc_estimator.filter.joint_filter import DenseFilter, Robots
from swarm_loc_estimator.filter.sparse.sparse_filter import SparseFilter
from swarm_loc_estimator.filter.state import InitialPose, SwarmState
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.swarm.calibration_states import CAMERA_YAW, ParameterTable
from swarm_loc_estimator.swarm.swarm import CameraMount, Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Settings

SIGMA = np.array([0.02, 0.02, 0.035])
START = np.diag([1e-4, 1e-4, 4e-4])


class Both:
    """A dense and a sparse filter of the same bodies, given the same."""

    def __init__(self, places: FloatArray, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.places = places
        self.active = np.ones(len(places), dtype=bool)
        table = ParameterTable.of([Robot(str(body)) for body in range(len(places))], in_blocks=True)
        self.filters = DenseFilter(table.filter_size), SparseFilter(table)
        for body in range(len(places)):
            self.place(body)

    def place(self, body: int, covariance: FloatArray = START) -> None:
        """Give a body a pose of its own."""
        pose = np.append(self.places[body], 0.3)
        for one in self.filters:
            one.set_prior(3 * body + np.arange(3), error_covariance(pose, covariance))

    def relate(self, body: int, others: IntArray) -> None:
        """Let a body err as others do on average, too."""
        columns = (3 * others[:, None] + np.arange(3)).reshape(-1)
        mapping = np.tile(np.eye(3) / others.size, others.size)
        for one in self.filters:
            one.correlate(3 * body + np.arange(3), columns, mapping)

    def predict(self, scale: float = 1.0) -> None:
        """Let all bodies drive."""
        dense, sparse = self.filters
        for body, place in enumerate(self.places):
            noise = error_covariance(np.append(place, 0.0), scale * np.diag([1e-7, 1e-8, 2e-6]))
            own = slice(3 * body, 3 * body + 3)
            dense.covariance[own, own] += noise
            sparse.marginal[body] += noise

    def update(self, pairs: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Use a measurement of each pair (m, 2), -1 being the map; return corrections and gaps of P."""
        count = len(pairs)
        columns = np.zeros((count, 8), dtype=np.int64)
        jacobian = np.zeros((count, 3, 8))
        for k, (a, b) in enumerate(pairs):
            columns[k, :3], columns[k, 3:6] = 3 * max(a, 0) + np.arange(3), 3 * max(b, 0) + np.arange(3)
            x, y = self.places[max(a, b)]
            chain = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
            jacobian[k, :, :3] = -chain if a >= 0 else 0.0
            jacobian[k, :, 3:6] = chain if b >= 0 else 0.0
        innovation = SIGMA * self.rng.standard_normal((count, 3))
        noise = np.tile(np.diag(SIGMA**2), (count, 1, 1))
        first = np.where(pairs >= 0, 3 * pairs, -1)
        robots = Robots(self.places, self.active)
        dense, sparse = self.filters
        related = np.zeros((count, 3, 6))
        sparse.prepare_update(np.column_stack([first, np.full(count, -1)]), robots, related)
        cross_covariance = related[:, :, :3]
        for k in np.flatnonzero((pairs >= 0).all(axis=1)).tolist():
            cross_covariance[k] -= dense.covariance[columns[k, :3, None], columns[k, 3:6]]
        corrections = [one.update(columns, jacobian, innovation, noise) for one in self.filters]
        return corrections[0], corrections[1], cross_covariance

    def marginals(self) -> tuple[FloatArray, FloatArray]:
        """Covariances (n, 3, 3) of poses by either filter."""
        out = []
        for one in self.filters:
            blocks = [one.block(3 * body + np.arange(3)) for body in np.flatnonzero(self.active).tolist()]
            lever = np.tile(np.eye(3), (len(blocks), 1, 1))
            places = self.places[self.active]
            lever[:, 0, 2], lever[:, 1, 2] = -places[:, 1], places[:, 0]
            out.append(lever @ np.array(blocks) @ lever.transpose(0, 2, 1))
        return out[0], out[1]


def grid(count: int) -> FloatArray:
    side = int(np.ceil(np.sqrt(count)))
    index = np.arange(count)
    places: FloatArray = 0.5 * np.column_stack([index % side, index // side]).astype(float)
    return places


def neighbours(places: FloatArray, reach: float = 0.8) -> IntArray:
    gap = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    return np.argwhere((gap < reach) & (gap > 0.0))


@pytest.mark.parametrize("seed", range(4))
def test_with_a_full_pattern_it_is_exact(seed: int) -> None:
    """All bodies are in one front; they join, leave, are placed anew and related, and some are copied."""
    rng = np.random.default_rng(seed)
    both = Both(rng.uniform(0.0, 5.0, (16, 2)), seed)
    for step in range(30):
        both.predict()
        if step == 10:
            both.active[3] = False
        if step == 15:
            both.active[3] = True
            both.place(3)
            both.relate(3, np.array([4, 7]))
            both.place(5)
            both.relate(5, np.array([3]))
        pairs = rng.choice(np.flatnonzero(both.active), (20, 2))
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        pairs[0] = -1, rng.choice(np.flatnonzero(both.active))
        dense, sparse, cross_covariance = both.update(pairs)
        kept = np.repeat(both.active, 3)
        np.testing.assert_allclose(sparse[kept], dense[kept], atol=1e-11)
        np.testing.assert_allclose(cross_covariance, 0.0, atol=1e-11)
        exact, nearly = both.marginals()
        np.testing.assert_allclose(nearly, exact, rtol=1e-7, atol=1e-13)


def test_many_fronts_are_nearly_exact() -> None:
    places = grid(100)
    both, pairs = Both(places), neighbours(places)
    pairs = np.concatenate([pairs, [[-1, 0]]])
    for _ in range(60):
        both.predict()
        dense, sparse, _ = both.update(pairs[both.rng.uniform(size=len(pairs)) < 0.4])
    exact, nearly = both.marginals()
    ratio = np.trace(nearly, axis1=1, axis2=2) / np.trace(exact, axis1=1, axis2=2)
    assert 0.9 < ratio.min() < ratio.max() < 1.1
    assert np.linalg.norm(sparse - dense) < 0.1 * np.linalg.norm(dense)


def test_a_copy_goes_its_own_way() -> None:
    both, pairs = Both(grid(60)), neighbours(grid(60))
    both.update(pairs)
    sparse = both.filters[1]
    before = sparse.marginal.copy()
    other = sparse.copy()
    robots = Robots(both.places, both.active)
    first = 3 * pairs[:10]
    other.prepare_update(np.column_stack([first, np.full(10, -1)]), robots, np.zeros((10, 3, 6)))
    jacobian, noise = np.tile(np.hstack([-np.eye(3), np.eye(3)]), (10, 1, 1)), np.tile(np.eye(3), (10, 1, 1))
    columns = (first[:, :, None] + np.arange(3)).reshape(10, 6)
    other.update(columns, jacobian, np.ones((10, 3)), 1e-6 * noise)
    np.testing.assert_array_equal(sparse.marginal, before)
    assert not np.array_equal(other.marginal, before)


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
