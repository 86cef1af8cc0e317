"""The seam for sensors: a class of two or three methods, from decoded messages to measurements.

A sensor derives from `Sensor` and is registered by `registry.register`. The base class reads bytes, headers
and topics, validates measurements and counts what is dropped. Readings are a NamedTuple of columns of equal
length, sorted by arrival. The first column is `robot`, the last `arrival_ns`; one is `stamp_ns`.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.messages.cdr import CdrError, decode, nanoseconds
from swarm_loc_estimator.common.messages.detections import SharedMessage
from swarm_loc_estimator.common.messages.streams import EachReader, MessageBatch, Messages
from swarm_loc_estimator.common.numerics import cholesky3
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements, concatenate, select
from swarm_loc_estimator.filter.models import MODELS, Prediction
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

Rows = TypeVar("Rows", bound="tuple[Any, ...]")
NO_ROWS: IntArray = np.zeros(0, dtype=np.int64)


def in_order_of_arrival(parts: Sequence[Rows]) -> Rows:
    """Concatenate tuples of columns and sort them by arrival; the sort is stable."""
    rows = concatenate(parts)
    order = np.argsort(rows[-1], kind="stable")  # the last column is the arrival
    return select(rows, order)


def fill(column: NDArray[Any], given: Any, name: str) -> None:
    """Write given values to a column (k, ...); a number stands for all.

    Raises TypeError if they have another length or shape, or are no numbers that the column can hold.
    """
    try:
        if column.dtype == object:
            for k, one in zip(range(len(column)), given, strict=True):
                column[k] = one
        elif np.shape(given) in {(), column.shape}:
            with np.errstate(invalid="ignore"):
                column[:] = given
            if column.dtype.kind in "iu" and not np.all(column == given):
                raise TypeError(f"{name} must be whole numbers that fit into {column.dtype}")
        else:
            raise TypeError(f"{name} has shape {np.shape(given)}, not {column.shape}")
    except (OverflowError, ValueError) as error:
        raise TypeError(f"{name} has wrong values: {error}") from error


class Known(NamedTuple):
    """Expected contents of messages."""

    map_frame: str  #: Name of the frame `map` in messages
    robots: int  #: Number of robots in the swarm
    swarm: int  #: Number that identifies the swarm in messages of many robots, see `swarm_key`
    devices: NDArray[np.uint64]  #: (t,) `InputTopic.device` of each topic


class Reader(Protocol):
    """Decodes the messages of all topics of one kind."""

    frame_ids: list[str]  #: Frame of the newest message of each topic, "" before the first

    def read(self, batch: MessageBatch) -> Any:
        """Decode messages (n,) in order of arrival.

        Returns:
            Decoded messages, with `stamp_ns` (n,) and `valid` (n,), True if complete and of the right type.
        """


class DropCounts:
    """Numbers of dropped readings by reason, of a number of robots and fixed cameras."""

    def __init__(self, sources: int) -> None:
        self.total: Counter[str] = Counter()  #: Of all readings
        #: Of the own readings of each robot and, after them, of each fixed camera
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


@contextmanager
def guarded(sensor: str, readings: int, drops: Counter[str]) -> Iterator[None]:
    """A context in which an error of a sensor's code costs the readings of this sensor and no others.

    They are counted by the name of the sensor and the type of the error, which a warning describes.
    """
    try:
        yield
    except Exception as error:  # noqa: BLE001 - whatever code of others raises
        kind = type(error).__name__
        drops[f"{sensor}_{kind}"] += readings
        said = f"the code of the sensor '{sensor}' raised {kind}: {error}"
        warnings.warn(said, RuntimeWarning, stacklevel=3)


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
    expected_of: Callable[[Robot], bool]  #: True if a missing topic of the robot is an error
    topics_of: Callable[[Robot], tuple[str, ...]]  #: Its topics of a robot, relative to its namespace
    of_each: bool = True  #: True if each robot has its own topic
    only_expected: bool = False  #: True if robots of which it is not expected have no such topic
    of_cameras: bool = False  #: True if each fixed camera has such a topic, too
    in_map: bool = False  #: True if readings must be in the frame `map`
    needs_map: bool = False  #: True if there are such topics only with a map; of the swarm: by topic
    stands_for: str = ""  #: Name of the sensor whose topics of single robots it replaces; "" if none
    of_pairs: bool = False  #: True if each pair of radios has a topic, see `Swarm.range_topic`

    @property
    def rows(self) -> str:
        """Name of the sensor of its readings."""
        return self.stands_for or self.name

    def is_expected_of(self, swarm: Swarm) -> bool:
        """Whether any robot of a swarm should have the topic, or readings on it."""
        return any(map(self.expected_of, swarm.robots))

    @property
    def is_shared(self) -> bool:
        """Whether one topic replaces those of all robots."""
        return bool(self.stands_for) and not self.of_pairs

    @property
    def pattern(self) -> str:
        """Pattern of its topic names, such as `<robot>/odom`."""
        return f"<robot>/{self.topic}" if self.of_each and not self.of_pairs else self.topic


class Change(NamedTuple):
    """Change of a sensor's measurements by new readings."""

    added: Measurements  #: (m,) new measurements
    withdrawn: Measurements  #: (w,) earlier measurements that are replaced


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
    def aerial_gate_probability(self) -> float:
        """Share of good aerial detections that must pass the gate."""

    @property
    def aerial_heading_sigma(self) -> float:
        """Standard deviation of the heading of aerial detections without covariance [rad]."""


