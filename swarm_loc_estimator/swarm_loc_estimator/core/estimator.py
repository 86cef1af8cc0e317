"""The central estimator: odometry and sightings of a swarm in, poses out; no ROS, no clock of its own."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.core.arrivals import Arrivals, Messages, OdometryRows, joined
from swarm_loc_estimator.core.brightness_sightings import BrightnessConverter
from swarm_loc_estimator.core.fusion import Fusion, Verdict
from swarm_loc_estimator.core.learned import learned
from swarm_loc_estimator.core.measurements import Kind, MeasurementArray
from swarm_loc_estimator.core.odometry import OdometryTracks
from swarm_loc_estimator.core.readout import Status, SwarmEstimate, read_out
from swarm_loc_estimator.core.screening import FAULTS, Screening, about_robots, faults_of
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.core.timeline import Timeline

__all__ = ["Status", "SwarmEstimate", "SwarmEstimator"]


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
        self._screening = Screening(swarm, self.settings)
        self._brightness = BrightnessConverter(swarm)
        self._fusion = Fusion(swarm, self.settings, self._tracks)
        self._reach_ns = self._tracks.reach_ns + round(0.5e9 * self.settings.state_period_s)
        self._timeline = Timeline(self.settings, self._fusion.step, self._fusion.new_state(), self._reach_ns)
        self._horizon_ns = round(self.settings.horizon_s * 1e9)
        self._jump_back_ns = round(self.settings.jump_back_s * 1e9)
        self.time_jumps = 0
        self._begin()

    def _begin(self) -> None:
        self._now_ns: int | None = None
        self._odometry: list[OdometryRows] = []

    def reset(self) -> None:
        """Forget all data and begin anew with the configured starts; the counters go on."""
        self.drop("reset", sum(rows.robot.size for rows in self._odometry) + self._timeline.waiting)
        self._screening.drops.update(self._timeline_drops())
        self._tracks.clear()
        self._timeline.restart(self._fusion.new_state())
        self._brightness.restart()
        self._begin()

    def receive(self, messages: Messages) -> None:
        """Take in messages; when they show that time has jumped back, begin anew with them."""
        self._check_clock(messages.begin_ns)
        self._check_clock(messages.end_ns)
        self.add(self.screen(messages))

    def screen(self, messages: Messages) -> Arrivals:
        """Turn messages into what can be used of them, and count the rest; nothing is taken in yet."""
        return self._screening.screen(messages)

    def add(self, arrivals: Arrivals) -> None:
        """Take in what has arrived since the last tick, in order of arrival."""
        if arrivals.odometry.robot.size:
            self._odometry.append(arrivals.odometry)
        self._timeline.add(arrivals.measurements)
        if arrivals.brightness.robot.size:
            change = self._brightness.take(arrivals.brightness)
            self._timeline.add(change.added)
            self._timeline.withdraw(change.withdrawn)

    def seat(self, robot: int, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike) -> str:
        """Set a robot to a pose (3,) in `map` with covariance (3, 3), whatever was believed.

        Returns:
            Why that cannot be, a reason of `drops`: "untied" before its odometry; "" when it is done.
        """
        if self._odometry:
            self._use_odometry()
        seat = about_robots(robot, stamp_ns, np.array([pose]), np.array([covariance]), Kind.SEAT)
        fault = FAULTS[faults_of(seat)[0]] or ("" if self._tracks.begun(robot, stamp_ns) else "untied")
        if fault:
            self.drop(fault)
        else:
            self._timeline.add(seat)
        return fault

    def forget(self, robot: int, stamp_ns: int) -> None:
        """Take a robot out of the estimate; it waits for a fix."""
        self._timeline.add(about_robots(robot, stamp_ns, np.zeros((1, 3)), np.eye(3)[None], Kind.FORGET))

    def drop(self, reason: str, count: int = 1) -> None:
        """Count data that could not even be handed in."""
        if count:
            self._screening.drops[reason] += count

    @property
    def drops(self) -> dict[str, int]:
        """Data not used, by reason, since construction."""
        total = self._screening.drops + self._brightness.drops + Counter(self._timeline_drops())
        return {reason: count for reason, count in sorted(total.items()) if count}

    @property
    def used(self) -> int:
        """Measurements used since the last reset."""
        return int(self._timeline.verdict_counts()[Verdict.USED])

    @property
    def counters(self) -> dict[str, int]:
        """What was used since the last reset, by name."""
        others = {
            "clues kept": int(self._timeline.verdict_counts()[Verdict.CLUE]),
            "infrared exchanges measured": self._brightness.measured,
        }
        return {"measurements used": self.used} | {name: count for name, count in others.items() if count}

    def recent(self) -> tuple[MeasurementArray, NDArray[np.uint8], FloatArray]:
        """The measurements within the horizon, their verdicts and normalised innovations squared."""
        return self._timeline.measurements, self._timeline.verdicts, self._timeline.nis

    def learned(self) -> Swarm:
        """The swarm with cameras, odometry and landmarks as they are now estimated; see `core/learned.py`."""
        return learned(self.swarm, self._timeline.state)

    def tick(self, now_ns: int, *, fuse: bool = True) -> SwarmEstimate:
        """Use all that has arrived and give the poses at `now_ns`; measurements wait unless `fuse`."""
        newest_ns = self._check_clock(now_ns)
        oldest_ns = newest_ns - self._horizon_ns
        self._tracks.trim(oldest_ns, oldest_ns - 2 * self._reach_ns)
        if self._odometry:
            self._use_odometry()
        if fuse:
            self._timeline.advance(newest_ns)
            self._brightness.forget_before(oldest_ns)
        return self._estimate(now_ns)

    def _check_clock(self, now_ns: int) -> int:
        """Begin anew when time has jumped back, as at the loop of a bag; return the newest time since."""
        if self._now_ns is not None and now_ns < self._now_ns - self._jump_back_ns:
            self.reset()
            self.time_jumps += 1
        self._now_ns = now_ns if self._now_ns is None else max(now_ns, self._now_ns)
        return self._now_ns

    def _use_odometry(self) -> None:
        rows = joined(self._odometry)
        self._odometry = []
        change = self._tracks.extend(rows.robot, rows.stamp_ns, rows.pose)
        self.drop("odometry_duplicate", change.duplicates)
        self.drop("odometry_too_old", change.too_old)
        self.drop("odometry_jump", change.jumps)
        self._timeline.invalidate(change.changed_from_ns)

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
