"""Sensor record: topics, columns, validation and conversion to measurements.

Readings of a sensor are a NamedTuple of columns of equal length, sorted by arrival. The first column is
`robot`, the last `arrival_ns`; one is `stamp_ns`.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_estimator.common.messages.message_batch import MessageBatch
from swarm_loc_estimator.filter.measurement_model import MEASUREMENT_DTYPE, MeasurementArray
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

Rows = TypeVar("Rows", bound="tuple[NDArray[Any], ...]")
NO_ROWS: IntArray = np.zeros(0, dtype=np.int64)
NO_MEASUREMENTS: MeasurementArray = np.zeros(0, dtype=MEASUREMENT_DTYPE)


def chosen(rows: Rows, some: slice | NDArray[np.bool_] | IntArray) -> Rows:
    """Select rows of a tuple of columns by a slice, a mask or indices."""
    return type(rows)(*(column[some] for column in rows))


def joined(parts: Sequence[Rows]) -> Rows:
    """Concatenate tuples of columns; dtypes are those of the first."""
    if len(parts) == 1:
        return parts[0]
    # without dtype, records lose their padding and numba compiles again for the new type
    columns = (np.concatenate(column, dtype=column[0].dtype) for column in zip(*parts, strict=True))
    return type(parts[0])(*columns)


def in_order_of_arrival(parts: Sequence[Rows]) -> Rows:
    """Concatenate tuples of columns and sort them by arrival; the sort is stable."""
    rows = joined(parts)
    order = np.argsort(rows[-1], kind="stable")  # the last column is the arrival
    return type(rows)(*(column[order] for column in rows))


class Known(NamedTuple):
    """Expected contents of messages."""

    map_frame: str  #: Name of the frame `map` in messages
    robots: int  #: Number of robots in the swarm
    swarm: int  #: Number that identifies the swarm in messages of many robots, see `swarm_key`


class Reader(Protocol):
    """Decodes the messages of all topics of one kind."""

    frame_ids: list[str]  #: Frame of the newest message of each topic, "" before the first

    def read(self, batch: MessageBatch) -> Any:
        """Decode messages (n,) in order of arrival.

        Returns:
            Decoded messages, with `stamp_ns` (n,) and `valid` (n,), True if complete and of the right type.
        """


def of_every(_: Robot) -> bool:
    """A topic that is expected of every robot."""
    return True


def of_none(_: Robot) -> bool:
    """A topic that is optional."""
    return False


class DropCounts:
    """Numbers of dropped readings by reason.

    Args:
        sources: Number of robots and fixed cameras.

    Attributes:
        total: Of all readings.
        of_robot: Of the own readings of each robot and, after them, of each fixed camera.
    """

    def __init__(self, sources: int) -> None:
        self.total: Counter[str] = Counter()
        self.of_robot: list[Counter[str]] = [Counter() for _ in range(sources)]

    def add(self, reason: str, robots: IntArray) -> None:
        """Count dropped readings of robots and fixed cameras (k,); -1: of none of them."""
        if not robots.size:
            return
        self.total[reason] += robots.size
        for robot, count in zip(*np.unique(robots[robots >= 0], return_counts=True), strict=True):
            self.of_robot[robot][reason] += int(count)

    def screen(self, robots: IntArray, reasons: Mapping[str, BoolArray]) -> BoolArray:
        """Which readings (k,) of robots (k,) are good; the others count under their first reason (k,)."""
        good = np.ones(robots.size, dtype=bool)
        for reason, bad in reasons.items():
            if bad.any():
                self.add(reason, robots[good & bad])
                good &= ~bad
        return good


class Guard:
    """A context in which an error of a sensor's code costs the readings of this sensor and no others.

    A warning describes the error.

    Args:
        sensor: Its name.
        readings: How many are lost.
        drops: Where they are counted, by the sensor and the type of the error.
    """

    def __init__(self, sensor: str, readings: int, drops: Counter[str]) -> None:
        self._sensor, self._readings, self._drops = sensor, readings, drops

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> bool:
        if kind is None or not isinstance(error, Exception):
            return False
        self._drops[f"{self._sensor}_{kind.__name__}"] += self._readings
        said = f"the code of the sensor '{self._sensor}' raised {kind.__name__}: {error}"
        warnings.warn(said, RuntimeWarning, stacklevel=2)
        return True


@dataclass(frozen=True)
class InputKind:
    """Kind of input topic."""

    name: str  #: Name of the kind; equal to that of the sensor for topics of single robots
    topic: str  #: Name relative to the robot's namespace, or full name of a topic of the swarm
    message_type: str  #: Message type, such as nav_msgs/msg/Odometry
    create_reader: Callable[[int, Known], Reader]  #: Creates a reader for a number of topics
    #: Converts decoded messages (n,), the messages and the robots (n,) of their topics to readings; also
    #: returns the number of unused valid readings by reason
    columns_of: Callable[[Any, MessageBatch, IntArray, Known], tuple[Any, Mapping[str, int]]]
    expected_of: Callable[[Robot], bool] = of_every  #: True if a missing topic of the robot is an error
    of_each: bool = True  #: True if each robot has its own topic
    only_expected: bool = False  #: True if robots of which it is not expected have no such topic
    of_cameras: bool = False  #: True if each fixed camera has such a topic, too
    in_map: bool = False  #: True if readings must be in the frame `map`
    needs_map: bool = False  #: True if there are such topics only for a swarm with a map
    stands_for: str = ""  #: Name of the sensor whose topics of single robots it replaces; "" if none

    @property
    def rows(self) -> str:
        """Name of the sensor of its readings."""
        return self.stands_for or self.name

    def is_expected_of(self, swarm: Swarm) -> bool:
        """Whether any robot of a swarm should have the topic, or readings on it."""
        return any(map(self.expected_of, swarm.robots))

    @property
    def pattern(self) -> str:
        """Pattern of its topic names, such as `<robot>/odom`."""
        return f"<robot>/{self.topic}" if self.of_each else self.topic


class Measured(NamedTuple):
    """Measurements of a sensor."""

    measurements: MeasurementArray  #: (m,) of MEASUREMENT_DTYPE
    arrival_ns: IntArray  #: (m,) arrival times


class Change(NamedTuple):
    """Change of a sensor's measurements by new readings."""

    added: MeasurementArray  #: (m,) new measurements
    withdrawn: MeasurementArray  #: (w,) earlier measurements that are replaced


