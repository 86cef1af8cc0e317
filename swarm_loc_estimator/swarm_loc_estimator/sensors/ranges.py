"""UWB: ranges between radios on robots and at anchors, and differences of two ranges.

A range is the distance between two antennas in space. Heights are known, so it has one degree of freedom in
the plane. A difference has a second antenna, the reference, which must be an anchor; where it is on a robot
and the other one is not, both change places and the sign. See doc/uwb.md.
"""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import RANGE as PAIR_TYPE
from swarm_loc_estimator.common.messages.cdr import RANGES as MESSAGE_TYPE
from swarm_loc_estimator.common.messages.cdr import CdrError, decode, nanoseconds
from swarm_loc_estimator.common.messages.streams import EachReader, MessageBatch, Messages
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements, select
from swarm_loc_estimator.filter.models import MODELS, RANGE, RANGE_DIFFERENCE
from swarm_loc_estimator.sensors.sensor import NO_ROWS, DropCounts, InputKind, Known, Sensor, SensorSettings
from swarm_loc_estimator.swarm.swarm import Robot, Swarm, UwbDevice

_FLOOR_M = 5e-3  # Least standard deviation of a range, whatever a message claims [m]


class RangeRows(NamedTuple):
    """Ranges and range differences (k,)."""

    robot: IntArray  #: (k,) index of the robot that measured
    stamp_ns: IntArray  #: (k,) time of measurement
    device: NDArray[np.uint64]  #: (k,) uint64, address of the other device
    reference: NDArray[np.uint64]  #: (k,) uint64, address of the reference; 0: a range
    range: FloatArray  #: (k,) range, or difference [m]
    variance: FloatArray  #: (k,) of `range` [m^2]; 0: that of the swarm description is used
    arrival_ns: IntArray  #: (k,) arrival times


_NO_ADDRESSES = np.zeros(0, dtype=np.uint64)
NO_RANGES = RangeRows(NO_ROWS, NO_ROWS, _NO_ADDRESSES, _NO_ADDRESSES, np.zeros(0), np.zeros(0), NO_ROWS)


class _Devices(NamedTuple):
    """All radios by ascending address (d,), the first one is none."""

    address: NDArray[np.uint64]  # (d,) uint64
    robot: IntArray  # (d,) index of its robot; -1: an anchor
    landmark: IntArray  # (d,) column `landmark` of measurements
    place: FloatArray  # (d, 3) antenna x, y, z in base_link or in `map`
    bias: FloatArray  # (d,) of its ranges [m]
    variance: FloatArray  # (d,) of an anchor as the reference: of its place and its bias [m^2]

    @classmethod
    def of(cls, swarm: Swarm) -> _Devices:
        """The radios of a swarm."""
        first = len(swarm.landmarks)
        rows = [(0, NOBODY, NOBODY, (0.0, 0.0, 0.0), 0.0, 0.0)]
        rows += [
            (u.address, k, NOBODY, (u.x, u.y, u.z), u.range_bias, 0.0)
            for k, robot in enumerate(swarm.robots)
            if (u := robot.uwb) is not None
        ]
        rows += [
            (
                *(a.address, -1, first + k, (a.x, a.y, a.z), a.range_bias),
                a.position_sigma**2 + a.range_bias_sigma**2,
            )
            for k, a in enumerate(swarm.anchors)
        ]
        address, *columns = zip(*sorted(rows), strict=True)
        return cls(np.array(address, dtype=np.uint64), *(np.array(column) for column in columns))

    def find(self, address: NDArray[np.uint64]) -> IntArray:
        """Indices (k,) of addresses (k,); 0: unknown."""
        place = np.minimum(np.searchsorted(self.address, address), self.address.size - 1)
        return np.where(self.address[place] == address, place, 0)


def decode_pair(data: bytes) -> Any:
    """Decode a sensor_msgs/Range; before ROS 2 Iron it had no variance, which stands last."""
    try:
        message = decode(data, PAIR_TYPE)
    except CdrError:
        message = decode(data + bytes(4), PAIR_TYPE)
    message.stamp_ns, message.frame_id = nanoseconds(message.header.stamp), message.header.frame_id
    return message


def _read_pairs(
    found: Messages[Any], batch: MessageBatch, robot: IntArray, known: Known
) -> tuple[RangeRows, dict[str, int]]:
    """Convert ranges of pairs; those outside of the limits that a message gives are none (REP 117)."""
    of_message = [(m.min_range, m.max_range, m.range, m.variance) for m in found.decoded]
    low, high, value, variance = np.array(of_message, dtype=float).reshape(-1, 4).T
    within = np.isfinite(value) & ((high <= low) | ((low <= value) & (value <= high)))
    kept = np.flatnonzero(found.valid)[within]
    device = known.devices[batch.topic[kept]]
    columns = found.stamp_ns[kept], device, np.zeros_like(device), value[within], variance[within]
    return RangeRows(robot[kept], *columns, batch.log_ns[kept]), {"uwb_out_of_limits": int(np.sum(~within))}


