"""Constraints by sightings on the pose of the odometry track of a robot that is not localized."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2_scalar import carry, composed, wrap
from swarm_loc_estimator.common.small_matrix import assign, assign_matrix
from swarm_loc_estimator.filter.belief import BeliefArrays, covariance_within
from swarm_loc_estimator.filter.measurement_model import NOBODY, POLAR, MeasurementArray

CONSTRAINT_DTYPE = np.dtype(
    [
        ("stamp_ns", np.int64),
        ("marker_id", np.int64),
        ("other", np.int64),  # the robot on the other side, or NOBODY
        ("landmark", np.int64),  # the landmark on the other side, or -1
        (
            "column",
            np.int64,
        ),  # first filter column of the other side's error, -1: it has none; once `refreshed`
        ("local_x", np.float64),  # point in the track's frame [m]
        ("local_y", np.float64),
        ("local_xx", np.float64),  # its covariance
        ("local_xy", np.float64),
        ("local_yy", np.float64),
        ("map_x", np.float64),  # the same point in map [m]
        ("map_y", np.float64),
        ("map_xx", np.float64),  # its covariance, that of the other side only once `refreshed`
        ("map_xy", np.float64),
        ("map_yy", np.float64),
        ("turn", np.float64),  # heading of the transform that the sighting shows [rad], NaN: none
        ("other_turn", np.float64),  # of its mirrored solution, NaN: none
        ("turn_variance", np.float64),
        ("track_noise", np.float64, (3, 3)),  # preintegrated covariance of the track
        ("frame", np.float64, (3,)),  # frame of the other side's error: T, or a landmark's correction
        ("frame_noise", np.float64, (3, 3)),  # preintegrated covariance of the other side's track
        ("shared", np.float64, (3, 3)),  # covariance of the other side's error, once `refreshed`
    ]
)

ConstraintArray = NDArray[np.void]
Constraint = Any  # A row of a ConstraintArray inside compiled code, where the fields are attributes

NO_CONSTRAINTS: ConstraintArray = np.zeros(0, dtype=CONSTRAINT_DTYPE)
_MAX_CONSTRAINTS = 20


class Waiting(NamedTuple):
    """A robot without a pose at the time of a sighting by or of it."""

    robot: int  # Its index
    pose: FloatArray  # (3,) on its track
    covariance: FloatArray  # (3, 3) preintegrated until then


class OtherSide(NamedTuple):
    """The other side of a sighting: a localized robot, a landmark, or the map itself."""

    robot: int  # Its index, or NOBODY
    landmark: int  # Index of the landmark; -1: none
    pose: FloatArray  # (3,) in `map` at the stamp; for a landmark, its displacement from the survey
    frame: FloatArray  # (3,) frame of its error: T of a robot, the pose of a landmark
    noise: FloatArray  # (3, 3) covariance of its track preintegrated until the stamp


THE_MAP = OtherSide(NOBODY, -1, np.zeros(3), np.zeros(3), np.zeros((3, 3)))


def with_constraint(
    constraints: ConstraintArray,
    one: MeasurementArray,
    camera: FloatArray,
    waiting: Waiting,
    other: OtherSide,
    window_ns: int,
) -> ConstraintArray:
    """Constraints (k,) and that of a newer measurement (1,); of too many, the most redundant one is dropped.

    Args:
        constraints: In order of time; not changed.
        one: Between the robot and a localized side.
        camera: (2,) estimated yaw offset [rad] and scale error of its sensor.
        waiting: The robot without a pose.
        other: The localized side.
        window_ns: Age up to which constraints are kept.
    """
    out = np.empty(_MAX_CONSTRAINTS + 1, dtype=CONSTRAINT_DTYPE)
    count = _take_over(constraints, one, window_ns, out)
    _describe(one, camera, waiting, other, out[count : count + 1])
    if count < _MAX_CONSTRAINTS:
        return out[: count + 1]
    _thin_out(out)
    return out[:_MAX_CONSTRAINTS]


@cached_njit
def _take_over(
    constraints: ConstraintArray, one: MeasurementArray, window_ns: int, out: ConstraintArray
) -> int:
    """Write the constraints (k,) within the window before a measurement (1,); return their number."""
    count = 0
    for k in range(constraints.size):
        if constraints[k].stamp_ns >= one[0].stamp_ns - window_ns:
            out[count] = constraints[k]
            count += 1
    return count


@cached_njit
def _thin_out(constraints: ConstraintArray) -> None:
    """Move the constraint (of k, in order of time) that leaves the smallest gap for its age to the end.

    Gaps are between constraints of one marker. Where no marker has three constraints, it is the oldest one.
    """
    least, gone = math.inf, 0
    newest_ns = constraints[constraints.size - 1].stamp_ns
    for k in range(constraints.size):
        before, after = -1, -1
        for i in range(constraints.size):
            if (
                constraints[i].marker_id == constraints[k].marker_id
                and constraints[i].other == constraints[k].other
            ):
                if i < k:
                    before = i
                elif i > k and after < 0:
                    after = i
        if before >= 0 and after >= 0:
            gap = (constraints[after].stamp_ns - constraints[before].stamp_ns) / max(
                1, newest_ns - constraints[k].stamp_ns
            )
            if gap < least:
                least, gone = gap, k
    for k in range(gone, constraints.size - 1):
        constraints[k] = constraints[k + 1]


@cached_njit
def turned(xx: float, xy: float, yy: float, cos: float, sin: float) -> tuple[float, float, float]:
    """A covariance xx, xy, yy rotated by an angle."""
    across = 2.0 * cos * sin * xy
    return (
        cos * cos * xx - across + sin * sin * yy,
        cos * sin * (xx - yy) + (cos * cos - sin * sin) * xy,
        sin * sin * xx + across + cos * cos * yy,
    )


@cached_njit
def spread_at(spread: FloatArray, x: float, y: float) -> tuple[float, float, float]:
    """Covariance xx, xy, yy of a point on a frame whose right-invariant error has the covariance (3, 3)."""
    return (
        spread[0, 0] - 2.0 * y * spread[0, 2] + y * y * spread[2, 2],
        spread[0, 1] + x * spread[0, 2] - y * spread[1, 2] - x * y * spread[2, 2],
        spread[1, 1] + 2.0 * x * spread[1, 2] + x * x * spread[2, 2],
    )


@cached_njit
def _describe(
    measurements: MeasurementArray,
    camera: FloatArray,
    waiting: Waiting,
    other: OtherSide,
    constraints: ConstraintArray,
) -> None:
    """Write the constraint (1,) of a measurement (1,), see `with_constraint`."""
    one, constraint = measurements[0], constraints[0]
    value, covariance, sensor, marker = one.value, one.covariance, one.sensor, one.marker
    sees, track = one.observer == waiting.robot, waiting.pose
    on_track, on_map = (sensor, marker) if sees else (marker, sensor)
    lx, ly, ltheta = composed(track[0], track[1], track[2], on_track[0], on_track[1], on_track[2])
    base = other.pose
    mx, my, mtheta = composed(base[0], base[1], base[2], on_map[0], on_map[1], on_map[2])
    if sees:
        ltheta += camera[0]
    else:
        mtheta += camera[0]
    x, y, angle = value[0], value[1], ltheta if sees else mtheta
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    if one.kind == POLAR:  # along and across the line of sight
        x, y, angle = value[0], 0.0, angle + value[1]
        xy, yy = value[0] * xy, value[0] * value[0] * yy
    size = 1.0 / (1.0 + camera[1])
    x, y, xx, xy, yy = size * x, size * y, size * size * xx, size * size * xy, size * size * yy
    cos, sin = math.cos(angle), math.sin(angle)
    x, y = cos * x - sin * y, sin * x + cos * y
    xx, xy, yy = turned(xx, xy, yy, cos, sin)
    constraint.stamp_ns, constraint.marker_id = one.stamp_ns, one.marker_id
    constraint.other, constraint.landmark = other.robot, other.landmark
    # the measurement noise acts on the side of the sensor: on the track or on the map
    local, there, sign = (1.0, 0.0, 1.0) if sees else (0.0, 1.0, -1.0)
    constraint.local_x, constraint.local_y = lx + local * x, ly + local * y
    constraint.local_xx, constraint.local_xy, constraint.local_yy = local * xx, local * xy, local * yy
    constraint.map_x, constraint.map_y = mx + there * x, my + there * y
    constraint.map_xx, constraint.map_xy, constraint.map_yy = there * xx, there * xy, there * yy
    constraint.turn = constraint.other_turn = math.nan
    if one.has_heading:
        constraint.turn = mtheta - ltheta - sign * value[2]
    if one.has_alternative:
        constraint.other_turn = mtheta - ltheta - sign * one.alternative[2]
    constraint.turn_variance = covariance[2, 2]
    assign_matrix(constraint.track_noise, waiting.covariance)
    assign(constraint.frame, other.frame)
    assign_matrix(constraint.frame_noise, other.noise)


@cached_njit
def refreshed(constraints: ConstraintArray, belief: BeliefArrays) -> ConstraintArray:
    """Constraints (k,) moved to the present estimates of their other sides, without those of lost robots.

    So the errors of another side are the same in all its constraints, and can be shared with the robot that
    is initialized from them.
    """
    out = np.empty_like(constraints)
    count = 0
    none, drift, shared, spread = np.zeros((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(constraints.size):
        robot, mark, constraint = constraints[k].other, constraints[k].landmark, out[count]
        if robot >= 0 and not belief.tracked[robot]:
            continue
        count += 1
        out[count - 1] = constraints[k]
        assign_matrix(constraint.shared, none)
        column = 3 * robot if robot >= 0 else (belief.table.survey_column[mark] if mark >= 0 else -1)
        constraint.column = column
        if column < 0:
            continue
        now = belief.transform[robot] if robot >= 0 else belief.landmark[mark]
        turn = _move(constraint, now)
        for i in range(3):
            for j in range(3):
                shared[i, j] = covariance_within(belief, column, i, j)
                drift[i, j] = 0.0
                if robot >= 0:
                    drift[i, j] = constraint.frame_noise[i, j] - belief.preintegrated_covariance[robot, i, j]
        sign = 1.0 if drift[0, 0] + drift[1, 1] + drift[2, 2] > 0.0 else -1.0
        carry(now, drift, spread)
        for i in range(3):
            for j in range(3):
                spread[i, j] = shared[i, j] + sign * spread[i, j]
        assign_matrix(constraint.shared, shared)
        xx, xy, yy = turned(
            constraint.map_xx, constraint.map_xy, constraint.map_yy, math.cos(turn), math.sin(turn)
        )
        at_xx, at_xy, at_yy = spread_at(spread, constraint.map_x, constraint.map_y)
        constraint.map_xx, constraint.map_xy, constraint.map_yy = xx + at_xx, xy + at_xy, yy + at_yy
        constraint.turn_variance += spread[2, 2]
    return out[:count]


@cached_njit
def _move(constraint: Constraint, frame: FloatArray) -> float:
    """Move a constraint's place on the map and its heading with its frame; return the rotation."""
    then = constraint.frame
    turn = wrap(frame[2] - then[2])
    cos, sin = math.cos(turn), math.sin(turn)
    dx, dy = constraint.map_x - then[0], constraint.map_y - then[1]
    constraint.map_x, constraint.map_y = frame[0] + cos * dx - sin * dy, frame[1] + sin * dx + cos * dy
    constraint.turn += turn
    constraint.other_turn += turn
    return turn
