"""Measurements as columns: what was measured, by whom, of whom, how well.

Each measurement compares a value with its prediction from the poses of two sides: the observer, on which the
sensor is mounted, and the target, which carries the marker or antenna. `models.py` has the models.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple, TypeVar

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray

NOBODY = -1  # Index of the observer of an absolute fix, of the target of a landmark sighting, of no landmark

Rows = TypeVar("Rows", bound="tuple[Any, ...]")


class Measurements(NamedTuple):
    """Columns of measurements (m,); a row of them has scalars and vectors under the same names."""

    stamp_ns: IntArray  #: (m,) time of measurement
    received_from: IntArray  #: (m,) robot or fixed camera of the message; -1: about the whole swarm
    observer: IntArray  #: (m,) robot with the sensor; NOBODY: the sensor is fixed in `map`
    target: IntArray  #: (m,) measured robot, or NOBODY
    landmark: IntArray  #: (m,) measured landmark or anchor (index of `Swarm.surveyed`), or NOBODY
    mount: IntArray  #: (m,) fixed camera with the sensor (index of `Swarm.surveyed`), or NOBODY
    model: IntArray  #: (m,) number of the model in `models.MODELS`
    #: (m,) number that tells simultaneous measurements of two sides apart: of the marker, the radio, the
    #: detection in its image; of a scan the stamp of its first beam [ns]
    reading: IntArray
    has_heading: BoolArray  #: (m,) whether the third component of `value` was measured
    has_second: BoolArray  #: (m,) whether `second` is a second, mirrored solution
    stamp_variance: FloatArray  #: (m,) of `stamp_ns` [s^2], times how many measurements share its error
    gate: FloatArray  #: (m,) maximum accepted squared distance of the gated components
    sensor: FloatArray  #: (m, 3) x [m], y [m], yaw [rad] of the sensor in the observer's base_link, or in map
    marker: FloatArray  #: (m, 3) x [m], y [m], yaw [rad] of the marker in the target's base_link, or in map
    height: FloatArray  #: (m, 2) z [m] of sensor and marker, where the model needs it
    reference: FloatArray  #: (m, 3) x, y, z [m] in map of the reference of a range difference
    value: FloatArray  #: (m, 3) components of the model; those not measured are 0
    second: FloatArray  #: (m, 3) the second solution
    covariance: FloatArray  #: (m, 3, 3) of value; a component not measured has variance 1, no correlation
    #: (m, 3) systematic share of each variance, see `correlated_noise.py`
    systematic_share: FloatArray
    arrival_ns: IntArray  #: (m,) time of arrival; no part of the identity of a measurement

    @classmethod
    def empty(cls, count: int) -> Measurements:
        """Create `count` measurements of nobody by nobody: all numbers 0, all variances 1."""

        def zeros(*shape: int) -> FloatArray:
            return np.zeros((count, *shape))

        def whole(value: int = 0) -> IntArray:
            return np.full(count, value)

        sides = whole(NOBODY), whole(NOBODY), whole(NOBODY), whole(NOBODY), whole(NOBODY)
        flags = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        places = zeros(3), zeros(3), zeros(2), zeros(3)
        values = zeros(3), zeros(3), zeros(3, 3) + np.eye(3), zeros(3)
        return cls(whole(), *sides, whole(), whole(), *flags, zeros(), zeros(), *places, *values, whole())

    @property
    def size(self) -> int:
        """Number of measurements."""
        return int(self.stamp_ns.size)

    def row(self, k: int) -> Measurements:
        """Measurement k: scalars and vectors in place of columns."""
        return Measurements(*(column[k] for column in self))

    def columns(self) -> Measurements:
        """The row as columns (1,); the opposite of `row`."""
        columns: Any = (np.asarray(part)[None] for part in self)
        return Measurements(*columns)

    def equals(self, other: Measurements) -> bool:
        """Whether these are the same measurements in the same order, whenever they arrived."""
        both = zip(self[:-1], other[:-1], strict=True)
        return self.size == other.size and all(np.array_equal(one, there) for one, there in both)


NO_MEASUREMENTS = Measurements.empty(0)


def select(rows: Rows, some: slice | BoolArray | IntArray) -> Rows:
    """Select rows of a tuple of columns by a slice, a mask or indices."""
    if isinstance(some, slice) and some.indices(len(rows[0])) == (0, len(rows[0]), 1):
        return rows
    return type(rows)(*(column[some] for column in rows))


def concatenate(parts: Sequence[Rows]) -> Rows:
    """Concatenate tuples of columns; dtypes are those of the first."""
    if len(parts) == 1:
        return parts[0]
    # without dtype, records lose their padding and numba compiles again for the new type
    columns = (np.concatenate(column, dtype=column[0].dtype) for column in zip(*parts, strict=True))
    return type(parts[0])(*columns)


class Verdict(IntEnum):
    """Outcome of a measurement."""

    OPEN = 0  # not processed yet
    USED = 1
    GATED = 2  # rejected by the innovation gate
    CONSTRAINT = 3  # stored to initialize a robot
    NOT_LOCALIZED = 4  # neither side is localized, or a robot has no odometry yet
    UNASSIGNED = 5  # an anonymous detection that matches no robot
    AMBIGUOUS = 6  # an anonymous detection that matches several robots
    OFF_MAP = 7  # a scan that contradicts the map at the pose of its robot
    BLOCKED = 8  # a scan of which too few beams meet walls of the map
    SEVERAL_PLACES = 9  # a scan of a robot that may be at several places in the map
    NO_PLACE = 10  # a scan of a robot that is not located and fits no place in the map


_DROPS = {
    "gated": Verdict.GATED,
    "not_localized": Verdict.NOT_LOCALIZED,
    "aerial_unassigned": Verdict.UNASSIGNED,
    "aerial_ambiguous": Verdict.AMBIGUOUS,
    "scan_off_map": Verdict.OFF_MAP,
    "scan_blocked": Verdict.BLOCKED,
    "scan_ambiguous": Verdict.SEVERAL_PLACES,
    "scan_nowhere": Verdict.NO_PLACE,
}


def drops_by_reason(counts: IntArray) -> dict[str, int]:
    """Numbers of unused measurements by reason, from those by verdict (len(Verdict),)."""
    return {reason: int(counts[verdict]) for reason, verdict in _DROPS.items()}


class LossReason(IntEnum):
    """Why a robot was deinitialized; 0: it was not."""

    UNCERTAIN = 1  # its standard deviation exceeds lost_sigma or lost_heading_sigma
    REFUTED = 2  # a measurement contradicts its pose before two have confirmed it
    GATED = 3  # lost_after measurements in a row were gated
    OFF_FIXES = 4  # its absolute fixes are gated again and again
    KIDNAPPED = 5  # what it measures can only mean that it is elsewhere
    OFF_MAP = 6  # its scans contradict the map
    NOT_IN_IMAGE = 7  # aerial images do not show it where it should be
    COMMAND = 8  # a user asked for it
    FRAME = 9  # a local frame ended, and its robots are located in `map` again


class CommandKind(IntEnum):
    """What a command does to a robot."""

    SET_POSE = 1  # set it to `pose` in map with `covariance`
    FORGET = 2  # deinitialize it
    NEW_MAP = 3  # search and match all robots in another map from now on


class Command(NamedTuple):
    """A command of a user, or a new map, executed at its stamp, after the measurements of that instant."""

    stamp_ns: int
    kind: CommandKind
    robot: int
    pose: FloatArray  # (3,) in map
    covariance: FloatArray  # (3, 3) of the pose
    map: Any = None  # of `map_search.SearchMap`
