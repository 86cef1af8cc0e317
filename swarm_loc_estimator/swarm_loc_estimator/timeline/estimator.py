"""Central estimator: poses of a swarm from odometry and sightings, independent of ROS and of any clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from swarm_loc_estimator.filter.measurements import (
    NOBODY,
    Command,
    CommandKind,
    LossReason,
    Measurements,
    Verdict,
    concatenate,
    drops_by_reason,
)
from swarm_loc_estimator.filter.models import CARTESIAN
from swarm_loc_estimator.filter.state import IN_MAP, NEVER_NS
from swarm_loc_estimator.identification.memory import Identities, Outcome
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.fix import about_robots
from swarm_loc_estimator.sensors.imu import TurnRateRows, TurnRateSensor
from swarm_loc_estimator.sensors.inputs import Batch, InputConverter
from swarm_loc_estimator.sensors.lidar import ScanSensor, SweepStore
from swarm_loc_estimator.sensors.map_topic import MapSensor
from swarm_loc_estimator.sensors.odometry import OdometryRows, OdometrySensor
from swarm_loc_estimator.sensors.sensor import REJECT_REASONS, Accumulator, guarded, reject_reasons
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline import local_origin
from swarm_loc_estimator.timeline.estimate import (
    ConstantOdometry,
    Contradiction,
    Estimate,
    LossReport,
    Status,
    TrackedLimits,
    contradictions,
    estimate_at,
    last_loss,
)
from swarm_loc_estimator.timeline.fusion import Fusion
from swarm_loc_estimator.timeline.map_search import placed_map
from swarm_loc_estimator.timeline.self_calibration import learned, learns
from swarm_loc_estimator.timeline.settings import Settings
from swarm_loc_estimator.timeline.sightings import Recent
from swarm_loc_estimator.timeline.timeline import HasBudget, Timeline

__all__ = ["Estimate", "Estimator", "Status", "Step"]

_PARTS = 8  # Into how many parts `receive_in_parts` splits the data of a horizon
_LONG_AGO_NS = np.iinfo(np.int64).min // 2


class Step(NamedTuple):
    """What `Estimator.step` returns."""

    estimate: Estimate  #: Poses of all robots at the instant
    dropped: dict[str, int]  #: Number of readings and measurements that this step did not use, by reason


class Estimator:
    """Joint estimator of all poses of a swarm, with out-of-sequence measurements.

    Data may arrive late and in any order; each is fused at its own stamp unless it is older than the
    horizon. `tick` processes all data received since the last one. `drops` counts unused data by reason.

    Args:
        swarm: Robots and landmarks.
        settings: Horizon, periods and thresholds; defaults if None.

    Raises:
        TypeError: One of them is of another type.
    """

    def __init__(self, swarm: Swarm, settings: Settings | None = None) -> None:
        settings = Settings() if settings is None else settings
        for name, value, expected in (("swarm", swarm, Swarm), ("settings", settings, Settings)):
            if not isinstance(value, expected):
                raise TypeError(f"{name} must be a {expected.__name__}, not {value!r}")
        self.settings = settings.resolved_for(swarm)
        self.time_jumps = 0
        self._drawn: OccupancyMap | None = None  # the newest that came in place of the described one
        self._describe(swarm)

    def _describe(self, swarm: Swarm) -> None:
        """Begin with a description."""
        self.swarm = swarm
        # Poses are estimated about a local origin, which the first fix tells where no description does.
        self._origin = local_origin.described_origin(swarm) if local_origin.is_placed(swarm) else None
        if self._origin is None and self._drawn is not None:
            self._origin = local_origin.local_origin(self._drawn.corner[None])
        self._seen = local_origin.OriginOfFixes() if self._origin is None else None
        swarm = self._local = swarm if self._origin is None else local_origin.about(swarm, self._origin)
        self._limits = TrackedLimits.of(swarm, self.settings)
        self._tracks = OdometryTracks(swarm.robots)
        self._converter = InputConverter(swarm, self.settings)
        self._sweeps = cast(SweepStore, self._converter.accumulators[ScanSensor.name])
        self._fusion = Fusion(swarm, self.settings, self._tracks, self._sweeps.sweeps)
        if self._drawn is not None and self._origin is not None:
            self._fusion.map = placed_map(self._drawn, self._origin)
        self._timeline = Timeline(
            self.settings, self._fusion.step, self._fusion.new_state(), self._tracks.lookback_ns
        )
        self._horizon_ns = round(self.settings.horizon_s * 1e9)
        self._jump_back_ns = round(self.settings.jump_back_s * 1e9)
        self._gathering: dict[str, Accumulator] = {}  # those that have data
        self._begin()

    def _begin(self) -> None:
        self._now_ns: int | None = None
        self._constant = ConstantOdometry(len(self.swarm.robots))
        self._odometry: list[OdometryRows] = []
        self._turn_rates: list[TurnRateRows] = []

    def describe(self, swarm: Swarm) -> None:
        """Restart with another description of the same robots; the total of `drops` is kept."""
        drops = self.drops
        self._describe(swarm)
        self._converter.drops.total.update(drops)

    def reset(self) -> None:
        """Discard all data and restart at the configured starts; counters in `drops` are kept."""
        waiting = sum(rows.robot.size for rows in self._odometry)
        waiting += sum(rows.robot.size for rows in self._turn_rates)
        self.drop("reset", waiting + self._timeline.waiting)
        self._converter.drops.total.update(self._timeline_drops())
        self._tracks.clear()
        self._timeline.restart(self._fusion.new_state())
        for accumulator in self._converter.accumulators.values():
            accumulator.restart()
        self._begin()

    @property
    def hint(self) -> str:
        """Hint about the choice of filter for this swarm, one sentence; "" if there is none."""
        count, largest = len(self.swarm.robots), self.settings.sparse_from
        if count < largest or self._fusion.is_sparse:
            return ""
        return (
            f"{count} robots are estimated with a full covariance, which grows with the cube of their number,"
            f" because fusion_period_s is 0; otherwise {largest} robots and more (sparse_from) would take a"
            " sparse one."
        )

    def convert(self, batch: Batch) -> Batch:
        """Convert readings to measurements for `receive`; invalid ones are counted in `drops`."""
        if self._seen is not None and any(name in batch.rows for name in local_origin.PLACING):
            moved = self._seen.moved(batch.rows, self._origin)
            if moved is not None and self._origin is not None:
                self.reset()  # it was that of a source whose fixes are far from all others
            self._origin = self._origin if moved is None else moved
        if self._origin is not None and self._origin.any():
            batch = replace(batch, rows=local_origin.readings_about(batch.rows, self._origin))
        return self._converter.convert(batch)

    def receive(self, inputs: Batch) -> None:
        """Add new data; reset first if their arrival times show that the clock jumped back."""
        self._check_clock(inputs.begin_ns)
        self._check_clock(inputs.end_ns)
        arrivals = inputs if inputs.is_converted else self.convert(inputs)
        for name, rows in arrivals.rows.items():
            if isinstance(rows, Measurements):
                self._timeline.add(rows)
            elif not rows.robot.size:
                continue
            elif name == OdometrySensor.name:
                self._odometry.append(rows)
            elif name == TurnRateSensor.name:
                self._turn_rates.append(rows)
            elif name == MapSensor.name:
                for arrival_ns, drawn in zip(rows.arrival_ns.tolist(), rows.map, strict=True):
                    self.use_map(arrival_ns, drawn)
            else:
                accumulator = self._gathering[name] = self._converter.accumulators[name]
                with guarded(name, rows.robot.size, self._converter.drops.total):
                    change = accumulator.take(rows)
                    self._timeline.add(change.added)
                    self._timeline.withdraw(change.withdrawn)

    def receive_in_parts(self, inputs: Batch) -> None:
        """Add new data of any time span, with ticks in between, so that nothing becomes too old in it."""
        part_ns = self._horizon_ns // _PARTS
        if inputs.end_ns - inputs.begin_ns <= part_ns:
            self.receive(inputs)
            return
        arrivals_ns = np.concatenate([[inputs.end_ns], *(one.arrival_ns for one in inputs.rows.values())])
        begins_ns = inputs.begin_ns + (arrivals_ns - inputs.begin_ns) // part_ns * part_ns
        pauses_ns = np.unique([begins_ns, begins_ns + part_ns])
        between = (inputs.begin_ns < pauses_ns) & (pauses_ns < inputs.end_ns)
        *parts, last = inputs.until_each(pauses_ns[between])
        for part in parts:
            self.receive(part)
            self.tick(part.end_ns)
        self.receive(last)

    def set_pose(self, robot: int, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike) -> str:
        """Set a robot to a pose (3,) in `map` with covariance (3, 3); its estimate is replaced.

        Returns:
            "" on success, else a reason of `drops`, such as "not_localized" before its first odometry.
        """
        self._use_odometry()
        poses = np.array([pose], dtype=float)
        if self._origin is None:
            self._origin = local_origin.local_origin(poses[:, :2])
        poses[:, :2] -= self._origin
        fix = about_robots(robot, stamp_ns, poses, np.array([covariance]), CARTESIAN)
        fault = REJECT_REASONS[reject_reasons(fix)[0]] or (
            "" if self._tracks.has_started(robot, stamp_ns) else "not_localized"
        )
        if fault:
            self.drop(fault)
        else:
            command = Command(stamp_ns, CommandKind.SET_POSE, robot, fix.value[0], fix.covariance[0])
            self._timeline.command(command)
            self._constant.forget(robot)
        return fault

    def use_map(self, stamp_ns: int, drawn: OccupancyMap) -> None:
        """Replace the map of lidars from an instant on; located robots stay, others are searched in it.

        Raises MapFileError if it has no walls, or no free space.
        """
        if self._origin is None:
            self._origin = local_origin.local_origin(drawn.corner[None])
        self._seen, self._drawn = None, drawn  # from now on the map tells the origin
        self._fusion.map = placed_map(drawn, self._origin)
        nobody = Command(stamp_ns, CommandKind.NEW_MAP, NOBODY, np.zeros(3), np.eye(3), self._fusion.map)
        self._timeline.command(nobody)

    def forget(self, robot: int, stamp_ns: int) -> None:
        """Remove a robot from the estimate until a fix initializes it."""
        self._timeline.command(Command(stamp_ns, CommandKind.FORGET, robot, np.zeros(3), np.eye(3)))

    def drop(self, reason: str, count: int = 1) -> None:
        """Count data that were dropped before they reached the estimator."""
        if count:
            self._converter.drops.total[reason] += count

    @property
    def drops(self) -> dict[str, int]:
        """Number of unused data by reason, since construction."""
        total = self._converter.drops.total + Counter(self._timeline_drops())
        for accumulator in self._converter.accumulators.values():
            total += accumulator.drops
        return {reason: count for reason, count in sorted(total.items()) if count}

    def drops_of(self, robot: int) -> Mapping[str, int]:
        """Numbers of a robot's or fixed camera's dropped data by reason, where they are known as its own."""
        return self._converter.drops.of_robot[robot]

    @property
    def used(self) -> int:
        """Number of measurements used since the last reset."""
        return int(self._timeline.verdict_counts()[Verdict.USED])

    @property
    def counters(self) -> dict[str, int]:
        """Numbers of used data by name, and of losses of robots by reason, since the last reset."""
        others = {"constraints kept": int(self._timeline.verdict_counts()[Verdict.CONSTRAINT])}
        for accumulator in self._converter.accumulators.values():
            others |= accumulator.counters
        if images := self._timeline.state.images:
            names = {one: one.name.lower().replace("_", " ") for one in Outcome}
            others |= {f"identities {names[one]}": int(images.outcomes[one]) for one in Outcome}
        losses = self._timeline.state.losses
        others |= {f"lost: {why.name.lower().replace('_', ' ')}": int(losses[why]) for why in LossReason}
        return {"measurements used": self.used} | {name: count for name, count in others.items() if count}

    def recent(self) -> Recent:
        """Measurements within the horizon, with verdicts and NIS."""
        buffer = self._timeline.buffer
        return Recent(buffer.part(0, len(buffer)), buffer.verdicts, buffer.nis)

    @property
    def identities(self) -> Identities | None:
        """Identities in the newest aerial image; None before the first image."""
        images = self._timeline.state.images
        return images.newest if images else None

    def contradictions(self, now_ns: int) -> list[Contradiction]:
        """Contradicted robots and landmarks at an instant, robots first."""
        unmoved = self._constant.contradicted(now_ns)
        return contradictions(
            self.swarm, self._timeline.state, self._tracks, unmoved, self.settings.max_fault_score, now_ns
        )

    @property
    def losses(self) -> list[LossReport]:
        """The last loss of each robot that was lost since the last reset, located again or not."""
        state = self._timeline.state
        found = (last_loss(state, robot, self.settings) for robot in np.flatnonzero(state.lost_why).tolist())
        return [one for one in found if one is not None]

    def loss_of(self, robot: int) -> LossReport | None:
        """Why a robot was lost that is not located now; None for a located one, and without a loss."""
        state = self._timeline.state
        return None if state.tracked[robot] else last_loss(state, robot, self.settings)

    @property
    def is_self_calibrated(self) -> bool:
        """Whether parameters are estimated: described with a standard deviation, or contradicted."""
        return learns(self.swarm) or bool((self._timeline.state.contradicted_ns > NEVER_NS).any())

    def learned(self) -> Swarm:
        """Swarm with the estimated parameters of cameras, odometry and landmarks."""
        found = learned(self._local, self._timeline.state)
        return found if self._origin is None else local_origin.about(found, -self._origin)

    @property
    def origin(self) -> str:
        """Robot whose pose was the origin when a local frame began; "" if poses are in `map`."""
        origin = self._timeline.state.origin
        return "" if origin == IN_MAP else self.swarm.robots[origin].name

    @property
    def frame_moves(self) -> int:
        """How often all poses have moved from a local frame to `map` since the last reset."""
        return self._timeline.state.frame_moves

    @property
    def is_fusing(self) -> bool:
        """Whether the last `tick` ran out of budget before all its measurements were fused."""
        return self._timeline.is_busy

    def tick(self, now_ns: int, *, fuse: bool = True, has_budget: HasBudget = lambda: True) -> Estimate:
        """Process the received data and return the poses at `now_ns`; without `fuse`, odometry only.

        Fusion stops when `has_budget` returns False and continues at the next tick. Until then poses are
        predicted by odometry from the last complete state.
        """
        newest_ns = self._check_clock(now_ns)
        oldest_ns = newest_ns - self._horizon_ns
        self._tracks.trim(oldest_ns, self._timeline.oldest_due_ns(oldest_ns) - 2 * self._tracks.lookback_ns)
        self._use_odometry()
        if fuse:
            self._timeline.advance(newest_ns, has_budget)
            needed_ns = min([oldest_ns, *self._timeline.buffer.stamp_ns[:1].tolist()])
            for accumulator in self._gathering.values():
                accumulator.forget_before(needed_ns if accumulator is self._sweeps else oldest_ns)
        return self._estimate(now_ns)

    def step(
        self, now_s: float | None = None, *, now_ns: int | None = None, **readings: Mapping[str, Any]
    ) -> Step:
        """Take readings as columns and return the estimate at an instant, for scripts and notebooks.

        Readings may be of any time span: they are received and fused part by part, in order of their
        arrival, as live. Those without `arrival_ns` arrive at their stamps, but late ones at the last step.

        Args:
            now_s: The instant [s].
            now_ns: The same in nanoseconds; one of both must be given.
            readings: Columns by the names of sensors: `robot` (k,) names or indices, or one for all;
                `stamp_s` [s] or `stamp_ns` (k,); and the columns of the sensor, such as
                `odometry={"robot": "r1", "stamp_s": [0.0, 0.1], "pose": [[0, 0, 0], [0.02, 0, 0]]}`.

        Raises:
            TypeError: Not one instant is given, or a sensor, robot or column is wrong; it says which.
        """
        if (now_s is None) == (now_ns is None):
            raise TypeError("step needs either now_s or now_ns")
        if now_s is not None and not np.isfinite(now_s):
            raise TypeError(f"now_s must be finite, not {now_s}")
        end_ns = round(1e9 * now_s) if now_s is not None else int(now_ns or 0)
        # Readings of a new clock, or before the first step, arrive at their stamps however old they are.
        begin_ns = _LONG_AGO_NS
        if self._now_ns is not None and end_ns >= self._now_ns - self._jump_back_ns:
            begin_ns = min(self._now_ns, end_ns)
        before = Counter(self.drops)
        batch = self.convert(Batch.of_columns(self.swarm, begin_ns, end_ns, readings))
        self.receive_in_parts(batch)
        return Step(self.tick(end_ns), dict(Counter(self.drops) - before))

    def _check_clock(self, now_ns: int) -> int:
        """Reset if the clock jumped back, as when a bag loops; return the newest time since the reset."""
        if self._now_ns is not None and now_ns < self._now_ns - self._jump_back_ns:
            self.reset()
            self.time_jumps += 1
        self._now_ns = now_ns if self._now_ns is None else max(now_ns, self._now_ns)
        return self._now_ns

    def _use_odometry(self) -> None:
        if self._turn_rates:  # first, so that they are known when the steps are integrated
            rates, self._turn_rates = concatenate(self._turn_rates), []
            change = self._tracks.extend_turns(rates.robot, rates.stamp_ns, rates.rate)
            self.drop("imu_duplicate", change.duplicates)
            self._converter.drops.add("imu_too_old", change.too_old)
            self._timeline.invalidate(change.changed_from_ns)
        if not self._odometry:
            return
        rows, self._odometry = concatenate(self._odometry), []
        change = self._tracks.extend(rows.robot, rows.stamp_ns, rows.pose, rows.twist)
        self.drop("odometry_duplicate", change.duplicates)
        self._converter.drops.add("odometry_too_old", change.too_old)
        self.drop("odometry_jump", change.jumps)
        self.drop("odometry_reset", change.resets)
        self._timeline.invalidate(change.changed_from_ns)

    def _timeline_drops(self) -> dict[str, int]:
        return {
            **drops_by_reason(self._timeline.verdict_counts()),
            "duplicate": self._timeline.duplicates,
            "too_old": self._timeline.too_old,
        }

    def _estimate(self, now_ns: int) -> Estimate:
        state = self._fusion.starts.with_starts(self._timeline.state, now_ns)
        estimate = estimate_at(state, self._tracks.arrays, self._limits, now_ns)
        self._constant.add(self._tracks.is_constant(), estimate)
        contradicted = self._constant.contradicted(now_ns) & (estimate.status == Status.TRACKED)
        estimate.status[contradicted] = Status.CONTRADICTED
        if self._origin is not None and state.origin == IN_MAP:
            estimate.poses[:, :2] += self._origin
            estimate.map_to_odom[:, :2] += self._origin
        return estimate
