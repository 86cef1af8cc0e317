"""Leave out some of what was measured, evenly over all robots and pairs, where more comes than can be used.

Each source (a robot's camera, infrared board or fixes, a camera above) may use the same number of its
measurements: where some send more than others, theirs are the first that go (max-min fairness; D. Bertsekas,
R. Gallager: Data Networks, 6.5.2). A source's own are numbered, and number k is used when the fractional
part of k times the golden ratio lies below the share. Such a sequence is even over any stretch and also over
every n-th number (H. Weyl: Ueber die Gleichverteilung von Zahlen mod. Eins, 1916), so that a robot that
always sends what it sees in the same order does not lose the same neighbour each time.

A large swarm's measurements of one fusion period are fused together, which costs as much for few as for
many. There all sightings of some periods are used and none of the others: period k by the same rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.sensors.registry import SENSORS, Batch
from swarm_loc_estimator.sensors.sensor import Sensor, chosen
from swarm_loc_estimator.timeline.scheduling import end_of_period

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""The golden ratio's fractional part in units of 2^-64."""
_SILVER = np.uint64(0x6A09E667F3BCC909)
"""That of the square root of two: where a source's numbers begin, so that not all are used at once."""

_WHOLE = 2.0**64

SHED_REASONS = frozenset(f"shed_{sensor.name}" for sensor in SENSORS.values() if sensor.unit is not None)
"""Why readings are left out, by sensor."""


class Thinned(NamedTuple):
    """What is left of messages.

    Attributes:
        messages: Their `dropped` counts what has been left out, too.
        measurements: How many there were: detections, fixes, infrared exchanges, aerial images.
        shed: How many of them were left out.
    """

    messages: Batch
    measurements: int
    shed: int


class Thinning:
    """Thins out measurements; odometry stays, since all else is used by way of it.

    The same messages in the same order leave the same behind. All matrices of an infrared exchange are used
    or none, and so are all detections of an aerial image: a part of it would say that robots are missing.

    Args:
        robots: How many robots there are.
        period_ns: Fusion period of a large swarm [ns]; 0: of each source some measurements are used.
    """

    def __init__(self, robots: int, period_ns: int = 0) -> None:
        self._period_ns = period_ns
        self._sources_of_kind = robots + 1  # the last one is the swarm, whose number is -1
        self._sensors = [sensor for sensor in SENSORS.values() if sensor.unit is not None]
        self._number = np.zeros(len(self._sensors) * self._sources_of_kind, dtype=np.uint64)
        self._exchanges: dict[tuple[int, ...], bool] = {}

    def thin(self, messages: Batch, share: float) -> Thinned:
        """Use a share of all measurements, in (0, 1]."""
        units = [_units(sensor, messages[sensor.name]) for sensor in self._sensors]
        sources = [
            k * self._sources_of_kind + one.robot % self._sources_of_kind for k, one in enumerate(units)
        ]
        if self._period_ns:
            used = self._in_periods(np.concatenate([one.stamp_ns for one in units]), share)
        else:
            used = self._used(np.concatenate(sources), share)
        rows = dict(messages.rows)
        shed: dict[str, int] = {}
        for sensor, one, mine in zip(
            self._sensors, units, np.split(used, np.cumsum([s.size for s in sources[:-1]])), strict=True
        ):
            self._decide_as_before(one.exchange, mine)
            if not mine.all():
                rows[sensor.name] = chosen(messages[sensor.name], mine[one.of_row])
                shed[f"shed_{sensor.name}"] = int(np.sum(~mine))
        left = replace(messages, rows=rows, dropped={**messages.dropped, **shed})
        return Thinned(left, used.size, sum(shed.values()))

    def _in_periods(self, stamp_ns: IntArray, share: float) -> NDArray[np.bool_]:
        """Whether to use measurements (u,) with stamps (u,) [ns]: those of some periods."""
        number = (end_of_period(stamp_ns, self._period_ns) // self._period_ns).astype(np.uint64)
        fraction = (number * _GOLDEN).astype(np.float64) / _WHOLE
        return np.asarray((fraction < share) | (share >= 1.0))

    def _used(self, source: IntArray, share: float) -> NDArray[np.bool_]:
        """Whether to use measurements (u,) of sources (u,)."""
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

    def _decide_as_before(self, exchanges: Sequence[tuple[int, ...]], used: NDArray[np.bool_]) -> None:
        """Let exchanges share the fate of their matrices in the backlog before."""
        if not exchanges:
            return
        for k, exchange in enumerate(exchanges):
            used[k] = self._exchanges.get(exchange, used[k])
        self._exchanges = dict(zip(exchanges, used.tolist(), strict=True))


def water_level(count: IntArray, total: float) -> float:
    """How many each source may use at most, so that together they use `total` of counts (s,)."""
    ascending = np.sort(count)
    left = total - (np.cumsum(ascending) - ascending)  # for this source and those that have more
    level = left / np.arange(count.size, 0, -1)
    above = np.flatnonzero(ascending >= level)
    return float(level[above[0]]) if above.size else float(np.inf)


class _Units(NamedTuple):
    """What of a kind is used or left out together (u,).

    Attributes:
        robot: (u,) whose it is.
        stamp_ns: (u,) when it was measured.
        of_row: (k,) the unit of each row.
        exchange: Robot, stamp and transmitter of each, of infrared only.
    """

    robot: IntArray
    stamp_ns: IntArray
    of_row: IntArray
    exchange: Sequence[tuple[int, ...]] = ()


def _units(sensor: Sensor, rows: Any) -> _Units:
    """What of a sensor's readings is used or left out together: those alike in `unit`, else each alone."""
    if not sensor.unit:
        return _Units(rows.robot, rows.stamp_ns, np.arange(rows.robot.size))
    keys = np.column_stack([getattr(rows, name) for name in sensor.unit])
    found, of_row = np.unique(keys, axis=0, return_inverse=True)
    exchanges = [tuple(key) for key in found.tolist()] if sensor.keeps_units else []
    robot, stamp_ns = (found[:, sensor.unit.index(name)] for name in ("robot", "stamp_ns"))
    return _Units(robot, stamp_ns, of_row.reshape(-1), exchanges)
