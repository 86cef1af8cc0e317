"""Inputs of a swarm: all sensors, their topics, and the way from raw messages to batches of measurements.

Malformed messages and invalid readings are counted and dropped.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.messages.detections import swarm_key
from swarm_loc_estimator.common.messages.streams import MessageBatch
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.filter.measurements import Measurements, concatenate, select
from swarm_loc_estimator.filter.models import MODELS, MeasurementModel
from swarm_loc_estimator.filter.models import register as register_model
from swarm_loc_estimator.sensors.aerial import AerialSensor
from swarm_loc_estimator.sensors.camera import CameraSensor
from swarm_loc_estimator.sensors.fix import FixSensor
from swarm_loc_estimator.sensors.imu import TurnRateSensor
from swarm_loc_estimator.sensors.infrared import BrightnessSensor
from swarm_loc_estimator.sensors.lidar import ScanSensor
from swarm_loc_estimator.sensors.map_topic import MapSensor
from swarm_loc_estimator.sensors.odometry import OdometrySensor
from swarm_loc_estimator.sensors.ranges import RangeSensor
from swarm_loc_estimator.sensors.sensor import (
    BAD_MEASUREMENT,
    REJECT_REASONS,
    VALID,
    Accumulator,
    DropCounts,
    InputKind,
    Known,
    Sensor,
    SensorSettings,
    guarded,
    in_order_of_arrival,
    is_about_swarm,
    reject_reasons,
)
from swarm_loc_estimator.swarm.error_models import MAX_OFFSET_S
from swarm_loc_estimator.swarm.swarm import MAP_BY_TOPIC, Radio, Swarm

SENSORS: dict[str, type[Sensor]] = {
    sensor.name: sensor
    for sensor in (
        OdometrySensor,
        TurnRateSensor,
        CameraSensor,
        BrightnessSensor,
        FixSensor,
        RangeSensor,
        ScanSensor,
        AerialSensor,
        MapSensor,
    )
}
"""All sensors by name. Simultaneous measurements are fused in this order."""
_FAR_NS = 2**62  # Largest stamp, 146 years after 1970
_FIRST_OWN_MODEL = 1000  # Number of the first model of a sensor that is registered


def register(sensor: type[Sensor]) -> type[Sensor]:
    """Add a sensor, and its model if it has one; may be used as a decorator of its class.

    Raises:
        ValueError: There is a sensor of its name, or it gates other than 1, 2 or 3 components.
    """
    if sensor.name in SENSORS:
        raise ValueError(f"there is a sensor '{sensor.name}' already")
    if sensor.components:
        sensor.model = max([_FIRST_OWN_MODEL, *(number + 1 for number in MODELS)])
        names, gated = sensor.components, len(sensor.components)
        angles = sensor.is_angle[:gated]
        model = MeasurementModel(sensor.name, sensor.model, names, angles, gated, sensor.predict)
        register_model(model)
    SENSORS[sensor.name] = sensor
    return sensor


TRUTH = "ground_truth"  # Topic of the ground truth of a robot
THE_SWARM = -1  # Robot index of topics about the whole swarm


def kinds() -> dict[str, InputKind]:
    """All kinds of topics by name, shared topics last."""
    found = [kind for sensor in SENSORS.values() for kind in sensor.kinds()]
    return {kind.name: kind for kind in sorted(found, key=lambda kind: bool(kind.stands_for))}


@dataclass(frozen=True)
class InputTopic:
    """Input topic."""

    name: str  # Relative topic name, such as `<robot>/odom`
    kind: InputKind  # Kind of the topic
    robot: int  # Index into `Swarm.sources`, or THE_SWARM
    # True if missing messages are an error; False for detections of a robot without camera
    expected: bool = True
    device: int = 0  # Address of the other radio on the topic of a pair; number among `InputKind.topics_of`


def input_topics(swarm: Swarm, *, maps: bool = False) -> tuple[InputTopic, ...]:
    """All possible input topics of a swarm: of each robot, of each fixed camera, then of the swarm.

    With `maps` also those that are of use to a mapper, or in a map that is not described. Raises UserError if
    `Swarm.topics` has a topic that is not read, or two topics are the same.
    """
    each = [kind for kind in kinds().values() if kind.of_each]
    known = {TRUTH, *(kind.topic for kind in each)}
    further = {topic for robot in swarm.robots for kind in each for topic in kind.topics_of(robot)[1:]}
    if taken := sorted(further & {*known, "pose"}):
        raise UserError(f"lidar.others has {taken[0]}, but that is another topic of the robot.")
    known |= further
    if unknown := [key for key in swarm.topics if key.partition("/")[2] not in known]:
        raise UserError(f"topics has {unknown[0]}, but topics of robots are {', '.join(sorted(known))}.")
    of_robots = (
        InputTopic(swarm.topic(robot.name, topic), kind, index, kind.expected_of(robot), number)
        for index, robot in enumerate(swarm.robots)
        for kind in each
        if not kind.of_pairs
        and not (swarm.range_topic and kind.name == RangeSensor.name)
        and (kind.expected_of(robot) or not kind.only_expected)
        and (maps or swarm.map is not None or not kind.needs_map or robot.lidar.sees_robots)
        for number, topic in enumerate(kind.topics_of(robot))
    )
    of_cameras = (
        InputTopic(swarm.topic(camera.name, kind.topic), kind, index)
        for index, camera in enumerate(swarm.cameras, len(swarm.robots))
        for kind in kinds().values()
        if kind.of_cameras
    )
    of_swarm = (
        InputTopic(kind.topic, kind, THE_SWARM, not kind.stands_for and kind.is_expected_of(swarm))
        for kind in kinds().values()
        if not kind.of_each and (swarm.map == MAP_BY_TOPIC or not kind.needs_map)
    )
    found = (*of_robots, *_of_pairs(swarm), *of_cameras, *of_swarm)
    if twice := [name for name, count in Counter(one.name for one in found).items() if count > 1]:
        raise UserError(f"{twice[0]} is the topic of two inputs: correct topics or range_topic.")
    return found


def _of_pairs(swarm: Swarm) -> Iterator[InputTopic]:
    """Topics of the ranges of two radios, in both orders; at least one of them is on a robot."""
    radios: list[tuple[Radio, int]]
    radios = [(one.uwb, k) for k, one in enumerate(swarm.robots) if one.uwb is not None]
    radios += [(anchor, THE_SWARM) for anchor in swarm.anchors]
    kind = kinds()[RangeSensor.PAIRS]
    for (one, own), (other, robot) in itertools.permutations(radios if swarm.range_topic else (), 2):
        name = swarm.range_topic.format(**{"from": one.word, "to": other.word})
        if own != THE_SWARM:
            yield InputTopic(name, kind, own, expected=False, device=other.address)
        elif robot != THE_SWARM:
            yield InputTopic(name, kind, robot, expected=False, device=one.address)


def live_topics(swarm: Swarm, *, shared: bool) -> tuple[InputTopic, ...]:
    """Topics to subscribe to: those of each robot or, with `shared`, the shared topics that replace them."""
    stood_for = {kind.stands_for for kind in kinds().values() if kind.is_shared}
    if not shared:
        return tuple(topic for topic in input_topics(swarm) if not topic.kind.is_shared)
    return tuple(
        replace(topic, expected=topic.kind.is_expected_of(swarm)) if topic.kind.is_shared else topic
        for topic in input_topics(swarm)
        if topic.robot == THE_SWARM
        or topic.robot >= len(swarm.robots)  # of a fixed camera
        or (topic.kind.rows not in stood_for and topic.kind.expected_of(swarm.robots[topic.robot]))
    )


@dataclass(frozen=True)
class Batch:
    """Readings of an interval of monotonic arrival time, as they came or converted by `InputConverter`."""

    begin_ns: int  #: Arrival of the first message
    end_ns: int  #: Arrival of the last message
    #: Readings by sensor, in order of arrival; sensors without readings are omitted. Converted, those that
    #: need no other readings are `Measurements`
    rows: Mapping[str, Any] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)  #: Number of unreadable readings by reason
    is_converted: bool = False  #: Whether only valid readings are left

    @classmethod
    def of(cls, begin_ns: int, end_ns: int, **rows: Any) -> Batch:
        """Create a batch; keywords are names of sensors.

        Raises:
            TypeError: There is no such sensor, or readings are not its columns of equal length.
        """
        for name, given in rows.items():
            if name not in SENSORS:
                raise TypeError(f"there is no sensor '{name}', only {', '.join(SENSORS)}")
            columns = type(SENSORS[name].nothing())
            if not isinstance(given, columns) or len({len(column) for column in given}) != 1:
                raise TypeError(f"{name} must be {columns.__name__} with columns of equal length")
        return cls(begin_ns, end_ns, rows)

    @classmethod
    def of_columns(
        cls, swarm: Swarm, begin_ns: int, now_ns: int, readings: Mapping[str, Mapping[str, Any]]
    ) -> Batch:
        """Create a batch from columns by sensor, see `Estimator.step`.

        Nothing arrives before `begin_ns`; readings without `arrival_ns` arrive at their stamps, but not after
        `now_ns`. Raises TypeError if there is no such sensor, robot or column, or a column has another length
        or shape.
        """
        rows = {}
        for name, given in readings.items():
            if name not in SENSORS:
                raise TypeError(f"there is no sensor '{name}', only {', '.join(SENSORS)}")
            stamp_ns = _stamps_ns(name, given)
            columns = {key: column for key, column in given.items() if key != "stamp_s"}
            columns |= {"stamp_ns": stamp_ns, "robot": _robots(swarm, name, given, stamp_ns.size)}
            arrival_ns = columns.get("arrival_ns", np.minimum(stamp_ns, now_ns))
            columns["arrival_ns"] = np.maximum(arrival_ns, begin_ns)
            made = SENSORS[name].rows(columns)
            rows[name] = select(made, np.argsort(made.arrival_ns, kind="stable"))
        arrivals_ns = [int(one.arrival_ns[0]) for one in rows.values() if one.robot.size]
        return cls(min([now_ns, *arrivals_ns]), now_ns, rows)

    def __getitem__(self, sensor: str) -> Any:
        """The readings of a sensor."""
        rows = self.rows.get(sensor)
        return SENSORS[sensor].nothing() if rows is None else rows

    def until_each(self, stamps_ns: IntArray) -> Iterator[Batch]:
        """Split at instants (s,) into s + 1 parts by arrival time."""
        places = {
            name: [0, *np.searchsorted(one.arrival_ns, stamps_ns).tolist(), one.arrival_ns.size]
            for name, one in self.rows.items()
        }
        begin_ns = self.begin_ns
        for k, end_ns in enumerate([*stamps_ns.tolist(), self.end_ns]):
            parts = {name: slice(*places[name][k : k + 2]) for name in self.rows}
            rows = {name: select(one, parts[name]) for name, one in self.rows.items()}
            dropped = {} if k else self.dropped
            yield replace(self, begin_ns=begin_ns, end_ns=end_ns, rows=rows, dropped=dropped)
            begin_ns = end_ns


def gathered(parts: Iterable[Batch], sensor: str) -> Any:
    """All readings of a sensor in batches."""
    return concatenate([SENSORS[sensor].nothing(), *(part[sensor] for part in parts)])


def _stamps_ns(sensor: str, given: Mapping[str, Any]) -> IntArray:
    """Stamps (k,) of columns with `stamp_s` or `stamp_ns`."""
    if not isinstance(given, Mapping):
        raise TypeError(f"{sensor} must be columns by name, not {given!r}")
    if ("stamp_s" in given) == ("stamp_ns" in given):
        raise TypeError(f"{sensor} needs either the column 'stamp_s' or 'stamp_ns'")
    name = "stamp_ns" if "stamp_ns" in given else "stamp_s"
    stamps = np.atleast_1d(np.asarray(given[name]))
    if stamps.ndim != 1 or stamps.dtype.kind not in "iuf" or not np.isfinite(stamps).all():
        raise TypeError(f"{sensor}: {name} must be finite numbers (k,)")
    stamps = stamps if name == "stamp_ns" else np.round(1e9 * stamps)
    far_ns = (np.uint64 if stamps.dtype.kind == "u" else np.int64)(_FAR_NS)
    found: IntArray = np.clip(stamps, 0 if stamps.dtype.kind == "u" else -far_ns, far_ns).astype(np.int64)
    return found


def _robots(swarm: Swarm, sensor: str, given: Mapping[str, Any], count: int) -> IntArray:
    """Indices (k,) of columns with `robot`: names or indices, or one for all."""
    if not SENSORS[sensor].of_each:
        return np.full(count, THE_SWARM)
    if "robot" not in given:
        raise TypeError(f"{sensor}: the column 'robot' is missing")
    sources = swarm.sources if SENSORS[sensor].of_cameras else swarm.robots
    index = {key: k for k, one in enumerate(sources) for key in (one.name, k)}
    robots = np.atleast_1d(np.asarray(given["robot"])).tolist()
    if len(robots) not in {1, count}:
        raise TypeError(f"{sensor}: robot has {len(robots)} values, not {count}")
    unknown = [one for one in robots if one not in index]
    if unknown:
        raise TypeError(f"{sensor}: there is no robot or camera {unknown[0]!r}")
    found: IntArray = np.broadcast_to([index[one] for one in robots], count)
    return found


class InputConverter:
    """Converts batches of a swarm to measurements; what is dropped is counted in `drops`."""

    def __init__(self, swarm: Swarm, settings: SensorSettings) -> None:
        self.drops = DropCounts(len(swarm.sources))
        self.accumulators: dict[str, Accumulator] = {  # By sensor
            name: sensor.accumulator(swarm)
            for name, sensor in SENSORS.items()
            if sensor.accumulator is not None
        }
        self._sensors = {name: sensor(swarm, settings, self.drops) for name, sensor in SENSORS.items()}
        self._future_ns = round(settings.future_tolerance_s * 1e9)
        self._robots, self._landmarks = len(swarm.robots), len(swarm.surveyed)

    def convert(self, batch: Batch) -> Batch:
        """Convert valid readings; count the others in `drops`."""
        self.drops.total.update(batch.dropped)
        kept: dict[str, Any] = {}
        for name, sensor in SENSORS.items():
            rows = batch.rows.get(name)
            if rows is None or not rows.robot.size:
                continue
            late = rows.stamp_ns > rows.arrival_ns + self._future_ns
            if late.any():
                self.drops.add("future_stamp", rows.robot[late])
                rows = select(rows, ~late)
            with guarded(name, rows.robot.size, self.drops.total):
                found = self._sensors[name].measure(rows)
                is_measured = sensor.accumulator is None and sensor.unit is not None
                kept[name] = self._valid(found) if is_measured else found
        return replace(batch, rows=kept, dropped={}, is_converted=True)

    def _valid(self, found: Any) -> Measurements:
        """Select valid measurements; count the others in `drops`."""
        if not isinstance(found, Measurements):
            raise TypeError(f"measure must return Measurements, not {type(found).__name__}")
        reasons = reject_reasons(found)
        reasons[~is_about_swarm(found, self._robots, self._landmarks)] = BAD_MEASUREMENT
        for k in set(reasons[reasons != VALID].tolist()):
            self.drops.add(REJECT_REASONS[k], found.received_from[reasons == k])
        return found if not reasons.any() else select(found, reasons == VALID)


MAX_PAUSE_NS = 3_600_000_000_000
"""Maximum time between arrivals; beyond it the clock was set, as on a robot without a hardware clock."""

CLOCKS_APART_S = 0.2  # Difference between the clock of a robot and those of the others that is named [s]

_OF_MESSAGES = ("received", "malformed", "first_arrival_ns", "last_arrival_ns")
_LATE = ("late_sum_ns", "late_min_ns", "late_max_ns", "late_count")
# as floats, since a sum of absurd delays exceeds int64
_TYPES = {"late_sum_ns": np.float64}
_STATISTICS_DTYPE = np.dtype([(name, _TYPES.get(name, np.int64)) for name in (*_OF_MESSAGES, *_LATE)])


class InputStatistics:
    """Message statistics of one topic, by a row (1,) of counters."""

    def __init__(self, row: NDArray[np.void]) -> None:
        self._row = row

    @property
    def received(self) -> int:
        """Number of messages, malformed ones included."""
        return int(self._row["received"][0])

    @property
    def malformed(self) -> int:
        """Number of malformed messages."""
        return int(self._row["malformed"][0])

    @property
    def last_arrival_ns(self) -> int | None:
        """Arrival of the newest valid message; None before the first."""
        return int(self._row["last_arrival_ns"][0]) if self.received > self.malformed else None

    @property
    def mean_period_ns(self) -> float | None:
        """Mean period of valid messages; None before the second."""
        row, count = self._row[0], self.received - self.malformed
        return float(row["last_arrival_ns"] - row["first_arrival_ns"]) / (count - 1) if count > 1 else None

    @property
    def late_count(self) -> int:
        """Number of valid messages since `restart`."""
        return int(self._row["late_count"][0])

    @property
    def late_sum_ns(self) -> int:
        """Sum of delays (arrival minus stamp) since `restart`."""
        return int(self._row["late_sum_ns"][0])

    @property
    def late_min_ns(self) -> int | None:
        """Minimum delay since `restart`; None without messages."""
        return int(self._row["late_min_ns"][0]) if self.late_count else None

    @property
    def late_max_ns(self) -> int | None:
        """Maximum delay since `restart`; None without messages."""
        return int(self._row["late_max_ns"][0]) if self.late_count else None

    def restart(self) -> None:
        """Start a new interval for the delays."""
        for name in _LATE:
            self._row[name] = 0


class WrongClock(NamedTuple):
    """A robot's clock that is not that of the other robots."""

    apart_s: float  # Its time minus theirs [s], as its description corrects it
    offset_s: float  # `clock.offset_s` of its description that corrects it

    @property
    def problem(self) -> str:
        """What is wrong, the rest of a sentence."""
        which = "ahead of" if self.apart_s > 0.0 else "behind"
        return f"has a clock {abs(self.apart_s):.2g} s {which} those of the other robots"

    @property
    def remedy(self) -> str:
        """What to do, a sentence without its full stop."""
        synchronize = "Synchronize it with the others (chrony)"
        if abs(self.offset_s) > MAX_OFFSET_S:  # such as a clock that began in 1970
            return synchronize
        return f"{synchronize}, or set clock.offset_s to {round(self.offset_s, 3)}"