class Accumulator(Protocol):
    """Combines readings that arrive one by one into measurements."""

    @property
    def drops(self) -> Counter[str]:
        """Number of unused readings by reason."""

    @property
    def counters(self) -> dict[str, int]:
        """Numbers of used readings by name, since the last `restart`."""

    def take(self, rows: Any) -> Change:
        """Add readings; return the change of the measurements."""

    def forget_before(self, oldest_ns: int) -> None:
        """Discard readings older than an instant."""

    def restart(self) -> None:
        """Discard all readings."""


class SensorSettings(Protocol):
    """Estimator settings used by sensors, see `timeline.settings.Settings`."""

    @property
    def future_tolerance_s(self) -> float:
        """Maximum time of a stamp after its arrival [s]; later stamps are dropped."""

    @property
    def aerial_position_sigma(self) -> float:
        """Standard deviation of the position of aerial detections without covariance [m]."""

    @property
    def aerial_heading_sigma(self) -> float:
        """Standard deviation of the heading of aerial detections without covariance [rad]."""


Converter = Callable[[Any], Any]
"""Converts readings to `Measured`, or filters valid readings for odometry and accumulators."""


@dataclass(frozen=True)
class Sensor:
    """Sensor on the robots or an overhead camera; `registry.SENSORS` lists all."""

    name: str  #: Name of its readings in a batch
    nothing: tuple[NDArray[Any], ...]  #: Empty readings
    kinds: tuple[InputKind, ...]  #: Kinds of its topics
    #: Creates a converter for a swarm, which counts dropped readings by reason; if None, readings are used
    #: unchanged
    create_converter: Callable[[Swarm, SensorSettings, DropCounts], Converter] | None = None
    #: Creates an accumulator for a sensor that combines several readings into one measurement; None for other
    #: sensors
    create_accumulator: Callable[[Swarm], Accumulator] | None = None
    #: Columns that group readings: a group is used or dropped as a whole. None: never dropped.
    unit: tuple[str, ...] | None = ()
    keeps_units: bool = False  #: True if readings of one group may arrive in several batches
