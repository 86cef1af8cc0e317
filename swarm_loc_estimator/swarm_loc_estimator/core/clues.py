"""Clues: what sightings of a robot that waits to be located say about where its odometry track lies."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.compiled import assign, assign_matrix, carry, compiled, composed, wrap
from swarm_loc_estimator.core.measurements import NOBODY, POLAR, MeasurementArray
from swarm_loc_estimator.core.se2 import FloatArray

if TYPE_CHECKING:
    from swarm_loc_estimator.core.state import BeliefArrays

CLUE_DTYPE = np.dtype(
    [
        ("stamp_ns", np.int64),
        ("marker_id", np.int64),
        ("other", np.int64),  # the robot on the other side, or NOBODY
        ("column", np.int64),  # first filter column of the other side's error, -1: it has none
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
        ("track_noise", np.float64, (3, 3)),  # noise the track had gathered by then
        ("frame", np.float64, (3,)),  # where the other side's error acts: T, or what moves a landmark
        ("frame_noise", np.float64, (3, 3)),  # noise the other side's track had gathered by then
        ("shared", np.float64, (3, 3)),  # covariance of the other side's error, once `refreshed`
    ]
)

ClueArray = NDArray[np.void]
Clue = Any
"""A row of a ClueArray inside compiled code, where the fields are attributes."""

NO_CLUES: ClueArray = np.zeros(0, dtype=CLUE_DTYPE)
_MOST_CLUES = 20


class OtherSide(NamedTuple):
    """What a sighting ties a waiting robot to: a robot that is located, a landmark, or the map itself.

    Attributes:
        robot: Its index, or NOBODY.
        column: First filter column of its error; -1: it has none.
        pose: (3,) in `map` at the stamp; by what a landmark is moved from its survey.
        frame: (3,) where its error acts: T of a robot, the pose of a landmark.
        noise: (3, 3) what its track had gathered by the stamp.
    """

    robot: int
    column: int
    pose: FloatArray
    frame: FloatArray
    noise: FloatArray


THE_MAP = OtherSide(NOBODY, -1, np.zeros(3), np.zeros(3), np.zeros((3, 3)))


def with_clue(
    clues: ClueArray,
    one: MeasurementArray,
    camera: FloatArray,
    robot: int,
    track: FloatArray,
    noise: FloatArray,
    other: OtherSide,
    window_ns: int,
) -> ClueArray:
    """Clues (k,) and what a newer measurement (1,) tells; of too many, the one least missed goes.

    Args:
        clues: In order of time; not changed.
        one: Between the robot and something located.
        camera: (2,) by how much its sensor is turned to the left besides [rad], and stretches distances.
        robot: Which of the two sides waits.
        track: (3,) pose of the robot on its track at the stamp.
        noise: (3, 3) noise that the track has gathered by then.
        other: What it was seen by, or saw.
        window_ns: Age up to which clues are kept.
    """
    out = np.empty(_MOST_CLUES + 1, dtype=CLUE_DTYPE)
    count = _take_over(clues, one, window_ns, out)
    _describe(one, camera, robot, track, noise, other, out[count : count + 1])
    if count < _MOST_CLUES:
        return out[: count + 1]
    _thin_out(out)
    return out[:_MOST_CLUES]


@compiled
def _take_over(clues: ClueArray, one: MeasurementArray, window_ns: int, out: ClueArray) -> int:
    """Write the clues (k,) that are not too old beside a measurement (1,); return how many."""
    count = 0
    for k in range(clues.size):
        if clues[k].stamp_ns >= one[0].stamp_ns - window_ns:
            out[count] = clues[k]
            count += 1
    return count


@compiled
def _thin_out(clues: ClueArray) -> None:
    """Move the clue (of k, in order of time) that leaves the smallest gap, for its age, behind all others.

    Gaps are between clues of one marker. So old clues thin out; where no marker has three, the oldest goes.
    """
    least, gone = math.inf, 0
    newest_ns = clues[clues.size - 1].stamp_ns
    for k in range(clues.size):
        before, after = -1, -1
        for i in range(clues.size):
            if clues[i].marker_id == clues[k].marker_id and clues[i].other == clues[k].other:
                if i < k:
                    before = i
                elif i > k and after < 0:
                    after = i
        if before >= 0 and after >= 0:
            gap = (clues[after].stamp_ns - clues[before].stamp_ns) / max(1, newest_ns - clues[k].stamp_ns)
            if gap < least:
                least, gone = gap, k
    for k in range(gone, clues.size - 1):
        clues[k] = clues[k + 1]


@compiled
def turned(xx: float, xy: float, yy: float, cos: float, sin: float) -> tuple[float, float, float]:
    """A covariance xx, xy, yy turned by an angle."""
    across = 2.0 * cos * sin * xy
    return (
        cos * cos * xx - across + sin * sin * yy,
        cos * sin * (xx - yy) + (cos * cos - sin * sin) * xy,
        sin * sin * xx + across + cos * cos * yy,
    )


@compiled
def spread_at(spread: FloatArray, x: float, y: float) -> tuple[float, float, float]:
    """Covariance xx, xy, yy of a point on a frame whose right-invariant error has the covariance (3, 3)."""
    return (
        spread[0, 0] - 2.0 * y * spread[0, 2] + y * y * spread[2, 2],
        spread[0, 1] + x * spread[0, 2] - y * spread[1, 2] - x * y * spread[2, 2],
        spread[1, 1] + 2.0 * x * spread[1, 2] + x * x * spread[2, 2],
    )


@compiled
def _describe(
    measurements: MeasurementArray,
    camera: FloatArray,
    robot: int,
    track: FloatArray,
    noise: FloatArray,
    other: OtherSide,
    clues: ClueArray,
) -> None:
    """Write the clue (1,) that a measurement (1,) gives, see `with_clue`."""
    one, clue = measurements[0], clues[0]
    value, covariance, sensor, marker = one.value, one.covariance, one.sensor, one.marker
    sees = one.observer == robot
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
    clue.stamp_ns, clue.marker_id = one.stamp_ns, one.marker_id
    clue.other, clue.column = other.robot, other.column
    # what was seen is uncertain where the sensor is: on the track or on the map
    local, there, sign = (1.0, 0.0, 1.0) if sees else (0.0, 1.0, -1.0)
    clue.local_x, clue.local_y = lx + local * x, ly + local * y
    clue.local_xx, clue.local_xy, clue.local_yy = local * xx, local * xy, local * yy
    clue.map_x, clue.map_y = mx + there * x, my + there * y
    clue.map_xx, clue.map_xy, clue.map_yy = there * xx, there * xy, there * yy
    clue.turn = clue.other_turn = math.nan
    if one.has_heading:
        clue.turn = mtheta - ltheta - sign * value[2]
    if one.has_alternative:
        clue.other_turn = mtheta - ltheta - sign * one.alternative[2]
    clue.turn_variance = covariance[2, 2]
    assign_matrix(clue.track_noise, noise)
    assign(clue.frame, other.frame)
    assign_matrix(clue.frame_noise, other.noise)


@compiled
def refreshed(clues: ClueArray, belief: BeliefArrays) -> ClueArray:
    """Clues (k,) as they would be from what is believed now of the other sides, without those of robots lost.

    So all errors of another side, of however many clues, are those of one frame at one instant: what a robot
    that enters has in common with it.
    """
    out = np.empty_like(clues)
    count, robots = 0, belief.tracked.size
    none, drift, shared, spread = np.zeros((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(clues.size):
        column, clue = clues[k].column, out[count]
        out[count] = clues[k]
        assign_matrix(clue.shared, none)
        if column < 0:
            count += 1
            continue
        robot = column // 3
        if robot < robots and not belief.tracked[robot]:
            continue
        count += 1
        mark = 0 if robot < robots else (column - belief.table.survey_column[0]) // 3
        now = belief.transform[robot] if robot < robots else belief.landmark[mark]
        turn = _move(clue, now)
        for i in range(3):
            for j in range(3):
                shared[i, j] = belief.covariance[column + i, column + j]
                drift[i, j] = 0.0
                if robot < robots:
                    drift[i, j] = clue.frame_noise[i, j] - belief.accounted[robot, 0, i, j]
        sign = 1.0 if drift[0, 0] + drift[1, 1] + drift[2, 2] > 0.0 else -1.0
        carry(now, drift, spread)
        for i in range(3):
            for j in range(3):
                spread[i, j] = shared[i, j] + sign * spread[i, j]
        assign_matrix(clue.shared, shared)
        xx, xy, yy = turned(clue.map_xx, clue.map_xy, clue.map_yy, math.cos(turn), math.sin(turn))
        at_xx, at_xy, at_yy = spread_at(spread, clue.map_x, clue.map_y)
        clue.map_xx, clue.map_xy, clue.map_yy = xx + at_xx, xy + at_xy, yy + at_yy
        clue.turn_variance += spread[2, 2]
    return out[:count]


@compiled
def _move(clue: Clue, frame: FloatArray) -> float:
    """Move a clue's place on the map, and the heading that it shows, with its frame; return by what turn."""
    then = clue.frame
    turn = wrap(frame[2] - then[2])
    cos, sin = math.cos(turn), math.sin(turn)
    dx, dy = clue.map_x - then[0], clue.map_y - then[1]
    clue.map_x, clue.map_y = frame[0] + cos * dx - sin * dy, frame[1] + sin * dx + cos * dy
    clue.turn += turn
    clue.other_turn += turn
    return turn
