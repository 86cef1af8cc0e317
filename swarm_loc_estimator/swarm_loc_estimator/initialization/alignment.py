"""Alignment of a robot's track with the map: the transform on which most constraints agree, if it is unique.

Constraints are sightings by or of a robot that is not localized, as of the present belief. The parts are
compiled because every waiting robot tries repeatedly; they are not inlined, which would lengthen compilation.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common import numerics, se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.filter.models import POLAR, gate_threshold
from swarm_loc_estimator.filter.state import BeliefArrays, InitialPose, covariance_within
from swarm_loc_estimator.initialization.window import Window
from swarm_loc_estimator.swarm.calibration_states import CAMERA_YAW

CONSTRAINT_DTYPE = np.dtype(
    [
        ("column", np.int64),  # first of the other side's error in the filter, or -1
        ("local_x", np.float64),  # point in the track's frame [m]
        ("local_y", np.float64),
        ("local_xx", np.float64),  # its covariance
        ("local_xy", np.float64),
        ("local_yy", np.float64),
        ("map_x", np.float64),  # the same point in map [m]
        ("map_y", np.float64),
        ("map_xx", np.float64),  # its covariance
        ("map_xy", np.float64),
        ("map_yy", np.float64),
        ("turn", np.float64),  # heading of the transform that the sighting shows [rad], NaN: none
        ("other_turn", np.float64),  # of its mirrored solution, NaN: none
        ("turn_variance", np.float64),
        ("track_noise", np.float64, (3, 3)),  # preintegrated covariance of the track
        ("shared", np.float64, (3, 3)),  # covariance of the other side's error
    ]
)

ConstraintArray = NDArray[np.void]
Constraint = Any  # A row of a ConstraintArray inside compiled code, where the fields are attributes

_ARC = 0.3**2  # Variance of a heading beyond which errors of points that turn with it lie on arcs [rad^2]


def constraints_of(window: Window, robot: int, belief: BeliefArrays) -> ConstraintArray:
    """Constraints of a waiting robot's sightings (m,), without those by or of robots that are lost.

    They refer to the present estimates of the other sides, so that the errors of another side are the same in
    all its constraints, and can be shared with the robot that is initialized from them.
    """
    out = np.zeros(window.size, dtype=CONSTRAINT_DTYPE)
    return out[: _describe(window, robot, belief, out)]


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
def _describe(window: Window, robot: int, belief: BeliefArrays, out: ConstraintArray) -> int:
    """Write the constraints of a window (m,), see `constraints_of`; return their number."""
    one, count = window.measured, 0
    drift, spread, none, camera = np.empty((3, 3)), np.empty((3, 3)), np.zeros(3), np.zeros(3)
    for k in range(one.stamp_ns.size):
        sees, mark = one.observer[k] == robot, max(one.landmark[k], one.mount[k])
        other = one.target[k] if sees else one.observer[k]
        if other >= 0 and not belief.tracked[other]:
            continue
        constraint = out[count]
        count += 1
        # Sensor and marker on the track and in map, with the estimated errors of the camera.
        for i in range(3):
            camera[i] = belief.parameter[one.observer[k], CAMERA_YAW + i] if one.observer[k] >= 0 else 0.0
        sensor, marker, track, frame = one.sensor[k], one.marker[k], window.track[k], none
        column = 3 * other if other >= 0 else (belief.table.survey_column[mark] if mark >= 0 else -1)
        if other >= 0:
            frame = belief.transform[other]
        elif mark >= 0:
            frame = belief.landmark[mark]
        at = window.other_track[k]
        bx, by, btheta = numerics.composed(frame[0], frame[1], frame[2], at[0], at[1], at[2])
        on_track, on_map = (sensor, marker) if sees else (marker, sensor)
        lx, ly, ltheta = numerics.composed(
            track[0], track[1], track[2], on_track[0], on_track[1], on_track[2]
        )
        mx, my, mtheta = numerics.composed(bx, by, btheta, on_map[0], on_map[1], on_map[2])
        if sees:
            ltheta += camera[0]
        else:
            mtheta += camera[0]
        # The measured point and its covariance, turned to the frame of the side that sees.
        value, covariance = one.value[k], one.covariance[k]
        x, y, angle = value[0], value[1], ltheta if sees else mtheta
        xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
        if one.model[k] == POLAR:  # along and across the line of sight
            x, y, angle = value[0] - camera[2], 0.0, angle + value[1]
            xy, yy = value[0] * xy, value[0] * value[0] * yy
        size = 1.0 / (1.0 + camera[1])
        x, y, xx, xy, yy = size * x, size * y, size * size * xx, size * size * xy, size * size * yy
        cos, sin = math.cos(angle), math.sin(angle)
        x, y = cos * x - sin * y, sin * x + cos * y
        xx, xy, yy = turned(xx, xy, yy, cos, sin)
        # The measurement noise acts on the side of the sensor: on the track or on the map.
        local, there, sign = (1.0, 0.0, 1.0) if sees else (0.0, 1.0, -1.0)
        constraint.local_x, constraint.local_y = lx + local * x, ly + local * y
        constraint.local_xx, constraint.local_xy, constraint.local_yy = local * xx, local * xy, local * yy
        constraint.map_x, constraint.map_y = mx + there * x, my + there * y
        # Headings of the transform, also by a second solution.
        constraint.turn = constraint.other_turn = math.nan
        if one.has_heading[k]:
            constraint.turn = mtheta - ltheta - sign * value[2]
        if one.has_second[k]:
            constraint.other_turn = mtheta - ltheta - sign * one.second[k, 2]
        numerics.assign_matrix(constraint.track_noise, window.noise[k])
        # The error of the other side, and the drift of its track since.
        constraint.column = column
        for i in range(3):
            for j in range(3):
                constraint.shared[i, j] = covariance_within(belief, column, i, j) if column >= 0 else 0.0
                drift[i, j] = 0.0
                if other >= 0:
                    drift[i, j] = window.other_noise[k, i, j] - belief.preintegrated_covariance[other, i, j]
        later = 1.0 if drift[0, 0] + drift[1, 1] + drift[2, 2] > 0.0 else -1.0
        numerics.carry(frame, drift, spread)
        for i in range(3):
            for j in range(3):
                spread[i, j] = constraint.shared[i, j] + later * spread[i, j]
        # At the point: a circle about this ellipse where the heading is so unknown that errors lie on arcs.
        x, y = constraint.map_x, constraint.map_y
        at_xx = spread[0, 0] - 2.0 * y * spread[0, 2] + y * y * spread[2, 2]
        at_xy = spread[0, 1] + x * spread[0, 2] - y * spread[1, 2] - x * y * spread[2, 2]
        at_yy = spread[1, 1] + 2.0 * x * spread[1, 2] + x * x * spread[2, 2]
        if spread[2, 2] > _ARC:
            at_xx, at_xy, at_yy = at_xx + at_yy, 0.0, at_xx + at_yy
        constraint.map_xx, constraint.map_xy = there * xx + at_xx, there * xy + at_xy
        constraint.map_yy = there * yy + at_yy
        constraint.turn_variance = covariance[2, 2] + spread[2, 2]
    return count


MIN_CONSTRAINTS = 3
_AGREE = float(gate_threshold(0.999))
_AGREE_AT_FIRST = 2.0 * _AGREE  # a hypothesis has the errors of its own constraint
_MIN_SHARE = 0.6  # share of the constraints that must agree with an alignment
_RIVAL_SHARE = 0.8  # share of the best support from which another transform is a rival
_MAX_RIVALS = 8
_APART_M, _APART_RAD = 0.1, 0.1
HEADING_SIGMA = 0.2
POSITION_SIGMA = 0.5
_REFINEMENTS = 5
_MARGIN = 1e-6  # keeps the robot's own covariance positive definite
_PRIOR = 1e-6  # keeps the information matrix regular in unobserved directions


def align(
    constraints: ConstraintArray, track_noise: FloatArray, heading_sigma: float = HEADING_SIGMA
) -> InitialPose | None:
    """The transform on which a robot's constraints (k,) agree; None while it is ambiguous or uncertain.

    `track_noise` (3, 3) is the covariance of the track preintegrated until now, `heading_sigma` the largest
    standard deviation of the heading [rad].
    """
    if constraints.size < MIN_CONSTRAINTS:
        return None
    hypotheses = _hypotheses(constraints)
    constraints = _drifted(constraints, track_noise)
    agreeing, support = _vote(constraints, hypotheses)
    enough = max(MIN_CONSTRAINTS, _MIN_SHARE * constraints.size)
    best = int(np.argmax(support)) if support.size else -1
    if best < 0 or agreeing[best] < enough:
        return None
    transform, covariance, weight = found = _refined(constraints, hypotheses[best])
    if np.count_nonzero(weight) < enough:
        return None
    # errors that do not average out count whole: those of other robots, as if they were one, and the drift
    drift = np.average(track_noise - constraints["track_noise"], axis=0, weights=weight)
    whole = covariance + np.average(constraints["shared"], axis=0, weights=weight)
    whole += se2.adjoint(transform) @ drift @ se2.adjoint(transform).T
    centre = np.array([[constraints["map_x"].mean(), constraints["map_y"].mean()]])
    (tie,) = _ties(centre)
    x, y, heading = np.sqrt(np.diag(tie @ whole @ tie.T)).tolist()
    position = max(x, y)
    if not (position < POSITION_SIGMA and heading < heading_sigma):
        return None
    rivals = hypotheses[support >= _RIVAL_SHARE * support[best]]
    limits = (_APART_M + 3.0 * position, _APART_RAD + 3.0 * heading)
    if _is_ambiguous(constraints, transform, rivals, limits):
        return None
    return _split_errors(constraints, track_noise, *found)


def _is_ambiguous(
    constraints: ConstraintArray, transform: FloatArray, rivals: FloatArray, limits: tuple[float, float]
) -> bool:
    """Whether any of the rivals (h, 3), once refined, differs from a transform (3,) beyond the limits."""
    apart = _apart(constraints, transform, rivals, limits)
    for _ in range(
        _MAX_RIVALS
    ):  # the one farthest from all before, since near ones converge to one transform
        farthest = int(np.argmax(apart))
        if apart[farthest] <= 1.0:
            return False
        refined, _, _ = _refined(constraints, rivals[farthest])
        if _apart(constraints, transform, refined[None], limits)[0] > 1.0:
            return True
        apart = np.minimum(apart, _apart(constraints, rivals[farthest], rivals, limits))
    return False


def _apart(
    constraints: ConstraintArray, one: FloatArray, others: FloatArray, limits: tuple[float, float]
) -> FloatArray:
    """Differences (h,) of transforms (h, 3) from one (3,), at the centre or in angle, over their limits."""
    centre = np.array([constraints["local_x"].mean(), constraints["local_y"].mean(), 0.0])
    away = (se2.compose(others, centre) - se2.compose(one, centre))[:, :2]
    turn = np.abs(se2.wrap_angle(others[:, 2] - one[2]))
    apart: FloatArray = np.maximum(np.hypot(*away.T) / limits[0], turn / limits[1])
    return apart


@cached_njit
def _hypotheses(constraints: ConstraintArray) -> FloatArray:
    """Transforms (h, 3) from each measured heading and from each pair of constraints far enough apart."""
    count, h = constraints.size, 0
    out = np.empty((2 * count + count * (count - 1) // 2, 3))
    for k in range(count):
        a = constraints[k]
        for turn in (a.turn, a.other_turn):
            if math.isfinite(turn):
                h = _place(turn, a.local_x, a.local_y, a.map_x, a.map_y, out, h)
    for i in range(count):
        for k in range(i):
            a, b = constraints[i], constraints[k]
            lx, ly = a.local_x - b.local_x, a.local_y - b.local_y
            mx, my = a.map_x - b.map_x, a.map_y - b.map_y
            variance = a.local_xx + a.local_yy + a.map_xx + a.map_yy
            sigma = math.sqrt(variance + b.local_xx + b.local_yy + b.map_xx + b.map_yy)
            length = math.hypot(mx, my)
            if length > 3.0 * sigma and abs(math.hypot(lx, ly) - length) < 4.0 * sigma:
                turn = math.atan2(my, mx) - math.atan2(ly, lx)
                lx, ly = b.local_x + 0.5 * lx, b.local_y + 0.5 * ly
                mx, my = b.map_x + 0.5 * mx, b.map_y + 0.5 * my
                h = _place(turn, lx, ly, mx, my, out, h)
    return out[:h]


@cached_njit
def _place(turn: float, lx: float, ly: float, mx: float, my: float, out: FloatArray, h: int) -> int:
    """Write the transform h with heading `turn` that maps a point of the track to its place on the map."""
    cos, sin = math.cos(turn), math.sin(turn)
    out[h, 0], out[h, 1], out[h, 2] = mx - cos * lx + sin * ly, my - sin * lx - cos * ly, numerics.wrap(turn)
    return h + 1


def _drifted(constraints: ConstraintArray, track_noise: FloatArray) -> ConstraintArray:
    """The constraints (k,) with the drift of the track added to the covariance of their points on it."""
    out: ConstraintArray = constraints.copy()
    drift = track_noise - out["track_noise"]
    # late odometry has replaced a larger noise that was assumed without it
    late = np.linalg.eigvalsh(drift)[:, 0] < -1e-12 - 1e-9 * np.abs(np.trace(drift, axis1=1, axis2=2))
    out["track_noise"][late], drift[late] = track_noise, 0.0
    tie = _ties(np.column_stack([out["local_x"], out["local_y"]]))
    spread = tie @ drift @ np.swapaxes(tie, 1, 2)
    wide = drift[:, 2, 2] > _ARC
    spread[wide, :2, :2] = (spread[wide, 0, 0] + spread[wide, 1, 1])[:, None, None] * np.eye(2)
    out["turn_variance"][wide] += drift[wide, 2, 2]
    for name, part in (("xx", spread[:, 0, 0]), ("xy", spread[:, 0, 1]), ("yy", spread[:, 1, 1])):
        out[f"local_{name}"] += part
    return out


@cached_njit
def _misses(
    constraint: Constraint, x: float, y: float, cos: float, sin: float
) -> tuple[float, float, float, float, float]:
    """Residual of a constraint's place on the map, x and y, and its information xx, xy, yy."""
    xx, xy, yy = turned(constraint.local_xx, constraint.local_xy, constraint.local_yy, cos, sin)
    xx, xy, yy = xx + constraint.map_xx, xy + constraint.map_xy, yy + constraint.map_yy
    scale = 1.0 / (xx * yy - xy * xy)
    dx = constraint.map_x - x - cos * constraint.local_x + sin * constraint.local_y
    dy = constraint.map_y - y - sin * constraint.local_x - cos * constraint.local_y
    return dx, dy, scale * yy, -scale * xy, scale * xx