class RangeSensor(Sensor):
    """UWB radios of robots."""

    name, topic, message_type = "ranges", "ranges", MESSAGE_TYPE
    PAIRS = "range_pairs"  # Name of the kind of topics with the ranges of two radios
    only_expected = True
    optional = MappingProxyType({"reference": 0, "variance": 0.0})

    def __init__(self, swarm: Swarm, settings: SensorSettings, drops: DropCounts) -> None:
        super().__init__(swarm, settings, drops)
        self._devices = _Devices.of(swarm)
        radios = [robot.uwb or UwbDevice(0) for robot in swarm.robots]
        self._own_address = np.array([radio.address for radio in radios], dtype=np.uint64)
        self._antenna = np.array([(radio.x, radio.y, radio.z) for radio in radios]).reshape(-1, 3)
        sigma = [(radio.range_sigma, radio.difference_sigma) for radio in radios]
        self._sigma = np.array(sigma).reshape(-1, 2)
        self._scale = np.array([radio.range_scale for radio in radios])
        self._bias = np.array([radio.range_bias for radio in radios])
        self._gate = MODELS[RANGE].gate([radio.gate_probability for radio in radios])

    @classmethod
    def kinds(cls) -> tuple[InputKind, ...]:
        """Kinds of its topics: of each robot, and of each pair of radios, see `Swarm.range_topic`."""
        (own,) = super().kinds()
        pairs = replace(
            own,
            name=cls.PAIRS,
            topic="range_topic",
            message_type=PAIR_TYPE,
            create_reader=lambda topics, _: EachReader(topics, decode_pair),
            columns_of=_read_pairs,
            stands_for=cls.name,
            of_pairs=True,
        )
        return own, pairs

    @classmethod
    def columns(cls, messages: Messages[Any]) -> RangeRows:
        """Convert decoded messages (n,)."""
        if not messages.decoded:
            return NO_RANGES
        counts = [message.ranges.size for message in messages.decoded]
        ranges = np.concatenate([message.ranges for message in messages.decoded])
        robot, stamp_ns, arrival_ns = (
            np.repeat(column, counts) for column in (messages.robot, messages.stamp_ns, messages.arrival_ns)
        )
        device, reference, value, variance = (ranges[name].copy() for name in ranges.dtype.names or ())
        return RangeRows(robot, stamp_ns, device, reference, value, variance, arrival_ns)

    def measure(self, rows: RangeRows) -> Measurements:
        """Convert ranges and range differences (k,)."""
        devices = self._devices
        device, reference = devices.find(rows.device), devices.find(rows.reference)
        usable = self._usable(rows, device, reference)
        rows, device, reference = select(rows, usable), device[usable], reference[usable]
        # Subtract the biases of both ends.
        is_difference = rows.reference > 0
        value = rows.range - devices.bias[device]
        value += np.where(is_difference, devices.bias[reference], -self._bias[rows.robot])
        # The reference must be fixed: change places where only the other device is.
        swapped = is_difference & (devices.robot[reference] >= 0)
        value[swapped] *= -1.0
        device, reference = np.where(swapped, reference, device), np.where(swapped, device, reference)
        # Fill the columns.
        out, scale = Measurements.empty(rows.robot.size), self._scale[rows.robot]
        out.stamp_ns[:], out.gate[:], out.arrival_ns[:] = (
            rows.stamp_ns,
            self._gate[rows.robot],
            rows.arrival_ns,
        )
        out.received_from[:] = out.observer[:] = rows.robot
        out.model[:] = np.where(is_difference, RANGE_DIFFERENCE, RANGE)
        out.target[:], out.landmark[:] = devices.robot[device], devices.landmark[device]
        out.reading[:] = device + devices.address.size * reference
        antenna, place = self._antenna[rows.robot], devices.place[device]
        out.sensor[:, :2], out.marker[:, :2] = antenna[:, :2], place[:, :2]
        out.height[:] = np.column_stack([antenna[:, 2], place[:, 2]])
        out.reference[:] = devices.place[reference]
        out.value[:, 0] = value / scale
        described = np.square(self._sigma[rows.robot, is_difference.astype(np.int64)])
        noise = np.where(rows.variance == 0.0, described, rows.variance) / np.square(scale)
        out.covariance[:, 0, 0] = np.maximum(noise, _FLOOR_M**2) + devices.variance[reference]
        # Two robots have one link, whichever measured.
        turned = ~is_difference & (out.target >= 0) & (out.target < out.observer)
        for first, second in ((out.observer, out.target), (out.sensor, out.marker), out.height.T):
            first[turned], second[turned] = second[turned], first[turned]
        out.reading[turned] = devices.find(self._own_address)[out.target[turned]]
        return out

    def _usable(self, rows: RangeRows, device: IntArray, reference: IntArray) -> BoolArray:
        """Which readings (k,) of devices and references (k,) can be used; the others are counted."""
        own, is_difference = self._own_address[rows.robot], rows.reference > 0
        on_robots = (self._devices.robot[device] >= 0) & (self._devices.robot[reference] >= 0)
        reasons = {
            "no_uwb": own == 0,
            "uwb_own_address": (rows.device == own) | (is_difference & (rows.reference == own)),
            "uwb_unknown_address": (device == 0) | (is_difference & (reference == 0)),
            "uwb_equal_addresses": rows.device == rows.reference,
            "uwb_two_robots": is_difference & on_robots,
            "uwb_negative_range": ~is_difference & (rows.range < 0.0),
            "bad_covariance": rows.variance < 0.0,
        }
        return self.drops.screen(rows.robot, reasons)

    @classmethod
    def expected_of(cls, robot: Robot) -> bool:
        """Whether the description says that the robot has a radio."""
        return robot.uwb is not None
