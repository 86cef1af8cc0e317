"""The central estimator: odometry and sightings of a swarm in, poses out; no ROS, no clock of its own."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.core.compiled import compiled
from swarm_loc_estimator.core.dense_filter import cholesky3
from swarm_loc_estimator.core.fusion import Fusion, Verdict
from swarm_loc_estimator.core.gate import gate_threshold
from swarm_loc_estimator.core.measurements import MEASUREMENT_DTYPE, NOBODY, Kind, MeasurementArray
from swarm_loc_estimator.core.odometry import OdometryTracks
from swarm_loc_estimator.core.readout import Status, SwarmEstimate, read_out
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.sightings import SightingConverter
from swarm_loc_estimator.core.state import SwarmState
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.core.timeline import Timeline

__all__ = ["Status", "SwarmEstimate", "SwarmEstimator"]

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
        self._timeline = Timeline(
            self.settings, self._fusion.step, SwarmState(len(swarm.robots)), self._tracks.reach_ns
        )
        self._horizon_ns = round(self.settings.horizon_s * 1e9)
        self._future_ns = round(self.settings.future_tolerance_s * 1e9)
        self._jump_back_ns = round(self.settings.jump_back_s * 1e9)
        self._ingest_drops: Counter[str] = Counter()
        self.time_jumps = 0
        self._begin()

    def _begin(self) -> None:
        self._now_ns: int | None = None
        self._odometry: list[tuple[int, int, float, float, float]] = []
        self._detections: list[tuple[int, int, NDArray[np.void]]] = []

    def reset(self) -> None:
        """Forget all data and begin anew with the configured starts; the counters go on."""
        self.drop("reset", len(self._odometry) + sum(d.size for _, _, d in self._detections))
        self.drop("reset", self._timeline.waiting)
        self._ingest_drops.update(self._timeline_drops())
        self._tracks.clear()
        self._timeline.restart(SwarmState(len(self.swarm.robots)))
        self._begin()

    def add_odometry(self, robot: int, stamp_ns: int, pose: tuple[float, float, float], now_ns: int) -> None:
        """Take in one odometry message: the robot's pose (x [m], y [m], yaw [rad]) in its own odom frame."""
        if self._in_time(stamp_ns, now_ns):
            self._odometry.append((robot, stamp_ns, *pose))

    def add_detections(self, robot: int, stamp_ns: int, detections: NDArray[np.void], now_ns: int) -> None:
        """Take in what a robot's camera saw in one picture.

        Args:
            robot: Index of the robot that carries the camera.
            stamp_ns: Exposure time.
            detections: (d,) structured, see `SightingConverter.convert`.
            now_ns: Time of arrival.
        """
        if detections.size and self._in_time(stamp_ns, now_ns, detections.size):
            self._detections.append((robot, stamp_ns, detections))

    def add_fix(self, robot: int, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike, now_ns: int) -> None:
        """Take in an absolute fix: pose (3,) in `map`, heading NaN if not measured, and covariance (3, 3)."""
        fix = self._about(robot, stamp_ns, pose, covariance, Kind.CARTESIAN)
        if np.isnan(fix["value"][0, 2]):
            fix["has_heading"], fix["value"][0, 2] = 0, 0.0
            fix["covariance"][0, 2, :] = fix["covariance"][0, :, 2] = [0.0, 0.0, 1.0]
        if self._in_time(stamp_ns, now_ns):
            self._add_measurements(fix)

    def seat(self, robot: int, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike) -> None:
        """Set a robot to a pose (3,) in `map` with covariance (3, 3), whatever was believed."""
        self._add_measurements(self._about(robot, stamp_ns, pose, covariance, Kind.SEAT))

    def forget(self, robot: int, stamp_ns: int) -> None:
        """Take a robot out of the estimate; it waits for a fix."""
        self._timeline.add(self._about(robot, stamp_ns, np.zeros(3), np.eye(3), Kind.FORGET))

    def drop(self, reason: str, count: int = 1) -> None:
        """Count data that could not even be handed in."""
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
        self._tracks.trim(oldest_ns, oldest_ns - 2 * self._tracks.reach_ns)
        self._use_odometry()
        if fuse:
            self._use_detections()
            self._timeline.advance(newest_ns)
        return self._estimate(now_ns)

    def _check_clock(self, now_ns: int) -> int:
        """Begin anew when time has jumped back, as at the loop of a bag; return the newest time since."""
        if self._now_ns is not None and now_ns < self._now_ns - self._jump_back_ns:
            self.reset()
            self.time_jumps += 1
        self._now_ns = now_ns if self._now_ns is None else max(now_ns, self._now_ns)
        return self._now_ns

    def _in_time(self, stamp_ns: int, now_ns: int, count: int = 1) -> bool:
        self._check_clock(now_ns)
        if stamp_ns > now_ns + self._future_ns:
            self.drop("future_stamp", count)
            return False
        return True

    def _use_odometry(self) -> None:
        if not self._odometry:
            return
        robots = np.array([row[0] for row in self._odometry], dtype=np.int64)
        stamps = np.array([row[1] for row in self._odometry], dtype=np.int64)
        raw = np.array([row[2:] for row in self._odometry])
        self._odometry = []
        finite = np.isfinite(raw).all(axis=1)
        near = finite & (np.abs(np.where(finite[:, None], raw, 0.0)).max(axis=1) <= _FARTHEST_M)
        self.drop("odometry_non_finite", int(np.sum(~finite)))
        self.drop("odometry_absurd", int(np.sum(finite & ~near)))
        change = self._tracks.extend(robots[near], stamps[near], raw[near])
        self.drop("odometry_duplicate", change.duplicates)
        self.drop("odometry_too_old", change.too_old)
        self.drop("odometry_jump", change.jumps)
        self._timeline.invalidate(change.changed_from_ns)

    def _use_detections(self) -> None:
        if not self._detections:
            return
        counts = [detections.size for _, _, detections in self._detections]
        robots = np.repeat([robot for robot, _, _ in self._detections], counts)
        stamps = np.repeat([stamp for _, stamp, _ in self._detections], counts)
        joined = b"".join(
            d.tobytes() for _, _, d in self._detections
        )  # concatenating structured arrays is slow
        detections = np.frombuffer(joined, dtype=self._detections[0][2].dtype)
        conversion = self._converter.convert(robots, stamps, detections)
        self._detections = []
        self._ingest_drops.update(conversion.dropped)
        self._add_measurements(conversion.measurements)

    def _add_measurements(self, measurements: MeasurementArray) -> None:
        """Hand measurements on whose numbers are finite and whose noise is a covariance."""
        value = measurements["value"]
        finite = np.isfinite(value).all(axis=1)
        near = finite & (np.abs(np.nan_to_num(value)).max(axis=1) <= _FARTHEST_M)
        sound = _is_covariance(measurements["covariance"])
        self.drop("non_finite", int(np.sum(~finite)))
        self.drop("absurd", int(np.sum(finite & ~near)))
        self.drop("bad_covariance", int(np.sum(near & ~sound)))
        self._timeline.add(measurements[near & sound])

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
