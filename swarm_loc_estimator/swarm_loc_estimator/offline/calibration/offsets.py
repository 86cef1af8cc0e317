"""Calibrate the offsets between odometry and ground truth's reference point: course and axle."""

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
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

_WIDE = np.array([0.05, 0.05])
"""Standard deviations of the prior of course offset [rad] and axle offset [m]."""
_WINDOW_NS = 2_000_000_000
_STRIDE_NS = 500_000_000
_SHORTEST_NS, _LONGEST_NS = 1_000_000_000, 20_000_000_000
_MIN_WINDOWS = 20


@dataclass(frozen=True)
class _Lateral:
    """Linear regression of lateral motion in windows by the offsets.

    Attributes:
        wanted: (m,) motion to the left [m], per square root of a second.
        basis: (m, 2) its derivatives by course offset and axle offset.
        independent_share: Share of independent windows.
    """

    wanted: FloatArray
    basis: FloatArray
    independent_share: float

    def fit(self, mean: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Offsets (2,) and their standard deviations (2,)."""
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
    """Fit course and axle offset of robots of one type; those with too little ground truth get the mean."""
    laterals = {index: _lateral(recording, swarm, index) for index in members}
    usable = {index: lateral for index, lateral in laterals.items() if lateral is not None}
    if not usable:
        return {}
    alone = [lateral.fit(np.zeros(2), _WIDE) for lateral in usable.values()]
    mean, sigma = population(np.array([one[0] for one in alone]), np.array([one[1] for one in alone]), _WIDE)
    found = dict.fromkeys(members, mean)
    found |= {index: lateral.fit(mean, sigma)[0] for index, lateral in usable.items()}
    calibrated = {}
    for index, offsets in found.items():
        robot, (course, axle) = swarm.robots[index], np.round(offsets, 5).tolist()
        odometry = replace(robot.odometry, course_offset=course, axle_offset=axle)
        calibrated[index] = replace(robot, odometry=odometry)
    return calibrated


def _lateral(recording: Recording, swarm: Swarm, index: int) -> _Lateral | None:
    """The regression of a robot; None with too little ground truth."""
    robot, track = swarm.robots[index], recording.track(index)
    truth = recording.truth.get(robot.name)
    if truth is None or track.stamp_ns.size < 2:
        return None
    first_ns, last_ns = _windows(truth, int(track.stamp_ns[0]), int(track.stamp_ns[-1]))
    if first_ns.size < _MIN_WINDOWS:
        return None
    reported = se2.between(_odometry(robot, track, first_ns), _odometry(robot, track, last_ns))
    true = se2.between(*(interpolate(truth, stamps, DENSE_GAP_NS)[0] for stamps in (first_ns, last_ns)))
    half = 0.5 * np.column_stack([reported[:, 2], true[:, 2]])
    to_left = [
        -np.sin(half[:, k]) * moved[:, 0] + np.cos(half[:, k]) * moved[:, 1]
        for k, moved in enumerate((reported, true))
    ]
    forwards = np.cos(half[:, 0]) * reported[:, 0] + np.sin(half[:, 0]) * reported[:, 1]
    length_s = (last_ns - first_ns) * 1e-9
    per_root = 1.0 / np.sqrt(length_s)
    basis = np.column_stack([forwards, 2.0 * np.sin(half[:, 1])]) * per_root[:, None]
    overlap = min(1.0, float((last_ns[-1] - first_ns[0]) / np.sum(last_ns - first_ns)))
    return _Lateral((to_left[1] - to_left[0]) * per_root, basis, overlap)


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


def _odometry(robot: Robot, track: Trajectory, stamp_ns: IntArray) -> FloatArray:
    """Calibrated odometry (m, 3) without offsets."""
    model = replace(robot.odometry, course_offset=0.0, axle_offset=0.0)
    tracks = OdometryTracks([replace(robot, odometry=model)])
    zeros = np.zeros(track.stamp_ns.size, dtype=np.int64)
    tracks.extend(zeros, track.stamp_ns, track.pose)
    return tracks.at(np.zeros(stamp_ns.size, dtype=np.int64), stamp_ns).pose