class SharedTopic(NamedTuple):
    """Topic with readings of many robots, which replaces their own topics."""

    topic: str  #: Full name
    message_type: str
    decode: Callable[[bytes], SharedMessage]  #: Decodes a message
    rows_of: Callable[[SharedMessage, IntArray], Any]  #: Converts a message and arrivals (n,) to readings


class Sensor:
    """A sensor on robots, or overhead; `registry.SENSORS` lists all.

    A sensor of your own says its names and defines `columns` and `measure`, and for a model of its own
    `components`, `is_angle` and `predict`. An object of it is created for each swarm.

    Args:
        swarm: Robots with their sensors.
        settings: Default noise of sensors.
        drops: Where readings that cannot be used are counted.
    """

    name: ClassVar[str]  #: Name of its readings in a batch
    topic: ClassVar[str]  #: Name relative to the robot's namespace, or full name of a topic of the swarm
    message_type: ClassVar[str]  #: Message type, such as nav_msgs/msg/Odometry
    shared: ClassVar[SharedTopic | None] = None  #: Topic with its readings of many robots, if there is one

    of_each: ClassVar[bool] = True  #: True if each robot has its own topic
    only_expected: ClassVar[bool] = False  #: True if robots of which it is not expected have no such topic
    of_cameras: ClassVar[bool] = False  #: True if each fixed camera has such a topic, too
    in_map: ClassVar[bool] = False  #: True if messages must be in the frame `map`
    #: True if there are such topics only with a map; of the swarm: by topic
    needs_map: ClassVar[bool] = False

    optional: ClassVar[Mapping[str, Any]] = {}  #: Values of columns that `rows` may lack
    #: Columns that group readings: a group is used or dropped as a whole. None: never dropped
    unit: ClassVar[tuple[str, ...] | None] = ()
    keeps_units: ClassVar[bool] = False  #: True if readings of one group may arrive in several batches
    #: Class of an `Accumulator`, which combines several readings into one measurement; None: not needed
    accumulator: ClassVar[Any] = None

    components: ClassVar[tuple[str, ...]] = ()  #: Names and units of the components of its own model
    is_angle: ClassVar[tuple[bool, ...]] = (False, False, False)  #: Which of them are angles
    gate_probability: ClassVar[float] = 0.999  #: Share of good measurements that pass the gate
    model: ClassVar[int]  #: Number of its own model, set by `registry.register`

    def __init__(self, swarm: Swarm, settings: SensorSettings, drops: DropCounts) -> None:
        self.swarm, self.settings, self.drops = swarm, settings, drops

    @classmethod
    def columns(cls, messages: Any) -> Any:
        """Convert decoded messages (n,) to readings; with no message, to empty columns.

        Args:
            messages: `Messages`, all of them valid, or what a reader of its own returned for all.
        """
        raise NotImplementedError

    def measure(self, rows: Any) -> Any:
        """Convert readings to `Measurements`; odometry and accumulators get the valid readings."""
        return rows

    @staticmethod
    def predict(one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
        """Predict a row of measurements from poses (3,), see `MeasurementModel.predict`."""
        raise NotImplementedError

    @classmethod
    def decode(cls, data: bytes) -> Any:
        """Decode a message; the result has `stamp_ns` and `frame_id`.

        Raises:
            ValueError: The bytes are not one whole message; a LookupError or struct.error says this, too.
        """
        message = decode(data, cls.message_type)
        message.stamp_ns, message.frame_id = nanoseconds(message.header.stamp), message.header.frame_id
        return message

    @classmethod
    def expected_of(cls, _robot: Robot) -> bool:
        """Whether a missing topic of the robot is an error."""
        return True

    @classmethod
    def topics_of(cls, _robot: Robot) -> tuple[str, ...]:
        """Its topics of a robot, several if it has several such sensors."""
        return (cls.topic,)

    @classmethod
    def fault_of(cls, message: Any, map_frame: str) -> str:
        """Reason to drop a message, "" if there is none."""
        return f"{cls.topic.partition('/')[0]}_frame" if cls.in_map and message.frame_id != map_frame else ""

    def measurements(self, rows: Any) -> Measurements:
        """Create a measurement per reading, by its robot at its stamp, with the gate of its own model."""
        out = Measurements.empty(rows.robot.size)
        out.stamp_ns[:], out.arrival_ns[:] = rows.stamp_ns, rows.arrival_ns
        out.received_from[:] = out.observer[:] = rows.robot
        out.model[:], out.gate[:] = self.model, MODELS[self.model].gate(self.gate_probability)
        return out

    @classmethod
    def create_reader(cls, topics: int, _known: Known) -> Reader:
        """Create a reader of the messages of a number of topics."""
        return EachReader(topics, cls.decode)

    @classmethod
    def nothing(cls) -> Any:
        """Empty readings."""
        return cls.columns(Messages(NO_ROWS, NO_ROWS > 0, []))

    @classmethod
    def rows(cls, columns: Mapping[str, Any]) -> Any:
        """Create readings (k,) from columns in any form that NumPy reads.

        Args:
            columns: By name; `robot`, `stamp_ns` and `arrival_ns` (k,) are arrays. A number stands for all.

        Raises:
            TypeError: A column is missing or unknown, or has another length or shape.
        """
        nothing, count = cls.nothing(), len(columns["robot"])
        unknown = [name for name in columns if name not in nothing._fields]
        missing = [name for name in nothing._fields if name not in {*columns, *cls.optional}]
        if unknown or missing:
            wrong = f"no column '{unknown[0]}'" if unknown else f"the column '{missing[0]}' is missing"
            raise TypeError(f"{cls.name}: {wrong}; columns are {', '.join(nothing._fields)}")
        made = []
        for name, empty in zip(nothing._fields, nothing, strict=True):
            column = np.empty((count, *empty.shape[1:]), dtype=empty.dtype)
            fill(column, columns.get(name, cls.optional.get(name)), f"{cls.name}: {name}")
            made.append(column)
        return type(nothing)(*made)

    @classmethod
    def kinds(cls) -> tuple[InputKind, ...]:
        """Kinds of its topics."""
        own = InputKind(
            cls.name, cls.topic, cls.message_type, cls.create_reader, cls._read, cls.expected_of,
            cls.topics_of, cls.of_each, cls.only_expected, cls.of_cameras, cls.in_map, cls.needs_map,
        )  # fmt: skip
        return (own,) if cls.shared is None else (own, _shared_kind(own, cls.shared, cls.nothing()))

    @classmethod
    def _read(cls, found: Any, batch: MessageBatch, robot: IntArray, known: Known) -> Any:
        """Convert what the reader returned for messages (n,) to readings, and count what is dropped."""
        found = replace(found, robot=robot, arrival_ns=batch.log_ns)
        if not isinstance(found, Messages):
            return cls.columns(found), {}
        faults = [cls.fault_of(message, known.map_frame) for message in found.decoded]
        kept = np.flatnonzero(found.valid)[np.array([not fault for fault in faults], dtype=bool)]
        decoded = [one for one, fault in zip(found.decoded, faults, strict=True) if not fault]
        read = Messages(found.stamp_ns[kept], found.valid[kept], decoded, robot[kept], batch.log_ns[kept])
        return cls.columns(read), Counter(fault for fault in faults if fault)


VALID = 0
REJECT_REASONS = ("", "non_finite", "absurd", "bad_covariance", "bad_measurement")
"""Reasons to reject a measurement, indexed by the result of `reject_reasons`."""
BAD_MEASUREMENT = REJECT_REASONS.index("bad_measurement")

_MAX_DISTANCE_M = 1e6
_MIN_VARIANCE, _MAX_VARIANCE = 1e-14, 1e14
_ASYMMETRY, _ROUNDING = 1e-6, 1e-9


def reject_reasons(measurements: Measurements) -> IntArray:
    """Reasons (m,) to reject measurements (m,), as indices of `REJECT_REASONS`; `VALID` if none."""
    value, reasons = measurements.value, np.full(measurements.size, VALID)
    _check_covariances(measurements.covariance, reasons)
    reasons[np.abs(value).max(axis=1) > _MAX_DISTANCE_M] = REJECT_REASONS.index("absurd")
    reasons[~np.isfinite(value).all(axis=1)] = REJECT_REASONS.index("non_finite")
    return reasons


def is_about_swarm(measurements: Measurements, robots: int, landmarks: int) -> BoolArray:
    """Whether measurements (m,) have a registered model, valid indices, and finite parameters."""
    valid = np.empty(measurements.size, dtype=np.bool_)
    _check_parameters(measurements, np.array(list(MODELS)), robots, landmarks, valid)
    return valid


@cached_njit
def _check_parameters(
    measurements: Measurements, models: IntArray, robots: int, landmarks: int, valid: BoolArray
) -> None:
    for k in range(valid.size):
        observer, target = measurements.observer[k], measurements.target[k]
        good = NOBODY <= observer < robots and NOBODY <= target < robots
        good = good and NOBODY <= measurements.landmark[k] < landmarks
        good = good and NOBODY <= measurements.mount[k] < landmarks
        good = good and (observer != target or observer == NOBODY)
        variance = measurements.stamp_variance[k]
        good = good and math.isfinite(variance) and variance >= 0.0
        good = good and not math.isnan(measurements.gate[k])
        sensor, marker = measurements.sensor[k], measurements.marker[k]
        for i in range(3):
            good = good and math.isfinite(sensor[i]) and math.isfinite(marker[i])
            good = good and math.isfinite(measurements.reference[k, i])
        good = good and math.isfinite(measurements.height[k, 0]) and math.isfinite(measurements.height[k, 1])
        known = False
        for number in models:
            known = known or measurements.model[k] == number
        valid[k] = good and known


_BAD_COVARIANCE = REJECT_REASONS.index("bad_covariance")


@cached_njit
def _check_covariances(matrices: FloatArray, reasons: IntArray) -> None:
    """Mark matrices that are not symmetric positive definite or of implausible magnitude."""
    scaled = np.empty((3, 3))
    for k in range(reasons.size):
        good = True
        for i in range(3):
            good = good and _MIN_VARIANCE <= matrices[k, i, i] <= _MAX_VARIANCE
        if good:
            for i in range(3):
                for j in range(3):
                    scaled[i, j] = matrices[k, i, j] / math.sqrt(matrices[k, i, i] * matrices[k, j, j])
            for i in range(3):
                for j in range(3):
                    good = good and abs(scaled[i, j] - scaled[j, i]) < _ASYMMETRY
                scaled[i, i] -= _ROUNDING
            factor = cholesky3(scaled)  # NaN if not positive definite
            good = good and math.isfinite(factor[0, 0] + factor[1, 1] + factor[2, 2])
        if not good:
            reasons[k] = _BAD_COVARIANCE


MAX_READINGS = 100_000  # Maximum number of readings per message; larger messages are dropped
MAX_OF_ONE = 1_000  # Maximum number of readings of one robot per message, equal to the queue of its own topic
TOO_MANY = "shared_too_many"  # Reason to drop messages beyond these limits
OTHER_SWARM = "other_swarm"  # Reason to drop readings of a sender with another list of robots
UNKNOWN_ROBOT = "unknown_robot"  # Reason to drop a reading with an invalid robot index
BAD_STAMP = "bad_stamp"  # Reason to drop a reading with 10^9 or more nanoseconds in its stamp

FOREIGN_FRAME = "fix_frame"  # Reason to drop shared readings that are not in the frame `map`


class SharedColumns(NamedTuple):
    """Decoded messages (n,) with readings of many robots."""

    stamp_ns: IntArray  # (n,) stamps of the messages
    valid: BoolArray  # (n,) True if the message is complete and of the right type
    rows: Any  # The readings
    dropped: Mapping[str, int]  # Number of unusable readings of valid messages by reason


class SharedReader:
    """Decodes messages with readings of many robots each, which may have to be in the frame `map`."""

    def __init__(
        self, topics: int, known: Known, *, shared: SharedTopic, nothing: Any, in_map: bool = False
    ) -> None:
        self._known, self._shared, self._nothing, self._in_map = known, shared, nothing, in_map
        self.frame_ids = [""] * topics

    def read(self, batch: MessageBatch) -> SharedColumns:
        """Decode messages (n,) in order of arrival."""
        stamp_ns, valid = np.zeros(batch.size, dtype=np.int64), np.ones(batch.size, dtype=bool)
        parts = [self._nothing]
        dropped: Counter[str] = Counter()
        for k, (topic, arrival_ns, data) in enumerate(batch.messages()):
            try:
                message = self._shared.decode(data)
            except CdrError:
                valid[k] = False
                continue
            stamp_ns[k], self.frame_ids[topic] = message.stamp_ns, message.frame_id
            if fault := self._fault(message):
                dropped[fault] += message.robot.size
            else:  # readings of known robots with valid stamps
                rows = self._shared.rows_of(message, np.full(message.robot.size, arrival_ns))
                unknown, unstamped = rows.robot >= self._known.robots, rows.stamp_ns < 0
                dropped[UNKNOWN_ROBOT] += int(np.sum(unknown))
                dropped[BAD_STAMP] += int(np.sum(unstamped & ~unknown))
                parts.append(select(rows, ~(unknown | unstamped)))
        return SharedColumns(stamp_ns, valid, concatenate(parts), +dropped)

    def _fault(self, message: SharedMessage) -> str:
        """Reason to drop all readings of a message; "" if there is none."""
        if message.swarm != self._known.swarm:
            return OTHER_SWARM
        robot = message.robot[message.robot < self._known.robots]
        if message.robot.size > MAX_READINGS or np.bincount(robot).max(initial=0) > MAX_OF_ONE:
            return TOO_MANY
        return FOREIGN_FRAME if self._in_map and message.frame_id != self._known.map_frame else ""


def _shared_kind(own: InputKind, shared: SharedTopic, nothing: Any) -> InputKind:
    """Kind of a topic with readings of many robots, which replaces their own topics."""
    reader = partial(SharedReader, shared=shared, nothing=nothing, in_map=own.in_map)
    return replace(
        own,
        name=f"swarm_{own.name}",
        topic=shared.topic,
        message_type=shared.message_type,
        create_reader=reader,
        columns_of=lambda found, *_: (found.rows, found.dropped),
        of_each=False,
        of_cameras=False,
        stands_for=own.name,
    )