class Ingest:
    """Decodes the messages of a swarm's topics, of all possible ones if None are given.

    `map_frame` is the name of the frame `map` in messages.
    """

    def __init__(
        self, swarm: Swarm, map_frame: str = "map", topics: tuple[InputTopic, ...] | None = None
    ) -> None:
        # The index is the topic's number in a batch
        self.topics = input_topics(swarm) if topics is None else topics
        self.map_frame = map_frame
        self.handle_of: Mapping[str, int] = {topic.name: handle for handle, topic in enumerate(self.topics)}
        self._robot = np.array([topic.robot for topic in self.topics], dtype=np.int64)
        self._kinds = [*kinds().values()]
        place = {kind.name: number for number, kind in enumerate(self._kinds)}
        self._kind = np.array([place[topic.kind.name] for topic in self.topics], dtype=np.int64)
        offsets_s = [robot.clock.offset_s for robot in swarm.robots] + [0.0] * (len(swarm.cameras) + 1)
        self._clock_offset_ns = np.round(1e9 * np.array(offsets_s)).astype(np.int64)  # the last: the swarm
        self._corrects_clocks = bool(self._clock_offset_ns.any())
        devices = np.array([topic.device for topic in self.topics], dtype=np.uint64)
        key = swarm_key(robot.name for robot in swarm.robots)
        self._known = Known(map_frame, len(swarm.robots), key, devices)
        self._readers = [kind.create_reader(len(self.topics), self._known) for kind in self._kinds]
        self._counted = np.zeros(len(self.topics), dtype=_STATISTICS_DTYPE)
        self.statistics = [InputStatistics(self._counted[k : k + 1]) for k in range(len(self.topics))]

    def read(self, batch: MessageBatch) -> Iterator[Batch]:
        """Decode messages in order of arrival, with topic numbers as in `topics`.

        Yields:
            One part per interval in which time neither jumps back nor ahead.
        """
        passed_ns = np.diff(batch.log_ns)
        jumps = np.flatnonzero((passed_ns < 0) | (passed_ns > MAX_PAUSE_NS)) + 1
        for begin, end in itertools.pairwise([0, *jumps.tolist(), batch.size]):
            if begin < end:
                yield self._read_forwards(batch.chosen(slice(begin, end)))

    def received(self) -> dict[str, int]:
        """Number of messages by kind of topic, such as `<robot>/odom`; kinds without any are omitted."""
        received = np.bincount(self._kind, weights=self._counted["received"], minlength=len(self._kinds))
        counts = {kind.pattern: int(received[number]) for number, kind in enumerate(self._kinds)}
        return {topic: count for topic, count in counts.items() if count}

    def frame_id(self, handle: int) -> str:
        """Frame of the newest message on a topic, "" before the first."""
        frame_ids: list[str] = self._readers[self._kind[handle]].frame_ids
        return frame_ids[handle]

    def clocks_apart(self) -> dict[int, WrongClock]:
        """Clocks of robots, by index, that are not those of the other robots.

        They are compared by the least delays of odometry. Which of two robots is wrong cannot be seen, so
        there must be three. Shared topics are not compared, since their messages have one stamp.
        """
        delay_ns = {
            topic.robot: statistics.late_min_ns
            for topic, statistics in zip(self.topics, self.statistics, strict=True)
            if topic.kind.rows == "odometry" and topic.kind.of_each and statistics.late_min_ns is not None
        }
        if len(delay_ns) < 3:
            return {}
        usual_ns = float(np.median([*delay_ns.values()]))
        apart_s = {robot: 1e-9 * (usual_ns - one_ns) for robot, one_ns in delay_ns.items()}
        return {
            robot: WrongClock(one_s, one_s + 1e-9 * float(self._clock_offset_ns[robot]))
            for robot, one_s in apart_s.items()
            if abs(one_s) > CLOCKS_APART_S
        }

    def _read_forwards(self, batch: MessageBatch) -> Batch:
        of_message = self._kind[batch.topic]
        present = np.bincount(of_message, minlength=len(self._kinds))
        rows: dict[str, Any] = {}
        dropped: Counter[str] = Counter()
        for number, (kind, reader) in enumerate(zip(self._kinds, self._readers, strict=True)):
            if not present[number]:
                continue
            part = batch if present[number] == batch.size else batch.chosen(of_message == number)
            with guarded(kind.name, part.size, dropped):
                found = reader.read(part)
                robot, corrects = self._robot[part.topic], self._corrects_clocks and not kind.in_map
                stamp_ns = found.stamp_ns - self._clock_offset_ns[robot] if corrects else found.stamp_ns
                _count(self._counted, part.topic, part.log_ns, stamp_ns, found.valid)
                read, unused = kind.columns_of(found, part, robot, self._known)
                if corrects:
                    read = read._replace(stamp_ns=read.stamp_ns - self._clock_offset_ns[read.robot])
                # a sensor may have both topics of single robots and shared ones
                before = rows.get(kind.rows)
                rows[kind.rows] = read if before is None else in_order_of_arrival([before, read])
                dropped.update(unused)
                dropped["bad_message"] += int(np.sum(~found.valid))
        return Batch(int(batch.log_ns[0]), int(batch.log_ns[-1]), rows, +dropped)


@cached_njit
def _count(
    counted: NDArray[np.void], topic: IntArray, arrival_ns: IntArray, stamp_ns: IntArray, valid: BoolArray
) -> None:
    """Add messages (n,) to the statistics (t,) of their topics."""
    for k in range(topic.size):
        one = counted[topic[k]]
        one.received += 1
        if not valid[k]:
            one.malformed += 1
            continue
        if one.received - one.malformed == 1:
            one.first_arrival_ns = arrival_ns[k]
        late_ns = arrival_ns[k] - stamp_ns[k]
        one.last_arrival_ns = arrival_ns[k]
        one.late_min_ns = min(one.late_min_ns, late_ns) if one.late_count else late_ns
        one.late_max_ns = max(one.late_max_ns, late_ns) if one.late_count else late_ns
        one.late_sum_ns += late_ns
        one.late_count += 1
