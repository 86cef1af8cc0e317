"""Calibrate offsets of odometry: of the turn rate, of the course and of the axle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.offline.calibration.camera import DENSE_GAP_NS
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.offline.calibration.robust import (
    fit_with_prior,
    population,
    spread,
)
from swarm_loc_estimator.swarm.calibration_states import TURN_BIAS
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

_WIDE = np.array([0.05, 0.05])  # Standard deviations of the prior of course offset [rad] and axle offset [m]
_WIDE_BIAS = np.array([0.01])  # Standard deviation of the prior of the turn bias [rad/s]
_WINDOW_NS = 2_000_000_000
_STRIDE_NS = 500_000_000
_SHORTEST_NS, _LONGEST_NS = 1_000_000_000, 20_000_000_000
_MIN_WINDOWS = 20


@dataclass(frozen=True)
class _OffsetRegression:
    """Linear regression of a robot's motion in windows by offsets (p,)."""

    # (m,) motion to the left [m] or turn [rad] that odometry misses, per square root of a second
    wanted: FloatArray
    basis: FloatArray  # (m, p) its derivatives by the offsets
    independent_share: float  # Share of independent windows

    def fit(self, mean: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Offsets (p,) and their standard deviations (p,)."""
        scale = max(spread(self.wanted), 1e-5) / np.sqrt(self.independent_share)
        for _ in range(2):
            level = scale

            def residuals(offsets: FloatArray, level: float = level) -> FloatArray:
                return np.asarray((self.wanted - self.basis @ offsets) / level)

            found = fit_with_prior(residuals, mean, sigma)
            error = self.wanted - self.basis @ found[0]
            scale = max(spread(error), 1e-5) / np.sqrt(self.independent_share)
        return found


def fit_offsets(recording: Recording, swarm: Swarm, members: Sequence[int]) -> dict[int, Robot]:
    """Fit the turn bias, in addition to the described one, then course and axle offset of robots of one type.

    Robots with too little ground truth get the mean.
    """
    robots = {index: swarm.robots[index] for index in members}
    motion = {index: _motion(recording, robot, recording.track(index)) for index, robot in robots.items()}
    usable = {index: one for index, one in motion.items() if one is not None}
    if not usable:
        return {}
    bias = _of_type({index: _turns(one) for index, one in usable.items()}, members, _WIDE_BIAS)
    for index, robot in robots.items():
        robots[index] = _with(robot, turn_bias=robot.odometry.turn_bias + float(bias[index][0]))
    usable = {i: one for i in usable if (one := _motion(recording, robots[i], recording.track(i)))}
    offsets = _of_type({index: _laterals(one) for index, one in usable.items()}, members, _WIDE)
    return {
        index: _with(robot, course_offset=float(offsets[index][0]), axle_offset=float(offsets[index][1]))
        for index, robot in robots.items()
    }


def _with(robot: Robot, **offsets: float) -> Robot:
    rounded = {name: round(value, 5) for name, value in offsets.items()}
    return replace(robot, odometry=replace(robot.odometry, **rounded))


def _of_type(
    regressions: dict[int, _OffsetRegression], members: Sequence[int], wide: FloatArray
) -> dict[int, FloatArray]:
    """Offsets (p,) of each member of a type, about the mean of the type, which those without data get."""
    alone = [one.fit(np.zeros(wide.size), wide) for one in regressions.values()]
    mean, sigma = population(np.array([one[0] for one in alone]), np.array([one[1] for one in alone]), wide)
    return dict.fromkeys(members, mean) | {
        index: one.fit(mean, sigma)[0] for index, one in regressions.items()
    }


@dataclass(frozen=True)
class _Motion:
    """Motion of a robot in windows (m,): calibrated odometry without course and axle offset, and truth."""

    reported: FloatArray  # (m, 3) x, y and theta in the frame of the beginning
    true: FloatArray  # (m, 3) the same for the truth
    moving_s: FloatArray  # (m,) time in motion
    length_s: FloatArray  # (m,) of the windows
    independent_share: float  # Share of independent windows


def _motion(recording: Recording, robot: Robot, track: Trajectory) -> _Motion | None:
    """The motion of a robot; None with too little ground truth."""
    truth = recording.truth.get(robot.name)
    if truth is None or track.stamp_ns.size < 2:
        return None
    first_ns, last_ns = _windows(truth, int(track.stamp_ns[0]), int(track.stamp_ns[-1]))
    if first_ns.size < _MIN_WINDOWS:
        return None
    (first, first_s), (last, last_s) = (_odometry(robot, track, ns) for ns in (first_ns, last_ns))
    true = se2.between(*(interpolate(truth, stamps, DENSE_GAP_NS)[0] for stamps in (first_ns, last_ns)))
    overlap = min(1.0, float((last_ns[-1] - first_ns[0]) / np.sum(last_ns - first_ns)))
    length_s = np.multiply(last_ns - first_ns, 1e-9, dtype=float)
    return _Motion(se2.between(first, last), true, last_s - first_s, length_s, overlap)


def _turns(motion: _Motion) -> _OffsetRegression:
    """The regression of the turn by the turn bias."""
    per_root = 1.0 / np.sqrt(motion.length_s)
    missed = se2.wrap_angle(motion.true[:, 2] - motion.reported[:, 2])
    basis = (motion.moving_s * per_root)[:, None]
    return _OffsetRegression(missed * per_root, basis, motion.independent_share)


def _laterals(motion: _Motion) -> _OffsetRegression:
    """The regression of lateral motion by course and axle offset."""
    half = 0.5 * np.column_stack([motion.reported[:, 2], motion.true[:, 2]])
    to_left = [
        -np.sin(half[:, k]) * moved[:, 0] + np.cos(half[:, k]) * moved[:, 1]
        for k, moved in enumerate((motion.reported, motion.true))
    ]
    forwards = np.cos(half[:, 0]) * motion.reported[:, 0] + np.sin(half[:, 0]) * motion.reported[:, 1]
    per_root = 1.0 / np.sqrt(motion.length_s)
    basis = np.column_stack([forwards, 2.0 * np.sin(half[:, 1])]) * per_root[:, None]
    return _OffsetRegression((to_left[1] - to_left[0]) * per_root, basis, motion.independent_share)


def _windows(truth: Trajectory, begin_ns: int, end_ns: int) -> tuple[IntArray, IntArray]:
    """First and last stamps of windows: of 2 s in dense ground truth, else between sparse true poses."""
    first = np.arange(begin_ns, end_ns - _WINDOW_NS, _STRIDE_NS)
    known = (
        interpolate(truth, first, DENSE_GAP_NS)[1] & interpolate(truth, first + _WINDOW_NS, DENSE_GAP_NS)[1]
    )
    if known.sum() >= _MIN_WINDOWS:
        return first[known], first[known] + _WINDOW_NS
    inside = truth.stamp_ns[(truth.stamp_ns >= begin_ns) & (truth.stamp_ns <= end_ns)]
    apart = np.diff(inside)
    fit = (apart >= _SHORTEST_NS) & (apart <= _LONGEST_NS)
    return inside[:-1][fit], inside[1:][fit]


def _odometry(robot: Robot, track: Trajectory, stamp_ns: IntArray) -> tuple[FloatArray, FloatArray]:
    """Calibrated odometry (m, 3) without course and axle offset, and the time in motion until then (m,)."""
    model = replace(robot.odometry, course_offset=0.0, axle_offset=0.0)
    tracks = OdometryTracks([replace(robot, odometry=model)])
    zeros = np.zeros(track.stamp_ns.size, dtype=np.int64)
    tracks.extend(zeros, track.stamp_ns, track.pose)
    sample = tracks.at(np.zeros(stamp_ns.size, dtype=np.int64), stamp_ns)
    return sample.pose, sample.jacobian[:, 2, TURN_BIAS]
