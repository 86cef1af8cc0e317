"""What a sensor is: one record of its topics, columns, checks and conversion to measurements.

The readings of a sensor are a tuple of columns of one length, among them `robot` (the first one), `stamp_ns`
and `arrival_ns` (the last one), in order of arrival.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.messages.message_batch import MessageBatch
from swarm_loc_estimator.filter.measurement_model import MEASUREMENT_DTYPE, MeasurementArray
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

Rows = TypeVar("Rows", bound="tuple[NDArray[Any], ...]")
NO_ROWS: IntArray = np.zeros(0, dtype=np.int64)
NO_MEASUREMENTS: MeasurementArray = np.zeros(0, dtype=MEASUREMENT_DTYPE)


def chosen(rows: Rows, some: slice | NDArray[np.bool_]) -> Rows:
    """Some of the rows of a tuple of columns."""
    return type(rows)(*(column[some] for column in rows))


def joined(parts: Sequence[Rows]) -> Rows:
    """All rows of tuples of columns, one part after the other; their types are those of the first."""
    if len(parts) == 1:
        return parts[0]
    # records would lose their padding otherwise, and compiled code take them for others
    columns = (np.concatenate(column, dtype=column[0].dtype) for column in zip(*parts, strict=True))
    return type(parts[0])(*columns)


def in_order_of_arrival(parts: Sequence[Rows]) -> Rows:
    """All rows of tuples of columns; those that arrived together in the order of the parts."""
    rows = joined(parts)
    order = np.argsort(rows[-1], kind="stable")  # the last column is the arrival
    return type(rows)(*(column[order] for column in rows))


class Known(NamedTuple):
    """What the columns of a message are checked against.

    Attributes:
        map_frame: Name of the frame `map` in messages.
        robots: How many robots the swarm has.
        swarm: The number by which messages of many robots name the swarm, see `swarm_key`.
    """

    map_frame: str
    robots: int
    swarm: int


class Reader(Protocol):
    """Decodes the messages of all topics of one kind.

    Attributes:
        frame_ids: Per topic the frame of the newest message, "" before the first.
    """

    frame_ids: list[str]

    def read(self, batch: MessageBatch) -> Any:
        """Decode messages (n,) in order of arrival.

        Returns:
            What was found, with `stamp_ns` (n,) and `valid` (n,): whether a message is whole and of the type.
        """


def _never(_: Robot) -> bool:
    return False


@dataclass(frozen=True)
class InputKind:
    """A kind of topic.

    Attributes:
        name: Of the kind, which is that of the sensor for topics of each robot.
        topic: Its name below the robot's, or its whole name where it is about the swarm.
        message_type: Type of its messages, such as nav_msgs/msg/Odometry.
        create_reader: Makes a reader of so many topics.
        columns_of: From what the reader found in messages (n,), the messages, and the robots (n,) on whose
            topics they came: the readings, and by reason how many more are whole, but not used.
        expected_of: Whether something is wrong when a robot sends none.
        of_each: Whether each robot has a topic of its own.
        in_map: Whether its readings must be in the frame `map`.
        stands_for: The sensor whose topics of each robot it replaces; "" where it replaces none.
    """

    name: str
    topic: str
    message_type: str
    create_reader: Callable[[int, Known], Reader]
    columns_of: Callable[[Any, MessageBatch, IntArray, Known], tuple[Any, Mapping[str, int]]]
    expected_of: Callable[[Robot], bool] = _never
    of_each: bool = True
    in_map: bool = False
    stands_for: str = ""

    @property
    def rows(self) -> str:
        """Name of the sensor whose readings it carries."""
        return self.stands_for or self.name

    @property
    def pattern(self) -> str:
        """Names of its topics, such as `<robot>/odom`."""
        return f"<robot>/{self.topic}" if self.of_each else self.topic


class Measured(NamedTuple):
    """What readings measure.

    Attributes:
        measurements: (m,) of MEASUREMENT_DTYPE.
        arrival_ns: (m,) when they arrived.
    """

    measurements: MeasurementArray
    arrival_ns: IntArray


class Change(NamedTuple):
    """What new readings change of a sensor's measurements.

    Attributes:
        added: (m,) measurements to use from now on.
        withdrawn: (w,) measurements given before that no longer hold.
    """

    added: MeasurementArray
    withdrawn: MeasurementArray


class Accumulator(Protocol):
    """Makes measurements of readings that belong together and arrive one by one."""

    @property
    def drops(self) -> Counter[str]:
        """Readings not used, by reason."""

    @property
    def counters(self) -> dict[str, int]:
        """What was used since the last `restart`, by name."""

    def take(self, rows: Any) -> Change:
        """Add readings."""

    def forget_before(self, oldest_ns: int) -> None:
        """Forget what is older than an instant."""

    def restart(self) -> None:
        """Forget everything."""


class SensorSettings(Protocol):
    """The settings of the estimator that sensors use, see `timeline.settings.Settings`."""

    @property
    def future_tolerance_s(self) -> float:
        """Stamps further ahead of their arrival than this are dropped."""

    @property
    def aerial_position_sigma(self) -> float:
        """Noise of aerial detections without a covariance [m]."""

    @property
    def aerial_heading_sigma(self) -> float:
        """Noise of their headings [rad]."""


Converter = Callable[[Any], Any]
"""From readings to `Measured`, or, where they are needed as they are, to those readings that are valid."""


@dataclass(frozen=True)
class Sensor:
    """A sensor of robots, or one above them; all of them stand in `registry.SENSORS`.

    Attributes:
        name: Of its readings in a batch.
        nothing: Readings of length 0.
        kinds: The topics on which they come.
        create_converter: Makes a converter for a swarm, which counts what it drops by reason; None: readings
            are used as they are.
        create_accumulator: For a sensor that makes one measurement of several readings, and another one
            when more of them come.
        unit: Columns; readings equal in all of them are used or shed together. None: odometry, never shed.
        keeps_units: Whether readings of one unit may come in several batches.
    """

    name: str
    nothing: tuple[NDArray[Any], ...]
    kinds: tuple[InputKind, ...]
    create_converter: Callable[[Swarm, SensorSettings, Counter[str]], Converter] | None = None
    create_accumulator: Callable[[Swarm], Accumulator] | None = None
    unit: tuple[str, ...] | None = ()
    keeps_units: bool = False
