"""The transform on which most clues agree, refined by least squares, unless another one explains them too.

The parts are compiled, because every robot that waits tries again and again, and apart from one another:
each would be compiled once more inside whatever calls it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from swarm_loc_estimator.core.clues import Clue, ClueArray, spread_at, turned
from swarm_loc_estimator.core.compiled import assign, carry, compiled, moved_by_twist, wrap
from swarm_loc_estimator.core.dense_filter import cholesky3, solve3
from swarm_loc_estimator.core.se2 import FloatArray, adjoint

LEAST_CLUES = 3
_AGREE = float(chi2.ppf(0.999, 2))
_AGREE_AT_FIRST = 2.0 * _AGREE  # a hypothesis has the errors of the clue that it was made from
_LEAST_SHARE = 0.6  # of the clues must agree with a fix
_RIVAL_SHARE = 0.8  # another transform with this share of the best one's support makes the fix ambiguous
_MOST_RIVALS = 8
_APART_M, _APART_RAD = 0.1, 0.1
_HEADING_SIGMA = 0.2
_POSITION_SIGMA = 0.5
_REFINEMENTS = 5
_MARGIN = 1e-6  # so that what is its own is a covariance where next to nothing is
_PRIOR = 1e-6  # so that what no clue shows is unsure instead of singular


@dataclass(frozen=True)
class Fix:
    """Where a track lies.

    Attributes:
        transform: (3,) of the track.
        covariance: (3, 3) of the part of its right-invariant error that is its own.
        columns: (s,) first filter columns of the errors of those it was located by.
        shares: (s, 3, 3) how these enter its own.
    """

    transform: FloatArray
    covariance: FloatArray
    columns: NDArray[np.int64]
    shares: FloatArray


def locate(clues: ClueArray, track_noise: FloatArray) -> Fix | None:
    """The transform that a robot's clues (k,) agree on, or None while it is not unique and sure.

    Args:
        clues: Of CLUE_DTYPE, refreshed.
        track_noise: (3, 3) noise the track has gathered by now; what came since a clue makes it less sure.
    """
    if clues.size < LEAST_CLUES:
        return None
    hypotheses = _hypotheses(clues)
    clues = _drifted(clues, track_noise)
    agreeing, support = _vote(clues, hypotheses)
    enough = max(LEAST_CLUES, _LEAST_SHARE * clues.size)
    best = int(np.argmax(support)) if support.size else -1
    if best < 0 or agreeing[best] < enough:
        return None
    transform, covariance, weight = _refined(clues, hypotheses[best])
    if np.count_nonzero(weight) < enough:
        return None
    position, heading = _unsureness(clues, track_noise, weight, transform, covariance)
    if not (position < _POSITION_SIGMA and heading < _HEADING_SIGMA):
        return None
    rivals = hypotheses[support >= _RIVAL_SHARE * support[best]]
    limits = (_APART_M + 3.0 * position, _APART_RAD + 3.0 * heading)
    if _is_ambiguous(clues, transform, rivals, limits):
        return None
    return _parted(clues, track_noise, weight, transform, covariance)


def _is_ambiguous(
    clues: ClueArray, transform: FloatArray, rivals: FloatArray, limits: tuple[float, float]
) -> bool:
    """Whether a rival (of h, 3), refined, differs from a transform (3,) by more than the limits of `_apart`.

    The one farthest from all that were looked at comes next: what lies near one of them leads to the same.
    """
    apart = _apart(clues, transform, rivals, limits)
    for _ in range(_MOST_RIVALS):
        farthest = int(np.argmax(apart))
        if apart[farthest] <= 1.0:
            return False
        refined, _, _ = _refined(clues, rivals[farthest])
        if _apart(clues, transform, refined[None], limits)[0] > 1.0:
            return True
        apart = np.minimum(apart, _apart(clues, rivals[farthest], rivals, limits))
    return False


@compiled
def _apart(clues: ClueArray, one: FloatArray, others: FloatArray, limits: tuple[float, float]) -> FloatArray:
    """How far (h,) others (h, 3) put the clues' middle from where one transform (3,) does, or turn it.

    In units of the limits [m, rad]; the greater of the two.
    """
    x, y = 0.0, 0.0
    for k in range(clues.size):
        x += clues[k].local_x / clues.size
        y += clues[k].local_y / clues.size
    apart = np.empty(others.shape[0])
    for h in range(apart.size):
        cos, sin = math.cos(others[h, 2]) - math.cos(one[2]), math.sin(others[h, 2]) - math.sin(one[2])
        dx, dy = others[h, 0] - one[0] + cos * x - sin * y, others[h, 1] - one[1] + sin * x + cos * y
        turn = abs(wrap(others[h, 2] - one[2]))
        apart[h] = max(math.hypot(dx, dy) / limits[0], turn / limits[1])
    return apart


def _refined(clues: ClueArray, begin: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Transform (3,), covariance (3, 3) and weights (k,) by least squares, see `_refine`."""
    transform, covariance, weight = np.empty(3), np.empty((3, 3)), np.empty(clues.size)
    _refine(clues, begin, transform, covariance, weight)
    return transform, covariance, weight