@cached_njit
def _turn_off(constraint: Constraint, heading: float) -> float:
    """Residual of a heading against a constraint's or its mirrored one, the smaller; NaN beyond 3 sigma."""
    turn, other = numerics.wrap(constraint.turn - heading), numerics.wrap(constraint.other_turn - heading)
    if abs(other) < abs(turn):  # false for NaN, which means not measured
        turn = other
    return turn if turn * turn < 9.0 * constraint.turn_variance else math.nan


@cached_njit
def _vote(constraints: ConstraintArray, transforms: FloatArray) -> tuple[IntArray, IntArray]:
    """Number of constraints that agree with each transform (h, 3), and of their points and headings."""
    count = transforms.shape[0]
    agreeing, support = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    for h in range(count):
        x, y, heading = transforms[h, 0], transforms[h, 1], transforms[h, 2]
        cos, sin = math.cos(heading), math.sin(heading)
        for k in range(constraints.size):
            dx, dy, xx, xy, yy = _misses(constraints[k], x, y, cos, sin)
            if xx * dx * dx + 2.0 * xy * dx * dy + yy * dy * dy <= _AGREE_AT_FIRST:
                agreeing[h] += 1
                support[h] += 1 if math.isnan(_turn_off(constraints[k], heading)) else 2
    return agreeing, support


