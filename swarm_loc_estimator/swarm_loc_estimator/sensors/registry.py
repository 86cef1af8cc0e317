"""All sensors in one table, the topics of a swarm, and the batches of their readings."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.filter.measurement_model import MeasurementArray
from swarm_loc_estimator.sensors.aerial import AERIAL
from swarm_loc_estimator.sensors.camera import DETECTIONS
from swarm_loc_estimator.sensors.fix import FIXES
from swarm_loc_estimator.sensors.infrared import BRIGHTNESS
from swarm_loc_estimator.sensors.odometry import ODOMETRY
from swarm_loc_estimator.sensors.sensor import InputKind, Sensor, chosen
from swarm_loc_estimator.swarm.swarm import Swarm

SENSORS: dict[str, Sensor] = {
    sensor.name: sensor for sensor in (ODOMETRY, DETECTIONS, BRIGHTNESS, FIXES, AERIAL)
}
"""All sensors by name. Measurements that arrive at one instant are used in this order."""

THE_SWARM = -1
"""In place of a robot: a topic about all of them."""


def kinds() -> dict[str, InputKind]:
    """All kinds of topics by name, shared ones last."""
    found = [kind for sensor in SENSORS.values() for kind in sensor.kinds]
    return {kind.name: kind for kind in sorted(found, key=lambda kind: bool(kind.stands_for))}


@dataclass(frozen=True)
class InputTopic:
    """One input.

    Attributes:
        name: Relative topic name, such as `<robot>/odom`.
        kind: What it carries.
        robot: Index into `Swarm.robots`, or THE_SWARM.
        expected: Whether something is wrong when nothing comes; a robot without camera detects nothing.
    """

    name: str
    kind: InputKind
    robot: int
    expected: bool = True


def input_topics(swarm: Swarm) -> tuple[InputTopic, ...]:
    """All inputs that a swarm may have, robot by robot, then those about all of them."""
    of_robots = (
        InputTopic(f"{robot.name}/{kind.topic}", kind, index, kind.expected_of(robot))
        for index, robot in enumerate(swarm.robots)
        for kind in kinds().values()
        if kind.of_each
    )
    of_swarm = (
        InputTopic(kind.topic, kind, THE_SWARM, expected=False)
        for kind in kinds().values()
        if not kind.of_each
    )
    return (*of_robots, *of_swarm)


def live_topics(swarm: Swarm, *, shared: bool) -> tuple[InputTopic, ...]:
    """What to listen to: topics of each robot, or in their place those that carry the same of many."""
    stood_for = {kind.stands_for for kind in kinds().values() if kind.stands_for}
    if not shared:
        return tuple(topic for topic in input_topics(swarm) if not topic.kind.stands_for)
    return tuple(
        replace(topic, expected=any(map(topic.kind.expected_of, swarm.robots)))
        if topic.kind.stands_for
        else topic
        for topic in input_topics(swarm)
        if topic.kind.rows == "aerial" or topic.kind.stands_for or _is_sent(topic, swarm, stood_for)
    )


def _is_sent(topic: InputTopic, swarm: Swarm, stood_for: Collection[str]) -> bool:
    """Whether a robot has what it sends on a topic of its own that no other one stands for."""
    return topic.kind.rows not in stood_for and topic.kind.expected_of(swarm.robots[topic.robot])


@dataclass(frozen=True)
class Batch:
    """Readings as the robots sent them, of a stretch in which time does not go back.

    Attributes:
        begin_ns: Arrival of the first message.
        end_ns: Arrival of the last one.
        rows: Sensor -> its readings, in order of arrival; sensors without are missing.
        dropped: Reason -> how many more could not even be read.
    """

    begin_ns: int
    end_ns: int
    rows: Mapping[str, Any] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, begin_ns: int, end_ns: int, **rows: Any) -> Batch:
        """A batch of readings given by the names of their sensors."""
        return cls(begin_ns, end_ns, rows)

    def __getitem__(self, sensor: str) -> Any:
        """The readings of a sensor."""
        return self.rows.get(sensor, SENSORS[sensor].nothing)


@dataclass(frozen=True)
class Measurements:
    """What a batch measures, in order of arrival.

    Attributes:
        begin_ns: Arrival of the first message.
        end_ns: Arrival of the last one.
        measurements: (m,) with finite values and valid covariances.
        arrival_ns: (m,).
        rows: Sensor -> valid readings that are used as they are: odometry, and those of accumulators.
    """

    begin_ns: int
    end_ns: int
    measurements: MeasurementArray
    arrival_ns: IntArray
    rows: Mapping[str, Any]

    def until_each(self, stamps_ns: IntArray) -> Iterator[Measurements]:
        """What arrived before the first instant (s,), between it and the next, ..., and from the last on."""
        rows = {name: _between(one.arrival_ns, stamps_ns) for name, one in self.rows.items()}
        measured, begin_ns = _between(self.arrival_ns, stamps_ns), self.begin_ns
        for k, end_ns in enumerate([*stamps_ns.tolist(), self.end_ns]):
            part = measured[k]
            yield Measurements(
                begin_ns,
                end_ns,
                self.measurements[part],
                self.arrival_ns[part],
                {name: chosen(one, rows[name][k]) for name, one in self.rows.items()},
            )
            begin_ns = end_ns


def _between(arrivals_ns: IntArray, stamps_ns: IntArray) -> list[slice]:
    """Which arrivals (k,), not decreasing, lie before, between and behind instants (s,): s + 1 slices."""
    ends = [*np.searchsorted(arrivals_ns, stamps_ns).tolist(), arrivals_ns.size]
    return [slice(begin, end) for begin, end in zip([0, *ends], ends, strict=False)]
