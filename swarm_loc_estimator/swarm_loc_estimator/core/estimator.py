"""The central estimator: odometry and sightings of a swarm in, poses out; no ROS, no clock of its own."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.core.arrivals import (
    NO_MEASUREMENTS,
    Arrivals,
    DetectionRows,
    Messages,
    OdometryRows,
)
from swarm_loc_estimator.core.compiled import compiled
from swarm_loc_estimator.core.dense_filter import cholesky3
from swarm_loc_estimator.core.fusion import Fusion, Verdict
from swarm_loc_estimator.core.gate import gate_threshold
from swarm_loc_estimator.core.measurements import MEASUREMENT_DTYPE, NOBODY, Kind, MeasurementArray
from swarm_loc_estimator.core.odometry import OdometryTracks
from swarm_loc_estimator.core.parameters import ParameterTable
from swarm_loc_estimator.core.readout import Status, SwarmEstimate, read_out
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.sightings import SightingConverter
from swarm_loc_estimator.core.state import SwarmState
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.core.timeline import Timeline

__all__ = ["Status", "SwarmEstimate", "SwarmEstimator"]

IntArray = NDArray[np.int64]

_FARTHEST_M = 1e6
_LEAST_VARIANCE, _MOST_VARIANCE = 1e-14, 1e14
_ASYMMETRY, _ROUNDING = 1e-6, 1e-9
_FIX_GATE = float(gate_threshold(0.9999))


class SwarmEstimator:
    """Joint, buffered estimation of all poses of a swarm.

    Data may come in any order and late; each counts at its own stamp when it is no older than the
    horizon. All that arrives is used at the next `tick`. Every datum not used has a reason in `drops`.

    Args:
        swarm: Robots and landmarks.
        settings: How to buffer and judge.
    """

    def __init__(self, swarm: Swarm, settings: EstimatorSettings | None = None) -> None:
        self.swarm = swarm
        self.settings = settings or EstimatorSettings()
        self._timeout_s = np.array([robot.odometry.timeout_s for robot in swarm.robots])
        self._tracks = OdometryTracks(swarm.robots)
        self._converter = SightingConverter(swarm)
        self._fusion = Fusion(swarm, self.settings, self._tracks)
        self._parameters = ParameterTable.of(swarm.robots, swarm.landmarks)
        self._reach_ns = self._tracks.reach_ns
        self._timeline = Timeline(
            self.settings, self._fusion.step, SwarmState(self._parameters), self._reach_ns
        )
        self._horizon_ns = round(self.settings.horizon_s * 1e9)
        self._future_ns = round(self.settings.future_tolerance_s * 1e9)
        self._jump_back_ns = round(self.settings.jump_back_s * 1e9)
        self._ingest_drops: Counter[str] = Counter()
        self.time_jumps = 0
        self._begin()

    def _begin(self) -> None:
        self._now_ns: int | None = None
        self._odometry: list[OdometryRows] = []

    def reset(self) -> None:
        """Forget all data and begin anew with the configured starts; the counters go on."""
        self.drop("reset", sum(rows.robot.size for rows in self._odometry) + self._timeline.waiting)
        self._ingest_drops.update(self._timeline_drops())
        self._tracks.clear()
        self._timeline.restart(SwarmState(self._parameters))
        self._begin()

    def receive(self, messages: Messages) -> None:
        """Take in messages; when they show that time has jumped back, begin anew with them."""
        self._check_clock(messages.begin_ns)
        self._check_clock(messages.end_ns)
        self.add(self.screen(messages))

    def screen(self, messages: Messages) -> Arrivals:
        """Turn messages into what can be used of them, and count the rest; nothing is taken in yet."""
        self.drop("bad_message", messages.malformed)
        return Arrivals(self._sound_odometry(messages.odometry), *self._measured(messages.detections))

    def add(self, arrivals: Arrivals) -> None:
        """Take in what has arrived since the last tick, in order of arrival."""
        if arrivals.odometry.robot.size:
            self._odometry.append(arrivals.odometry)
        self._timeline.add(arrivals.measurements)

    def add_fix(self, robot: int, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike, now_ns: int) -> None:
        """Take in an absolute fix: pose (3,) in `map`, heading NaN if not measured, and covariance (3, 3)."""
        fix = self._about(robot, stamp_ns, pose, covariance, Kind.CARTESIAN)
        if np.isnan(fix["value"][0, 2]):
            fix["has_heading"], fix["value"][0, 2] = 0, 0.0
            fix["covariance"][0, 2, :] = fix["covariance"][0, :, 2] = [0.0, 0.0, 1.0]
        self._check_clock(now_ns)
        if self._in_time(fix["stamp_ns"], np.array([now_ns])).all():
            self._timeline.add(fix[self._are_sound(fix)])

    def seat(self, robot: int, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike) -> None:
        """Set a robot to a pose (3,) in `map` with covariance (3, 3), whatever was believed."""
        seat = self._about(robot, stamp_ns, pose, covariance, Kind.SEAT)
        self._timeline.add(seat[self._are_sound(seat)])

    def forget(self, robot: int, stamp_ns: int) -> None:
        """Take a robot out of the estimate; it waits for a fix."""
        self._timeline.add(self._about(robot, stamp_ns, np.zeros(3), np.eye(3), Kind.FORGET))

    def drop(self, reason: str, count: int = 1) -> None:
        """Count data that could not even be handed in."""
        if count:
            self._ingest_drops[reason] += count

    @property
    def drops(self) -> dict[str, int]:
        """Data not used, by reason, since construction."""
        total = self._ingest_drops + Counter(self._timeline_drops())
        return {reason: count for reason, count in sorted(total.items()) if count}

    @property
    def used(self) -> int:
        """Measurements used since the last reset."""
        return int(self._timeline.verdict_counts()[Verdict.USED])

    def recent(self) -> tuple[MeasurementArray, NDArray[np.uint8], FloatArray]:
        """The measurements within the horizon, their verdicts and normalised innovations squared."""
        return self._timeline.measurements, self._timeline.verdicts, self._timeline.nis

    def tick(self, now_ns: int, *, fuse: bool = True) -> SwarmEstimate:
        """Use all that has arrived and give the poses at `now_ns`; measurements wait unless `fuse`."""
        newest_ns = self._check_clock(now_ns)
        oldest_ns = newest_ns - self._horizon_ns
        self._tracks.trim(oldest_ns, oldest_ns - 2 * self._reach_ns)
        if self._odometry:
            self._use_odometry()
        if fuse:
            self._timeline.advance(newest_ns)
        return self._estimate(now_ns)

    def _check_clock(self, now_ns: int) -> int:
        """Begin anew when time has jumped back, as at the loop of a bag; return the newest time since."""
        if self._now_ns is not None and now_ns < self._now_ns - self._jump_back_ns:
            self.reset()
            self.time_jumps += 1
        self._now_ns = now_ns if self._now_ns is None else max(now_ns, self._now_ns)
        return self._now_ns

    def _in_time(self, stamps_ns: IntArray, arrivals_ns: IntArray) -> NDArray[np.bool_]:
        """Whether stamps (k,) are not ahead of the clock at their arrivals (k,)."""
        return self._all_but("future_stamp", stamps_ns > arrivals_ns + self._future_ns)

    def _all_but(self, reason: str, bad: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Count the bad ones (k,) and mark the others."""
        self.drop(reason, int(np.count_nonzero(bad)))
        return ~bad

    def _sound_odometry(self, rows: OdometryRows) -> OdometryRows:
        """The rows with stamps and numbers to reckon with."""
        if not rows.robot.size:
            return rows
        finite = np.isfinite(rows.pose).all(axis=1)
        near = np.abs(rows.pose).max(axis=1) <= _FARTHEST_M
        good = self._in_time(rows.stamp_ns, rows.arrival_ns)
        good &= self._all_but("odometry_non_finite", good & ~finite)
        good &= self._all_but("odometry_absurd", good & ~near)
        return rows if good.all() else rows.chosen(good)

    def _use_odometry(self) -> None:
        rows = OdometryRows.joined(self._odometry)
        self._odometry = []
        change = self._tracks.extend(rows.robot, rows.stamp_ns, rows.pose)
        self.drop("odometry_duplicate", change.duplicates)
        self.drop("odometry_too_old", change.too_old)
        self.drop("odometry_jump", change.jumps)
        self._timeline.invalidate(change.changed_from_ns)

    def _measured(self, rows: DetectionRows) -> tuple[MeasurementArray, IntArray]:
        """What the sound ones of the detections measure (m,), and when it arrived (m,)."""
        if not rows.robot.size:
            return NO_MEASUREMENTS, rows.arrival_ns
        in_time = self._in_time(rows.stamp_ns, rows.arrival_ns)
        rows = rows if in_time.all() else rows.chosen(in_time)
        conversion = self._converter.convert(rows.robot, rows.stamp_ns, rows.detection)
        self._ingest_drops.update(conversion.dropped)
        sound = self._are_sound(conversion.measurements)
        return conversion.measurements[sound], rows.arrival_ns[conversion.measured][sound]

    def _are_sound(self, measurements: MeasurementArray) -> NDArray[np.bool_]:
        """Whether the numbers of measurements (m,) are finite, and their noise is a covariance."""
        value = measurements["value"]
        finite = self._all_but("non_finite", ~np.isfinite(value).all(axis=1))
        good = finite & self._all_but("absurd", finite & (np.abs(value).max(axis=1) > _FARTHEST_M))
        return good & self._all_but("bad_covariance", good & ~_is_covariance(measurements["covariance"]))

    def _about(
        self, robot: int, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike, kind: Kind
    ) -> MeasurementArray:
        """A measurement (1,) without observer."""
        measurement = np.zeros(1, dtype=MEASUREMENT_DTYPE)
        measurement["stamp_ns"], measurement["target"], measurement["kind"] = stamp_ns, robot, kind
        measurement["received_from"] = measurement["observer"] = NOBODY
        measurement["value"], measurement["covariance"] = pose, covariance
        measurement["has_heading"], measurement["gate"] = 1, _FIX_GATE
        return measurement

    def _timeline_drops(self) -> dict[str, int]:
        verdicts = self._timeline.verdict_counts()
        return {
            "gated": int(verdicts[Verdict.GATED]),
            "untied": int(verdicts[Verdict.UNTIED]),
            "duplicate": self._timeline.duplicates,
            "too_old": self._timeline.too_old,
        }

    def _estimate(self, now_ns: int) -> SwarmEstimate:
        state = self._fusion.with_starts(self._timeline.state, now_ns)
        return read_out(state, self._tracks.arrays, self._timeout_s, now_ns)


def _is_covariance(matrices: FloatArray) -> NDArray[np.bool_]:
    """Whether matrices (m, 3, 3) are symmetric, positive definite and of a magnitude to reckon with."""
    sound = np.zeros(matrices.shape[0], dtype=bool)
    _check_covariances(matrices, sound)
    return sound


@compiled
def _check_covariances(matrices: FloatArray, sound: NDArray[np.bool_]) -> None:
    """Write whether each matrix is a covariance."""
    scaled = np.empty((3, 3))
    for k in range(sound.size):
        good = True
        for i in range(3):
            good = good and _LEAST_VARIANCE <= matrices[k, i, i] <= _MOST_VARIANCE
        if not good:
            continue
        for i in range(3):
            for j in range(3):
                scaled[i, j] = matrices[k, i, j] / math.sqrt(matrices[k, i, i] * matrices[k, j, j])
        for i in range(3):
            for j in range(3):
                good = good and abs(scaled[i, j] - scaled[j, i]) < _ASYMMETRY
            scaled[i, i] -= _ROUNDING
        factor = cholesky3(scaled)  # not a number where it has none
        sound[k] = good and math.isfinite(factor[0, 0] + factor[1, 1] + factor[2, 2])
