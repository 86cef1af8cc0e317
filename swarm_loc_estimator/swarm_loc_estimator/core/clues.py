"""Clues: what sightings of a robot that waits to be located say about where its odometry track lies."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.compiled import assign_matrix, compiled, composed
from swarm_loc_estimator.core.measurements import MeasurementArray
from swarm_loc_estimator.core.se2 import FloatArray

CLUE_DTYPE = np.dtype(
    [
        ("stamp_ns", np.int64),
        ("marker_id", np.int64),
        ("other", np.int64),  # the robot on the other side, or NOBODY
        ("local_x", np.float64),  # point in the track's frame [m]
        ("local_y", np.float64),
        ("local_xx", np.float64),  # its covariance
        ("local_xy", np.float64),
        ("local_yy", np.float64),
        ("map_x", np.float64),  # the same point in map [m]
        ("map_y", np.float64),
        ("map_xx", np.float64),
        ("map_xy", np.float64),
        ("map_yy", np.float64),
        ("turn", np.float64),  # heading of the transform that the sighting shows [rad], NaN: none
        ("other_turn", np.float64),  # of its mirrored solution, NaN: none
        ("turn_variance", np.float64),
        ("track_noise", np.float64, (3, 3)),  # noise the track had gathered by then
        ("shared", np.float64, (3, 3)),  # right-invariant error of the robot on the other side
    ]
)

ClueArray = NDArray[np.void]
Clue = Any
"""A row of a ClueArray inside compiled code, where the fields are attributes."""

NO_CLUES: ClueArray = np.zeros(0, dtype=CLUE_DTYPE)
_MOST_CLUES = 20


def with_clue(
    clues: ClueArray,
    one: MeasurementArray,
    camera: FloatArray,
    robot: int,
    track: FloatArray,
    noise: FloatArray,
    base: FloatArray,
    spread: FloatArray,
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
        base: (3,) pose in `map` of the other side; by what a landmark is moved from its survey.
        spread: (3, 3) covariance of its right-invariant error.
        window_ns: Age up to which clues are kept.
    """
    out = np.empty(_MOST_CLUES + 1, dtype=CLUE_DTYPE)
    count = _take_over(clues, one, window_ns, out)
    _describe(one, camera, robot, track, noise, base, spread, out[count : count + 1])
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
    base: FloatArray,
    spread: FloatArray,
    clues: ClueArray,
) -> None:
    """Write the clue (1,) that a measurement (1,) gives, see `with_clue`."""
    one, clue = measurements[0], clues[0]
    value, covariance, sensor, marker = one.value, one.covariance, one.sensor, one.marker
    sees = one.observer == robot
    on_track, on_map = (sensor, marker) if sees else (marker, sensor)
    lx, ly, ltheta = composed(track[0], track[1], track[2], on_track[0], on_track[1], on_track[2])
    mx, my, mtheta = composed(base[0], base[1], base[2], on_map[0], on_map[1], on_map[2])
    if sees:
        ltheta += camera[0]
    else:
        mtheta += camera[0]
    x, y, angle = value[0], value[1], ltheta if sees else mtheta
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    if one.kind == 1:  # Kind.POLAR: along and across the line of sight
        x, y, angle = value[0], 0.0, angle + value[1]
        xy, yy = value[0] * xy, value[0] * value[0] * yy
    size = 1.0 / (1.0 + camera[1])
    x, y, xx, xy, yy = size * x, size * y, size * size * xx, size * size * xy, size * size * yy
    cos, sin = math.cos(angle), math.sin(angle)
    x, y = cos * x - sin * y, sin * x + cos * y
    xx, xy, yy = turned(xx, xy, yy, cos, sin)
    clue.stamp_ns, clue.marker_id = one.stamp_ns, one.marker_id
    clue.other = one.target if sees else one.observer
    # what was seen is uncertain where the sensor is: on the track or on the map
    local, there, sign = (1.0, 0.0, 1.0) if sees else (0.0, 1.0, -1.0)
    clue.local_x, clue.local_y = lx + local * x, ly + local * y
    clue.local_xx, clue.local_xy, clue.local_yy = local * xx, local * xy, local * yy
    clue.map_x, clue.map_y = mx + there * x, my + there * y
    at_xx, at_xy, at_yy = spread_at(spread, clue.map_x, clue.map_y)
    clue.map_xx, clue.map_xy, clue.map_yy = at_xx + there * xx, at_xy + there * xy, at_yy + there * yy
    clue.turn = clue.other_turn = math.nan
    if one.has_heading:
        clue.turn = mtheta - ltheta - sign * value[2]
    if one.has_alternative:
        clue.other_turn = mtheta - ltheta - sign * one.alternative[2]
    clue.turn_variance = covariance[2, 2] + spread[2, 2]
    assign_matrix(clue.track_noise, noise)
    assign_matrix(clue.shared, spread)
