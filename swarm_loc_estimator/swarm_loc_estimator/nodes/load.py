"""Limit the load of a live estimator: fuse less often, then drop a share of the measurements. No ROS here.

Under overload, measurements are dropped uniformly over all robots and pairs. Each source (a robot's camera,
infrared board or fixes, an overhead camera) has the same maximum number of used measurements, so those that
send most lose first (max-min fairness; D. Bertsekas, R. Gallager: Data Networks, 6.5.2). Measurement k of a
source is used if the fractional part of k times the golden ratio is below the share: a sequence uniform over
any interval and over every n-th number (H. Weyl: Ueber die Gleichverteilung von Zahlen mod. Eins, 1916), so
robots that send detections in one order do not lose the same neighbour each time. The cost of fusing a period
of a large swarm hardly depends on their number: whole periods are used or dropped, by the same rule.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.sensors.inputs import SENSORS, Batch
from swarm_loc_estimator.sensors.sensor import Sensor
from swarm_loc_estimator.timeline.timeline import end_of_period

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # Fractional part of the golden ratio in units of 2^-64
_SILVER = np.uint64(0x6A09E667F3BCC909)
"""Fractional part of the square root of two: offset between sources, so that their drops alternate."""

_WHOLE = 2.0**64

SHED_REASONS = frozenset(f"shed_{sensor.name}" for sensor in SENSORS.values() if sensor.unit is not None)
"""Reasons in `drops` for readings dropped by thinning, one per sensor."""


class Thinned(NamedTuple):
    """Result of thinning."""

    messages: Batch  # The remaining readings; `dropped` includes the readings dropped here
    # Number of measurements before by sensor: detections, fixes, infrared exchanges, aerial images
    measurements: Mapping[str, int]
    shed: int  # Number of dropped measurements


class Thinning:
    """Thins out measurements, but never odometry, which all predictions need.

    The result is deterministic. All matrices of an infrared exchange are used or none, and all detections of
    an aerial image or none: a partial image would imply missing robots. `period_ns` is the fusion period of a
    large swarm, to drop whole periods; 0: measurements are dropped per source.
    """

    def __init__(self, robots: int, period_ns: int = 0) -> None:
        self._period_ns = period_ns
        self._sources_of_kind = robots + 1  # the last one is the swarm, index -1
        self._sensors = [sensor for sensor in SENSORS.values() if sensor.unit is not None]
        self._number = np.zeros(len(self._sensors) * self._sources_of_kind, dtype=np.uint64)
        self._exchanges: dict[tuple[int, ...], bool] = {}

    def thin(self, messages: Batch, share: float) -> Thinned:
        """Keep a share of all measurements, in (0, 1]."""
        units = [_units(sensor, messages[sensor.name]) for sensor in self._sensors]
        count = self._sources_of_kind
        if self._period_ns:  # by the periods of stamps
            stamps_ns = np.concatenate([one.stamp_ns for one in units])
            number = (end_of_period(stamps_ns, self._period_ns) // self._period_ns).astype(np.uint64)
            used = ((number * _GOLDEN).astype(np.float64) / _WHOLE < share) | (share >= 1.0)
        else:
            sources = [k * count + one.robot % count for k, one in enumerate(units)]
            used = self._used(np.concatenate(sources), share)
        rows, shed = dict(messages.rows), dict[str, int]()
        ends = np.cumsum([one.robot.size for one in units])
        for sensor, one, mine in zip(self._sensors, units, np.split(used, ends[:-1]), strict=True):
            for k, exchange in enumerate(one.exchange):  # one that continues is used or not as before
                mine[k] = self._exchanges.get(exchange, mine[k])
            if one.exchange:
                self._exchanges = dict(zip(one.exchange, mine.tolist(), strict=True))
            if not mine.all():
                rows[sensor.name] = select(messages[sensor.name], mine[one.of_row])
                shed[f"shed_{sensor.name}"] = int(np.sum(~mine))
        left = replace(messages, rows=rows, dropped={**messages.dropped, **shed})
        measurements = {sensor.name: one.robot.size for sensor, one in zip(self._sensors, units, strict=True)}
        return Thinned(left, measurements, sum(shed.values()))

    def _used(self, source: IntArray, share: float) -> BoolArray:
        """Select measurements (u,) by their sources (u,)."""
        count = np.bincount(source, minlength=self._number.size)
        order = np.argsort(source, kind="stable")
        first = np.cumsum(count) - count
        number = np.empty(source.size, dtype=np.uint64)
        number[order] = np.arange(source.size) - first[source[order]]
        number += self._number[source]
        self._number += count.astype(np.uint64)
        if share >= 1.0:
            return np.ones(source.size, dtype=np.bool_)
        share_of = np.minimum(1.0, water_level(count, share * source.size) / np.maximum(count, 1))
        fraction = (number * _GOLDEN + source.astype(np.uint64) * _SILVER).astype(np.float64) / _WHOLE
        return np.asarray(fraction < share_of[source])


def water_level(count: IntArray, total: float) -> float:
    """Maximum number per source such that all sources together use `total` of counts (s,)."""
    ascending = np.sort(count)
    left = total - (np.cumsum(ascending) - ascending)  # total left for this source and all larger ones
    level = left / np.arange(count.size, 0, -1)
    above = np.flatnonzero(ascending >= level)
    return float(level[above[0]]) if above.size else float(np.inf)


class _Units(NamedTuple):
    """Groups (u,) of readings that are used or dropped as a whole."""

    robot: IntArray  # (u,) robot index
    stamp_ns: IntArray  # (u,) time of measurement
    of_row: IntArray  # (k,) group of each row
    exchange: Sequence[tuple[int, ...]] = ()  # Robot, stamp and transmitter of each group of infrared


def _units(sensor: type[Sensor], rows: Any) -> _Units:
    """Group a sensor's readings by the columns `unit`; without these, each row is a group."""
    if not sensor.unit:
        return _Units(rows.robot, rows.stamp_ns, np.arange(rows.robot.size))
    keys = np.column_stack([getattr(rows, name) for name in sensor.unit])
    found, of_row = np.unique(keys, axis=0, return_inverse=True)
    exchanges = [tuple(key) for key in found.tolist()] if sensor.keeps_units else []
    robot, stamp_ns = (found[:, sensor.unit.index(name)] for name in ("robot", "stamp_ns"))
    return _Units(robot, stamp_ns, of_row.reshape(-1), exchanges)