@cached_njit
def _refined(constraints: ConstraintArray, begin: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gauss-Newton on the points and headings that agree with a transform (3,).

    Returns:
        The transform (3,), the covariance (3, 3) of its right-invariant error, and the information (k,) of
        the points, zero for those that do not agree.
    """
    transform, covariance, weight = begin.copy(), np.empty((3, 3)), np.empty(constraints.size)
    information, factor = np.empty((3, 3)), np.empty((3, 3))
    gradient, step = np.empty(3), np.empty(3)
    squared, agreeing = 0.0, 0
    for iteration in range(_REFINEMENTS):
        # Normal equations of the points and headings that agree now.
        x, y, heading = transform[0], transform[1], transform[2]
        cos, sin = math.cos(heading), math.sin(heading)
        squared, agreeing = 0.0, 0
        for i in range(3):
            gradient[i] = 0.0
            for j in range(3):
                information[i, j] = _PRIOR if i == j else 0.0
        for k in range(constraints.size):
            constraint = constraints[k]
            dx, dy, xx, xy, yy = _misses(constraint, x, y, cos, sin)
            distance = xx * dx * dx + 2.0 * xy * dx * dy + yy * dy * dy
            agrees = distance <= (_AGREE if iteration else _AGREE_AT_FIRST)
            weight[k] = xx + yy if agrees else 0.0
            if not agrees:
                continue
            agreeing += 1
            squared += distance
            px, py = constraint.map_x - dx, constraint.map_y - dy  # the point as transformed
            along, across = (1.0, 0.0, -py), (0.0, 1.0, px)
            for i in range(3):
                wx, wy = along[i] * xx + across[i] * xy, along[i] * xy + across[i] * yy
                gradient[i] += wx * dx + wy * dy
                for j in range(3):
                    information[i, j] += wx * along[j] + wy * across[j]
            turn = _turn_off(constraint, heading)
            if math.isfinite(turn):
                gradient[2] += turn / constraint.turn_variance
                information[2, 2] += 1.0 / constraint.turn_variance
        # Gauss-Newton step on the manifold.
        factor = numerics.cholesky3(information)
        numerics.solve3(factor, gradient, step)
        x, y, heading = numerics.moved_by_twist(step[0], step[1], step[2], x, y, heading)
        transform[0], transform[1], transform[2] = x, y, heading
    # Covariance, wider where residuals exceed what is described.
    excess = max(1.0, squared / max(1, 2 * agreeing - 3))
    for i in range(3):
        for j in range(3):
            gradient[j] = excess if i == j else 0.0
        numerics.solve3(factor, gradient, covariance[i])
    return transform, covariance, weight


def _split_errors(
    constraints: ConstraintArray,
    track_noise: FloatArray,
    transform: FloatArray,
    covariance: FloatArray,
    weight: FloatArray,
) -> InitialPose:
    """Split the error of a transform (3,) into its own part and those of the robots that it depends on.

    The error of another robot enters with the share of information that its constraints have. Other errors
    are independent and average out, except the drift of the track, which counts with its weighted mean (k,).
    """
    used = weight > 0.0
    constraints, weight = constraints[used], weight[used]
    cos, sin = math.cos(transform[2]), math.sin(transform[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    local = _matrices(constraints, "local")
    place = np.column_stack([constraints["local_x"], constraints["local_y"]]) @ turn.T + transform[:2]
    tie, other_tie = _ties(place), _ties(np.column_stack([constraints["map_x"], constraints["map_y"]]))
    tie[:, 2, 2] = [math.isfinite(_turn_off(constraint, transform[2])) for constraint in constraints]
    noise, common = np.zeros((2, constraints.size, 3, 3))
    noise[:, :2, :2] = turn @ local @ turn.T + _matrices(constraints, "map")
    noise[:, 2, 2] = constraints["turn_variance"]
    common[:, :2, :2] = (other_tie @ constraints["shared"] @ np.swapaxes(other_tie, 1, 2))[:, :2, :2]
    common[:, 2, 2] = constraints["shared"][:, 2, 2]
    weighted = np.linalg.solve(noise, tie)
    information = np.swapaxes(tie, 1, 2) @ weighted
    gain = np.linalg.inv(information.sum(axis=0) + _PRIOR * np.eye(3))
    rest = (np.swapaxes(weighted, 1, 2) @ ((1.0 + _MARGIN) * noise - common) @ weighted).sum(axis=0)
    drift = np.average(track_noise - constraints["track_noise"], axis=0, weights=weight)
    own = covariance @ rest @ gain + se2.adjoint(transform) @ drift @ se2.adjoint(transform).T
    columns = np.unique(constraints["column"][constraints["column"] >= 0])
    shares = np.array([gain @ information[constraints["column"] == column].sum(axis=0) for column in columns])
    return InitialPose(transform, 0.5 * (own + own.T), columns, shares.reshape(-1, 3, 3))


def _ties(places: FloatArray) -> FloatArray:
    """Jacobians (k, 3, 3) of position and heading at points (k, 2) with respect to right-invariant errors."""
    ties = np.tile(np.eye(3), (len(places), 1, 1))
    ties[:, 0, 2], ties[:, 1, 2] = -places[:, 1], places[:, 0]
    return ties


def _matrices(constraints: ConstraintArray, side: str) -> FloatArray:
    """Covariances (k, 2, 2) of the points of a side."""
    xx, xy, yy = (constraints[f"{side}_{name}"] for name in ("xx", "xy", "yy"))
    return np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-1)
