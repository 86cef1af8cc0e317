"""filterpy's ExtendedKalmanFilter over all robots' x, y, theta, with a dense F and a full H.

Served as well as it can be: data sorted by stamp, so that nothing is ever computed twice, and all sightings
within an odometry period stacked into one update, as the e-puck paper's eq. (10)-(16) do; each is still
measured at its own stamp, by odometry from the step's. One update a picture costs several times as much.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from bench.peers.problem import Odometry, PeerResult, Sightings, sightings_of, starts_of
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from swarm_loc_drivers.sim.run import SimulatedRun

STEP_NS = 50_000_000
_QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


class _Swarm:
    """The joint filter at the stamp `now_ns`."""

    def __init__(self, run: SimulatedRun) -> None:
        start, covariance = starts_of(run)
        self._robots = np.arange(len(start))
        self._odometry = Odometry(run, run.odometry)
        self.now_ns = run.start_ns
        self._filter = ExtendedKalmanFilter(dim_x=start.size, dim_z=3)
        self._filter.x = start.ravel()
        turn = se2.adjoint(np.column_stack([np.zeros((len(start), 2)), start[:, 2]]))
        self._filter.P = _block_diagonal(turn @ covariance @ np.swapaxes(turn, -1, -2))

    @property
    def poses(self) -> FloatArray:
        """(N, 3)."""
        poses: FloatArray = self._filter.x.reshape(-1, 3)
        return poses

    def poses_at(self, stamp_ns: int) -> FloatArray:
        """Poses (N, 3) by odometry from the last step on."""
        return se2.compose(self.poses, self._step(stamp_ns)[0])

    def predict(self) -> None:
        """Go on by one step."""
        motion, covariance = self._step(self.now_ns + STEP_NS)
        before = self.poses
        after = se2.compose(before, motion)
        turn = se2.adjoint(np.column_stack([np.zeros((len(after), 2)), after[:, 2]]))
        rows = 3 * self._robots
        self._filter.F[rows, rows + 2] = -(after[:, 1] - before[:, 1])
        self._filter.F[rows + 1, rows + 2] = after[:, 0] - before[:, 0]
        self._filter.Q = _block_diagonal(turn @ covariance @ np.swapaxes(turn, -1, -2))
        self._filter.predict_x = lambda _u=0: setattr(self._filter, "x", after.ravel())
        self._filter.predict()
        self.now_ns += STEP_NS

    def update(self, sightings: Sightings) -> None:
        """Use sightings (S,) of about now."""
        count = len(sightings.stamp_ns)
        if count == 0:
            return
        target = np.maximum(sightings.target, 0)
        now = np.full(count, self.now_ns)
        camera = se2.compose(
            self._odometry.step(sightings.observer, now, sightings.stamp_ns)[0], sightings.mount
        )
        moved = se2.compose(self._odometry.step(target, now, sightings.stamp_ns)[0], sightings.marker)
        marker = np.where((sightings.target < 0)[:, None], sightings.marker, moved)
        self._filter.update(
            sightings.value,
            lambda x: jacobian(x, sightings, camera, marker),
            lambda x: expected_values(x, sightings, camera, marker),
            R=np.diag(sightings.sigma.ravel() ** 2),
            residual=residual,
        )

    def _step(self, to_ns: int) -> tuple[FloatArray, FloatArray]:
        count = len(self._robots)
        return self._odometry.step(self._robots, np.full(count, self.now_ns), np.full(count, to_ns))


def expected_values(
    x: FloatArray, sightings: Sightings, camera: FloatArray, marker: FloatArray
) -> FloatArray:
    """h(x) (S, 3): the marker in the camera's plane, e-puck paper eq. (3) and (5)."""
    poses = x.reshape(-1, 3)
    on_robot = (sightings.target >= 0)[:, None]
    marks = np.where(on_robot, se2.compose(poses[np.maximum(sightings.target, 0)], marker), marker)
    return se2.between(se2.compose(poses[sightings.observer], camera), marks)


def residual(measured: FloatArray, expected: FloatArray) -> FloatArray:
    """Innovations (3 S,) with wrapped headings."""
    difference = measured - expected
    difference[:, 2] = se2.wrap_angle(difference[:, 2])
    return difference.ravel()


def jacobian(x: FloatArray, sightings: Sightings, camera: FloatArray, marker: FloatArray) -> FloatArray:
    """H (3 S, 3 N), zero but for the blocks of observer and target."""
    poses = x.reshape(-1, 3)
    count = len(sightings.stamp_ns)
    observer = poses[sightings.observer]
    expected = expected_values(x, sightings, camera, marker)
    to_camera = _rotation(-(observer[:, 2] + camera[:, 2]))
    blocks = np.zeros((count, 3, len(poses), 3))
    rows = np.arange(count)
    of_observer = np.zeros((count, 3, 3))
    of_observer[:, :2, :2] = -to_camera
    lever = np.einsum("sij,sj->si", _rotation(-camera[:, 2]), camera[:, :2])
    of_observer[:, :2, 2] = -(lever + expected[:, :2]) @ _QUARTER.T
    of_observer[:, 2, 2] = -1.0
    blocks[rows, :, sightings.observer] = of_observer
    seen = np.flatnonzero(sightings.target >= 0)
    target = sightings.target[seen]
    of_target = np.zeros((len(seen), 3, 3))
    of_target[:, :2, :2] = to_camera[seen]
    arm = np.einsum("sij,sj->si", _rotation(poses[target, 2]), marker[seen, :2]) @ _QUARTER.T
    of_target[:, :2, 2] = np.einsum("sij,sj->si", to_camera[seen], arm)
    of_target[:, 2, 2] = 1.0
    blocks[seen, :, target] = of_target
    return blocks.reshape(3 * count, -1)


def _rotation(angle: FloatArray) -> FloatArray:
    """Rotation matrices (S, 2, 2)."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)


def _block_diagonal(blocks: FloatArray) -> FloatArray:
    """Blocks (N, 3, 3) as one matrix (3 N, 3 N)."""
    count = len(blocks)
    matrix = np.zeros((count, 3, count, 3))
    matrix[np.arange(count), :, np.arange(count)] = blocks
    return matrix.reshape(3 * count, 3 * count)


def solve(run: SimulatedRun, output_ns: IntArray) -> PeerResult:
    """Poses of all robots at each output stamp, ascending; sightings count at their stamps, however late."""
    begun = time.process_time()
    swarm = _Swarm(run)
    sightings = sightings_of(run)
    sightings = sightings[np.argsort(sightings.stamp_ns, kind="stable")]
    used = 0
    poses = []
    for stamp_ns in output_ns.tolist():
        while swarm.now_ns + STEP_NS <= stamp_ns:
            swarm.predict()
            until = int(np.searchsorted(sightings.stamp_ns, swarm.now_ns + STEP_NS // 2))
            swarm.update(sightings[used:until])
            used = until
        poses.append(swarm.poses_at(stamp_ns))
    return PeerResult(np.array(poses), time.process_time() - begun)