# Checked by test_fusion_period.py, and on live swarms by make bench-large_swarms.
MIN_SHARE = 0.01  # However busy the node is: without any measurements, robots would be lost for good
_WINDOW_S = 0.5  # Least time over which the load is measured, since fusing comes in bursts
_BUSY = 0.9  # Load above which a node may not keep up
_MAX_WAIT = 0.5  # Share of the horizon; data that wait longer to be fused would soon be too old
_AT_EASE = 0.6  # Load below which the share grows. Between the two limits it stays.
_SMOOTHING = 0.2  # Smoothing factor of the time that fusing takes, an average over about five windows
_AIM = 0.75  # Load to which a cut leads
_MIN_CUT, _MAX_CUT = 0.5, 0.125  # Limits of the factor by which the share is cut per window
_GROWTH = 1.3  # Of the share per window at low load; too small to lead from one limit past the other
_LONGEST_WAIT = 0.25  # Share of the horizon that data may wait to be fused


class Shedding:
    """Cuts the share of measurements used while fusing cannot keep up, and lets it grow again.

    A node that catches up again, as at its start, drops nothing. Where fusing takes no more than its share of
    a core, `fusion_load`, the share is not cut further; where it takes less than half of it, the share grows.
    """

    def __init__(self, fusion_load: float, horizon_s: float) -> None:
        self.share = 1.0  # Share of the measurements to use, in [MIN_SHARE, 1]
        self._fusion_load = fusion_load
        self._max_wait_s = _MAX_WAIT * horizon_s
        self._ticked_s: float | None = None
        self._fusing_load = fusion_load
        self._may_cut = True
        self._begin_s = self._handled_s = self._busy_s = self._fusing_s = 0.0

    def begin_tick(self, wall_s: float, waited_s: float) -> None:
        """Begin a tick at a steady time [s]; data have waited for at most `waited_s` to be fused."""
        if self._ticked_s is None:
            self._ticked_s = self._begin_s = wall_s
        elapsed_s = wall_s - self._begin_s
        if elapsed_s >= _WINDOW_S:
            load, fusing_load = self._busy_s / elapsed_s, self._fusing_s / elapsed_s
            is_late = load >= _BUSY and waited_s >= self._max_wait_s
            self._fusing_load += _SMOOTHING * (fusing_load - self._fusing_load)
            if load < _AT_EASE or self._fusing_load < 0.5 * self._fusion_load:
                self.share = min(1.0, _GROWTH * self.share)
            elif is_late and self._may_cut and fusing_load > self._fusion_load:
                self._may_cut = False
                cut = _AIM * self._handled_s / self._busy_s  # longer ticks are an overload
                self.share = max(MIN_SHARE, self.share * min(max(cut, _MAX_CUT), _MIN_CUT))
            self._begin_s, self._handled_s, self._busy_s, self._fusing_s = wall_s, 0.0, 0.0, 0.0
        self._handled_s += wall_s - self._ticked_s  # it handles what was received since the previous one
        self._ticked_s = wall_s

    def begin_fusion(self) -> None:
        """Begin fusing; from now on the effect of the previous cut is known."""
        self._may_cut = True

    def note(self, busy_s: float, fusing_s: float = 0.0) -> None:
        """Add time for which the node was busy, and for which it was fusing."""
        self._busy_s += busy_s
        self._fusing_s += fusing_s


class FusionPace:
    """Limits fusing to a share `load` of a core, unless data would grow too old for `horizon_s` meanwhile."""

    def __init__(self, load: float, horizon_s: float) -> None:
        self._load = load
        self._longest_ns = round(_LONGEST_WAIT * horizon_s * 1e9)
        self._rested_s = 0.0
        self._fused_ns: int | None = None

    def is_due(self, wall_s: float, now_ns: int) -> bool:
        """Whether to fuse now, by a steady clock (`wall_s`) and the node's time, that of the data."""
        if wall_s >= self._rested_s or self._fused_ns is None:
            return True
        return not 0 <= now_ns - self._fused_ns < self._longest_ns

    def waited_s(self, now_ns: int) -> float:
        """Longest time that data have waited since fusing began last [s]."""
        return 0.0 if self._fused_ns is None else max(0, now_ns - self._fused_ns) * 1e-9

    def begin(self, wall_s: float, now_ns: int) -> None:
        """Record that fusing begins."""
        self._rested_s, self._fused_ns = wall_s, now_ns

    def note(self, cpu_s: float) -> None:
        """Add the core time that fusing took [s]."""
        self._rested_s += cpu_s / self._load
