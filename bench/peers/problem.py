"""What every peer is given: a run's odometry and sightings as columns, and the result they all return.

Nothing here is the estimator's own code but SE(2): a peer must not inherit its mistakes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from swarm_loc_drivers.sim.run import Records, SimulatedRun


@dataclass(frozen=True)
class PeerResult:
    """What a peer made of a run."""

    poses: FloatArray  # (K, N, 3) in map at the K output stamps
    cpu_s: float  # CPU time of this process, all threads, from the first datum to the last pose [s]


class Odometry:
    """Odometry of all robots at any stamp, with the noise gathered on the way.

    Args:
        run: Its swarm's wheel noise is the model.
        rows: The messages to use, of the simulation's ODOMETRY_DTYPE, in any order.
    """

    def __init__(self, run: SimulatedRun, rows: Records) -> None:
        rows = rows[np.lexsort((rows["stamp_ns"], rows["robot"]))]
        self._base_ns = run.start_ns
        self._span_ns = 2 * (run.end_ns - run.start_ns) + 1
        self._robot = rows["robot"].astype(np.int64)
        self._stamp_ns = rows["stamp_ns"]
        self._key = self._keys(self._robot, self._stamp_ns)
        self._first = np.flatnonzero(np.diff(self._robot, prepend=-1))
        self._last = np.append(self._first[1:], len(rows)) - 1
        self._pose: FloatArray = rows["pose"]
        self._noise = self._gather(run)

    def at(self, robot: IntArray, stamp_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Poses (M, 3) and gathered noise (M, 3, 3) in the odom frame; runs on past the newest message."""
        before = np.searchsorted(self._key, self._keys(robot, stamp_ns), side="right") - 1
        before = np.clip(before, self._first[robot], self._last[robot] - 1)
        share = (stamp_ns - self._stamp_ns[before]) / (self._stamp_ns[before + 1] - self._stamp_ns[before])
        step = se2.log(se2.between(self._pose[before], self._pose[before + 1]))
        pose = se2.compose(self._pose[before], se2.exp(share[:, None] * step))
        gathered = self._noise[before + 1] - self._noise[before]
        return pose, self._noise[before] + share[:, None, None] * gathered

    def step(self, robot: IntArray, from_ns: IntArray, to_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Motion (M, 3) between two stamps, and its covariance (M, 3, 3) in the frame at its end."""
        pose_from, noise_from = self.at(robot, from_ns)
        pose_to, noise_to = self.at(robot, to_ns)
        gathered = np.where((to_ns >= from_ns)[:, None, None], noise_to - noise_from, noise_from - noise_to)
        return se2.between(pose_from, pose_to), _carried(se2.inverse(pose_to), gathered)

    def _keys(self, robot: IntArray, stamp_ns: IntArray) -> IntArray:
        keys: IntArray = robot * self._span_ns + (stamp_ns - self._base_ns)
        return keys

    def _gather(self, run: SimulatedRun) -> FloatArray:
        """Noise (M, 3, 3), in the odom frame, gathered up to each message.

        Wheels: covar(ds_r, ds_l) = diag(k |ds_r|, k |ds_l|).
        """
        model = [robot.odometry for robot in run.swarm.robots]
        separation = np.array([m.wheel_separation for m in model])[self._robot]
        k = np.array([m.wheel_noise for m in model])[self._robot]
        previous = np.roll(self._pose, 1, axis=0)
        previous[self._first] = self._pose[self._first]
        step = se2.log(se2.between(previous, self._pose))
        half_turn = 0.5 * separation * step[:, 2]
        variance = k[:, None] * np.abs(np.column_stack([step[:, 0] + half_turn, step[:, 0] - half_turn]))
        by_wheel = np.zeros((len(step), 3, 2))
        by_wheel[:, 0] = 0.5
        by_wheel[:, 2, 0], by_wheel[:, 2, 1] = 1.0 / separation, -1.0 / separation
        middle = se2.adjoint(se2.compose(previous, se2.exp(0.5 * step))) @ by_wheel
        gathered: FloatArray = np.cumsum(
            (middle * variance[:, None, :]) @ np.swapaxes(middle, -1, -2), axis=0
        )
        return gathered - np.repeat(gathered[self._first], self._last - self._first + 1, axis=0)


@dataclass(frozen=True)
class Sightings:
    """All sightings of a run as columns, in order of their pictures' arrival."""

    observer: IntArray  # (S,) robot index
    target: IntArray  # (S,) robot index; -1 for a landmark
    stamp_ns: IntArray  # (S,)
    arrival_ns: IntArray  # (S,)
    # (S, 3) marker in the camera's plane: forward [m], left [m], direction out of its face [rad]
    value: FloatArray
    sigma: FloatArray  # (S, 3) of the value
    mount: FloatArray  # (S, 3) camera in the observer's base_link
    marker: FloatArray  # (S, 3) in the target's base_link; a landmark in map

    def __getitem__(self, rows: slice | NDArray[np.bool_] | IntArray) -> Sightings:
        return Sightings(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def sightings_of(run: SimulatedRun) -> Sightings:
    """The run's sightings as columns."""
    robots = run.swarm.robots
    observer = np.repeat(run.frames["robot"], run.frames["count"]).astype(np.int64)
    ids, place = np.unique(run.sightings["marker_id"], return_inverse=True)
    owners = [run.swarm.owner_of[int(marker)] for marker in ids]
    markers = [owner.marker for owner in owners]
    mounts = [robot.camera for robot in robots if robot.camera is not None]
    models = [robot.sensor for robot in robots]
    sigma = np.array([[s.forward_sigma, s.left_sigma, s.heading_sigma] for s in models])
    return Sightings(
        observer=observer,
        target=np.array([owner.robot_index for owner in owners], dtype=np.int64)[place],
        stamp_ns=np.repeat(run.frames["stamp_ns"], run.frames["count"]),
        arrival_ns=np.repeat(run.frames["arrival_ns"], run.frames["count"]),
        value=run.sightings["value"],
        sigma=sigma[observer],
        mount=np.array([[m.x, m.y, m.yaw] for m in mounts])[observer],
        marker=np.array([[m.x, m.y, m.yaw] for m in markers], dtype=float)[place],
    )


def starts_of(run: SimulatedRun) -> tuple[FloatArray, FloatArray]:
    """Start poses (N, 3) in map and their covariances (N, 3, 3) in the frames of these poses."""
    robots = run.swarm.robots
    start = np.array([r.start for r in robots], dtype=float)
    sigma = np.array([[r.start_sigma.x, r.start_sigma.y, r.start_sigma.theta] for r in robots])
    turn = np.column_stack([np.zeros((len(robots), 2)), -start[:, 2]])
    return start, _carried(turn, sigma[:, None, :] ** 2 * np.eye(3))


@dataclass(frozen=True)
class RelativePoses:
    """Sightings as relative poses for pose graphs."""

    pose: FloatArray  # (S, 3) the target's base_link in the observer's; for a landmark, the observer's in map
    covariance: FloatArray  # (S, 3, 3) of the error x, y, theta in the frame of `pose`


@dataclass(frozen=True)
class Moves:
    """Where robots are at a sighting's stamp, seen from where they are at the stamp wanted."""

    pose: FloatArray  # (S, 3) base_link at the sighting's stamp in base_link at the wanted stamp
    covariance: FloatArray  # (S, 3, 3) in the frame of `pose`


def no_moves(count: int) -> Moves:
    """Sightings are wanted at their own stamps."""
    return Moves(np.zeros((count, 3)), np.zeros((count, 3, 3)))


def relative_poses(sightings: Sightings, observer: Moves, target: Moves) -> RelativePoses:
    """Sightings (S,) as poses between base links at other stamps."""
    camera_to_marker = se2.compose(sightings.mount, sightings.value)
    base_to_marker = se2.compose(observer.pose, camera_to_marker)
    target_to_marker = se2.compose(target.pose, sightings.marker)
    to_robot = se2.compose(base_to_marker, se2.inverse(target_to_marker))
    in_map = se2.compose(sightings.marker, se2.inverse(base_to_marker))
    is_landmark = (sightings.target < 0)[:, None]
    pose = np.where(is_landmark, in_map, to_robot)
    # T exp(Ad(.) n): each noise n, given in its own frame, carried to the end of the chain T
    covariance = _carried(
        np.where(is_landmark, base_to_marker, target_to_marker), _noise_at_the_marker(sightings)
    )
    behind_observer = se2.compose(se2.inverse(pose), observer.pose)
    covariance += _carried(np.where(is_landmark, observer.pose, behind_observer), observer.covariance)
    covariance += _carried(target.pose, np.where(is_landmark[..., None], 0.0, target.covariance))
    return RelativePoses(pose, covariance)


def _carried(frame: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances (S, 3, 3) from frames (S, 3) into the frame that those are given in."""
    adjoint = se2.adjoint(frame)
    carried: FloatArray = adjoint @ covariance @ np.swapaxes(adjoint, -1, -2)
    return carried


def _noise_at_the_marker(sightings: Sightings) -> FloatArray:
    """Covariance (S, 3, 3) of the measured marker pose, given in the marker's own frame."""
    turn = np.column_stack([np.zeros((len(sightings.value), 2)), -sightings.value[:, 2]])
    return _carried(turn, sightings.sigma[:, None, :] ** 2 * np.eye(3))