@compiled
def _hypotheses(clues: ClueArray) -> FloatArray:
    """Transforms (h, 3) from each heading shown and each pair of clues far enough apart."""
    count, h = clues.size, 0
    out = np.empty((2 * count + count * (count - 1) // 2, 3))
    for k in range(count):
        a = clues[k]
        for turn in (a.turn, a.other_turn):
            if math.isfinite(turn):
                h = _place(turn, a.local_x, a.local_y, a.map_x, a.map_y, out, h)
    for i in range(count):
        for k in range(i):
            a, b = clues[i], clues[k]
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


@compiled
def _place(turn: float, lx: float, ly: float, mx: float, my: float, out: FloatArray, h: int) -> int:
    """Write the transform h with heading `turn` that brings a point of the track to its place on the map."""
    cos, sin = math.cos(turn), math.sin(turn)
    out[h, 0], out[h, 1], out[h, 2] = mx - cos * lx + sin * ly, my - sin * lx - cos * ly, wrap(turn)
    return h + 1


@compiled
def _drifted(clues: ClueArray, track_noise: FloatArray) -> ClueArray:
    """The clues (k,), their points on the track less sure by what it has drifted since."""
    out, drift = np.empty_like(clues), np.empty((3, 3))
    for k in range(clues.size):
        out[k] = clues[k]
        clue = out[k]
        for i in range(3):
            for j in range(3):
                drift[i, j] = track_noise[i, j] - clue.track_noise[i, j]
        xx, xy, yy = spread_at(drift, clue.local_x, clue.local_y)
        clue.local_xx += xx
        clue.local_xy += xy
        clue.local_yy += yy
    return out


@compiled
def _misses(
    clue: Clue, x: float, y: float, cos: float, sin: float
) -> tuple[float, float, float, float, float]:
    """By what a transform misses a clue's place on the map, x and y, with their information xx, xy, yy."""
    xx, xy, yy = turned(clue.local_xx, clue.local_xy, clue.local_yy, cos, sin)
    xx, xy, yy = xx + clue.map_xx, xy + clue.map_xy, yy + clue.map_yy
    scale = 1.0 / (xx * yy - xy * xy)
    dx = clue.map_x - x - cos * clue.local_x + sin * clue.local_y
    dy = clue.map_y - y - sin * clue.local_x - cos * clue.local_y
    return dx, dy, scale * yy, -scale * xy, scale * xx


@compiled
def _turn_off(clue: Clue, heading: float) -> float:
    """By what turn a heading differs from that which a clue shows, or the mirrored one; NaN if by much."""
    turn, other = wrap(clue.turn - heading), wrap(clue.other_turn - heading)
    if abs(other) < abs(turn):  # NaN, which stands for none shown, is not less
        turn = other
    return turn if turn * turn < 9.0 * clue.turn_variance else math.nan


@compiled
def _vote(clues: ClueArray, transforms: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """How many clues agree with each transform (h, 3), and how many points and headings of theirs."""
    count = transforms.shape[0]
    agreeing, support = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    for h in range(count):
        x, y, heading = transforms[h, 0], transforms[h, 1], transforms[h, 2]
        cos, sin = math.cos(heading), math.sin(heading)
        for k in range(clues.size):
            dx, dy, xx, xy, yy = _misses(clues[k], x, y, cos, sin)
            if xx * dx * dx + 2.0 * xy * dx * dy + yy * dy * dy <= _AGREE_AT_FIRST:
                agreeing[h] += 1
                support[h] += 1 if math.isnan(_turn_off(clues[k], heading)) else 2
    return agreeing, support


@compiled
def _refine(
    clues: ClueArray, begin: FloatArray, transform: FloatArray, covariance: FloatArray, weight: FloatArray
) -> None:
    """Gauss-Newton on the points and headings that agree with a transform.

    Args:
        clues: (k,).
        begin: (3,) where to begin.
        transform: (3,) written.
        covariance: (3, 3) written, of its right-invariant error.
        weight: (k,) written: how sure the points are, zero for those that do not agree.
    """
    information, factor = np.empty((3, 3)), np.empty((3, 3))
    gradient, step = np.empty(3), np.empty(3)
    assign(transform, begin)
    squared, agreeing = 0.0, 0
    for iteration in range(_REFINEMENTS):
        x, y, heading = transform[0], transform[1], transform[2]
        cos, sin = math.cos(heading), math.sin(heading)
        squared, agreeing = 0.0, 0
        for i in range(3):
            gradient[i] = 0.0
            for j in range(3):
                information[i, j] = _PRIOR if i == j else 0.0
        for k in range(clues.size):
            clue = clues[k]
            dx, dy, xx, xy, yy = _misses(clue, x, y, cos, sin)
            distance = xx * dx * dx + 2.0 * xy * dx * dy + yy * dy * dy
            agrees = distance <= (_AGREE if iteration else _AGREE_AT_FIRST)
            weight[k] = xx + yy if agrees else 0.0
            if not agrees:
                continue
            agreeing += 1
            squared += distance
            px, py = clue.map_x - dx, clue.map_y - dy  # where the transform puts the point
            along, across = (1.0, 0.0, -py), (0.0, 1.0, px)
            for i in range(3):
                wx, wy = along[i] * xx + across[i] * xy, along[i] * xy + across[i] * yy
                gradient[i] += wx * dx + wy * dy
                for j in range(3):
                    information[i, j] += wx * along[j] + wy * across[j]
            turn = _turn_off(clue, heading)
            if math.isfinite(turn):
                gradient[2] += turn / clue.turn_variance
                information[2, 2] += 1.0 / clue.turn_variance
        factor = cholesky3(information)
        solve3(factor, gradient, step)
        x, y, heading = moved_by_twist(step[0], step[1], step[2], x, y, heading)
        transform[0], transform[1], transform[2] = x, y, heading
    excess = max(1.0, squared / max(1, 2 * agreeing - 3))
    for i in range(3):
        for j in range(3):
            gradient[j] = excess if i == j else 0.0
        solve3(factor, gradient, covariance[i])


def _parted(
    clues: ClueArray,
    track_noise: FloatArray,
    weight: FloatArray,
    transform: FloatArray,
    covariance: FloatArray,
) -> Fix:
    """Part the error of a transform (3,) into its own and that of all those it was located by.

    An error of another side moves all that is tied to it, so it enters by the share of the information that
    its clues have. What else makes clues unsure is their own, and averages out but for the drift of the track
    since, which counts at its mean by weight (k,).
    """
    used = weight > 0.0
    clues, weight = clues[used], weight[used]
    cos, sin = math.cos(transform[2]), math.sin(transform[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    local = _matrices(clues, "local")
    place = np.column_stack([clues["local_x"], clues["local_y"]]) @ turn.T + transform[:2]
    tie, other_tie = _ties(place), _ties(np.column_stack([clues["map_x"], clues["map_y"]]))
    tie[:, 2, 2] = [math.isfinite(_turn_off(clue, transform[2])) for clue in clues]
    noise, common = np.zeros((2, clues.size, 3, 3))
    noise[:, :2, :2] = turn @ local @ turn.T + _matrices(clues, "map")
    noise[:, 2, 2] = clues["turn_variance"]
    common[:, :2, :2] = (other_tie @ clues["shared"] @ np.swapaxes(other_tie, 1, 2))[:, :2, :2]
    common[:, 2, 2] = clues["shared"][:, 2, 2]
    weighted = np.linalg.solve(noise, tie)
    information = np.swapaxes(tie, 1, 2) @ weighted
    gain = np.linalg.inv(information.sum(axis=0) + _PRIOR * np.eye(3))
    rest = (np.swapaxes(weighted, 1, 2) @ ((1.0 + _MARGIN) * noise - common) @ weighted).sum(axis=0)
    drift = np.average(track_noise - clues["track_noise"], axis=0, weights=weight)
    own = covariance @ rest @ gain + adjoint(transform) @ drift @ adjoint(transform).T
    columns = np.unique(clues["column"][clues["column"] >= 0])
    shares = np.array([gain @ information[clues["column"] == column].sum(axis=0) for column in columns])
    return Fix(transform, 0.5 * (own + own.T), columns, shares.reshape(-1, 3, 3))


def _ties(places: FloatArray) -> FloatArray:
    """How right-invariant errors move points (k, 2), and turn what is there: (k, 3, 3)."""
    ties = np.tile(np.eye(3), (len(places), 1, 1))
    ties[:, 0, 2], ties[:, 1, 2] = -places[:, 1], places[:, 0]
    return ties


def _matrices(clues: ClueArray, side: str) -> FloatArray:
    """Covariances (k, 2, 2) of the points of a side."""
    xx, xy, yy = (clues[f"{side}_{name}"] for name in ("xx", "xy", "yy"))
    return np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-1)


@compiled
def _unsureness(
    clues: ClueArray,
    track_noise: FloatArray,
    weight: FloatArray,
    transform: FloatArray,
    covariance: FloatArray,
) -> tuple[float, float]:
    """How unsure a fix leaves the clues' middle on the map [m], the greater of x and y, and the heading.

    What does not average out counts at its mean by weight (k,): the errors of the other sides, as if all
    erred alike, and the drift of the track since.
    """
    x, y, total = 0.0, 0.0, 0.0
    whole, drift, carried = np.zeros((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    for k in range(clues.size):
        x += clues[k].map_x / clues.size
        y += clues[k].map_y / clues.size
        total += weight[k]
    for k in range(clues.size):
        share = weight[k] / total
        for i in range(3):
            for j in range(3):
                whole[i, j] += share * clues[k].shared[i, j]
                drift[i, j] += share * (track_noise[i, j] - clues[k].track_noise[i, j])
    carry(transform, drift, carried)
    for i in range(3):
        for j in range(3):
            whole[i, j] += covariance[i, j] + carried[i, j]
    xx, _, yy = spread_at(whole, x, y)
    return math.sqrt(max(xx, yy)), math.sqrt(whole[2, 2])
