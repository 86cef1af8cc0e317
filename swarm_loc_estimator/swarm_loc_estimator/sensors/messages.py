"""Inputs in columns: raw as the robots sent them, and valid as the estimator takes them in.

Each kind of input has a tuple of columns of its own, all of the same length, among them `robot`, `stamp_ns`
and `arrival_ns`; its rows are in order of arrival.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.measurement_model import MEASUREMENT_DTYPE, MeasurementArray

Rows = TypeVar("Rows", bound="tuple[NDArray[Any], ...]")


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


class OdometryRows(NamedTuple):
    """Odometry messages (k,).

    Attributes:
        robot: (k,) index of the robot.
        stamp_ns: (k,) acquisition stamps.
        pose: (k, 3) x [m], y [m], yaw [rad] in the robot's own odom frame.
        arrival_ns: (k,).
    """

    robot: IntArray
    stamp_ns: IntArray
    pose: FloatArray
    arrival_ns: IntArray


class DetectionRows(NamedTuple):
    """What cameras saw, a row per detection (d,).

    Attributes:
        robot: (d,) index of the robot that carries the camera.
        stamp_ns: (d,) exposure times.
        detection: (d,) structured, see `SightingConverter.convert`.
        arrival_ns: (d,).
    """

    robot: IntArray
    stamp_ns: IntArray
    detection: NDArray[np.void]
    arrival_ns: IntArray


class BrightnessRows(NamedTuple):
    """Brightness matrices (b,), as `swarm_loc_msgs/BrightnessMatrix` has them.

    Attributes:
        robot: (b,) index of the robot on whose topic each came.
        stamp_ns: (b,) middle of the exchange, the same for all power modes of one.
        receiver: (b,) id of the robot that measured.
        transmitter: (b,) id of the robot that lit its emitters.
        n: (b,) sensors, and emitters.
        power: (b,) index of the power mode.
        saturation: (b,) the reading from which on a sensor tells no more [count]; 0: that of the platform.
        readings: (b,) of arrays (k,) [count], row-major [sensor, emitter]; k should be n * n.
        arrival_ns: (b,).
    """

    robot: IntArray
    stamp_ns: IntArray
    receiver: IntArray
    transmitter: IntArray
    n: IntArray
    power: IntArray
    saturation: IntArray
    readings: NDArray[np.object_]
    arrival_ns: IntArray


class FixRows(NamedTuple):
    """Absolute fixes (f,).

    Attributes:
        robot: (f,) index of the robot.
        stamp_ns: (f,) when it was there.
        pose: (f, 3) x [m], y [m], heading [rad] in `map`; heading NaN: not measured.
        covariance: (f, 3, 3) of it; what it says of a heading not measured does not count.
        arrival_ns: (f,).
    """

    robot: IntArray
    stamp_ns: IntArray
    pose: FloatArray
    covariance: FloatArray
    arrival_ns: IntArray


class AerialRows(NamedTuple):
    """Anonymous detections of aerial images, a row per detection (d,).

    Attributes:
        robot: (d,) -1: they are about the whole swarm.
        stamp_ns: (d,) exposure times.
        number: (d,) of each in its message.
        pose: (d, 3) x [m], y [m], heading [rad] in `map`; heading NaN: not measured.
        covariance: (d, 3, 3) of it; a first element of -1: not known.
        arrival_ns: (d,).
    """

    robot: IntArray
    stamp_ns: IntArray
    number: IntArray
    pose: FloatArray
    covariance: FloatArray
    arrival_ns: IntArray


_NONE = np.zeros(0, dtype=np.int64)
NO_ODOMETRY = OdometryRows(_NONE, _NONE, np.zeros((0, 3)), _NONE)
NO_DETECTIONS = DetectionRows(_NONE, _NONE, np.zeros(0, dtype=[("id", np.uint32)]), _NONE)
NO_BRIGHTNESS = BrightnessRows(*(_NONE,) * 7, np.zeros(0, dtype=object), _NONE)
NO_FIXES = FixRows(_NONE, _NONE, np.zeros((0, 3)), np.zeros((0, 3, 3)), _NONE)
NO_AERIAL = AerialRows(_NONE, _NONE, _NONE, np.zeros((0, 3)), np.zeros((0, 3, 3)), _NONE)


class RawInputs(NamedTuple):
    """Messages as the robots sent them, of a stretch in which time does not go back.

    Attributes:
        begin_ns: Arrival of the first message.
        end_ns: Arrival of the last one.
        odometry: Of all robots.
        detections: Of all cameras.
        brightness: Of all infrared boards.
        fixes: Of all robots.
        aerial: Of cameras above the swarm.
        dropped: Reason -> how many more could not even be read.
    """

    begin_ns: int
    end_ns: int
    odometry: OdometryRows = NO_ODOMETRY
    detections: DetectionRows = NO_DETECTIONS
    brightness: BrightnessRows = NO_BRIGHTNESS
    fixes: FixRows = NO_FIXES
    aerial: AerialRows = NO_AERIAL
    dropped: Mapping[str, int] = MappingProxyType({})


class ValidInputs(NamedTuple):
    """Data that has been looked through and converted, in order of arrival.

    Attributes:
        odometry: Finite poses.
        brightness: Valid matrices; what they measure depends on those that come later.
        measurements: (m,) with finite values and valid covariances.
        measured_ns: (m,) when they arrived.
    """

    odometry: OdometryRows
    brightness: BrightnessRows
    measurements: MeasurementArray
    measured_ns: IntArray

    def until_each(self, stamps_ns: IntArray) -> Iterator[ValidInputs]:
        """What arrived before the first instant (s,), between it and the next, ..., and from the last on."""
        odometry = _between(self.odometry.arrival_ns, stamps_ns)
        brightness = _between(self.brightness.arrival_ns, stamps_ns)
        measured = _between(self.measured_ns, stamps_ns)
        for k in range(len(stamps_ns) + 1):
            yield ValidInputs(
                chosen(self.odometry, odometry[k]),
                chosen(self.brightness, brightness[k]),
                self.measurements[measured[k]],
                self.measured_ns[measured[k]],
            )


NO_MEASUREMENTS: MeasurementArray = np.zeros(0, dtype=MEASUREMENT_DTYPE)


def _between(arrivals_ns: IntArray, stamps_ns: IntArray) -> list[slice]:
    """Which arrivals (k,), not decreasing, lie before, between and behind instants (s,): s + 1 slices."""
    ends = [*np.searchsorted(arrivals_ns, stamps_ns).tolist(), arrivals_ns.size]
    return [slice(begin, end) for begin, end in zip([0, *ends], ends, strict=False)]
