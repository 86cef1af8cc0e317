"""Matching of scans: beams on lines, and a search over a lattice of offsets.

The residual of a beam in direction u on a line with normal n at distance D from where the beam starts is
z = y - (n.u)/D. Its Jacobian, and whether the beam is used at all, follow from the predicted value, not
from the measured one: a cut on measured values selects errors of one sign and shrinks the map.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.mapping.scans import BINS, LINE, Beams, Lines

CAUCHY = 6.0  # Square of the scale of the Cauchy loss, in variances
MIN_MATCHED = 30  # Minimum number of matched beams of a pair of stops
# The constants of matching are checked by `make bench-pushbot`: corridor, office and ring, 20 seeds each.
_MIN_INCIDENCE = 0.15  # Minimum cosine between beam and normal
_MIN_DISTANCE = 0.05  # Minimum distance of a line from the stop with the beam [m]
_ROUGHNESS = 0.004  # Standard deviation of walls from straight lines [m]
_GATE_VARIANCES = 16.0  # Maximum squared residual of a matched beam, in variances
_RANGE_SIGMAS = 2.5  # Lines nearer to the laser's range than this are not compared [sigma]
_IMITATED = 5.0  # Information along lines over what errors of normals imitate, below which there is none

OFF, UNUSABLE, FIT = 0, 1, 2  # Result for a beam: off the line; not comparable; on the line


class Scans(NamedTuple):
    """Stops as input of scan matching."""

    states: FloatArray  # (k, 4) x [m], y [m], theta [rad] on arrival, true turn over turn by odometry
    beams: Beams  # Their beams
    lines: Lines  # Lines fitted to the beams


@cached_njit
def beam_residual(
    scans: Scans, k: int, i: int, j: int, gate: float
) -> tuple[int, float, float, float, float, float, float]:
    """Compare beam i of stop k with the lines of stop j.

    Args:
        scans: All stops.
        k: The stop with the beam.
        i: Number of the beam.
        j: The stop with the lines.
        gate: A beam further off a line than this and four sigmas is not matched [m].

    Returns:
        Whether it fits, residual and its variance, predicted inverse distance over the line's distance, the
        line's normal in map, and the bin of the line; all but the first are zero unless it fits.
    """
    states, lines = scans.states, scans.lines
    measured = scans.beams.inverse[k, i]
    angle = states[k, 2] + states[k, 3] * scans.beams.turn[k, i]
    ux, uy = math.cos(angle), math.sin(angle)
    dx, dy = states[k, 0] - states[j, 0], states[k, 1] - states[j, 1]
    cos, sin = math.cos(states[j, 2]), math.sin(states[j, 2])
    bearing = math.atan2(dy + uy / measured, dx + ux / measured) - states[j, 2]
    m = math.floor(bearing * BINS / (2.0 * math.pi)) % BINS
    if not lines.usable[j, m] or lines.kind[j, m] != LINE:
        return OFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    a, b = lines.a[j, m], lines.b[j, m]
    size = math.hypot(a, b)
    nx, ny = (cos * a - sin * b) / size, (sin * a + cos * b) / size
    distance = 1.0 / size - nx * dx - ny * dy
    incidence = nx * ux + ny * uy
    if distance < _MIN_DISTANCE or incidence < _MIN_INCIDENCE:
        return OFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    predicted = incidence / distance
    sigma = scans.beams.sigma[k]
    if predicted < 1.0 / scans.beams.reach[k] + _RANGE_SIGMAS * sigma:
        return UNUSABLE, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    per_metre = predicted / distance
    line_sigma = math.sqrt(lines.variance[j, m]) * lines.distance[j, m] / size  # of its distance [m]
    variance = sigma**2 + (per_metre * line_sigma) ** 2 + (per_metre * _ROUGHNESS) ** 2
    residual = measured - predicted
    if residual * residual > _GATE_VARIANCES * variance + (gate * per_metre) ** 2:
        return OFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    return FIT, residual, variance, per_metre, nx, ny, float(m)


@cached_njit
def agreement(scans: Scans, k: int, j: int, gate: float, stride: int) -> tuple[int, int, float]:
    """Agreement of every `stride`-th beam of stop k with lines of stop j: numbers matched and tried, loss."""
    matched, tried, loss = 0, 0, 0.0
    for i in range(0, scans.beams.counts[k], stride):
        if scans.beams.inverse[k, i] <= 0.0:
            continue
        status, residual, variance, _, _, _, _ = beam_residual(scans, k, i, j, gate)
        if status != UNUSABLE:
            tried += 1
        if status == FIT:
            matched += 1
            loss += math.log(1.0 + residual * residual / variance / CAUCHY)
    return matched, tried, loss


@cached_njit
def accumulate(
    scans: Scans, k: int, j: int, gate: float, stride: int, H: FloatArray, g: FloatArray
) -> tuple[int, int, float]:
    """Add the normal equations of a pair of stops to H (8, 8) and g (8,).

    The unknowns are x, y, theta, ratio of stop k, then those of stop j; H dx = g is the Gauss-Newton step.

    Returns:
        Matched and tried beams, and the information along the lines that errors of their normals imitate.
    """
    matched, tried, imitated = 0, 0, 0.0
    row = np.zeros(8)
    for i in range(0, scans.beams.counts[k], stride):
        if scans.beams.inverse[k, i] <= 0.0:
            continue
        status, residual, variance, per_metre, nx, ny, m = beam_residual(scans, k, i, j, gate)
        if status != UNUSABLE:
            tried += 1
        if status != FIT:
            continue
        matched += 1
        distance = (scans.beams.inverse[k, i] - residual) / per_metre
        _jacobian(scans, k, i, j, distance, nx, ny, row)
        row[7] = row[6] * scans.lines.turn[j, int(m)]
        weight = 1.0 / (variance * (1.0 + residual * residual / variance / CAUCHY))
        imitated += weight * per_metre * per_metre * scans.lines.normal_variance[j, int(m)]
        for a in range(8):
            g[a] += weight * row[a] * residual
            for b in range(8):
                H[a, b] += weight * row[a] * row[b]
    return matched, tried, imitated


@cached_njit
def _jacobian(
    scans: Scans, k: int, i: int, j: int, distance: float, nx: float, ny: float, row: FloatArray
) -> None:
    """Write the derivative (7,) of the inverse distance predicted on a line at a distance, with a normal."""
    states, turn = scans.states, scans.beams.turn[k, i]
    angle = states[k, 2] + states[k, 3] * turn
    ux, uy = math.cos(angle), math.sin(angle)
    dx, dy = states[k, 0] - states[j, 0], states[k, 1] - states[j, 1]
    per_metre = (nx * ux + ny * uy) / (distance * distance)
    row[0], row[1] = per_metre * nx, per_metre * ny
    row[2] = (-nx * uy + ny * ux) / distance
    row[3] = row[2] * turn
    row[4], row[5] = -row[0], -row[1]
    row[6] = (-ny * ux + nx * uy) / distance + per_metre * (-ny * dx + nx * dy)


@cached_njit
def match_pairs(
    scans: Scans, pairs: IntArray, places: IntArray, weights: FloatArray, gate: float, stride: int
) -> tuple[FloatArray, FloatArray]:
    """Weighted normal equations (p, 8, 8) and (p, 8) of pairs (p, 2) of stops: beams of one, lines of other.

    Args:
        scans: All stops.
        pairs: (p, 2).
        places: (p,) number from 0 on of the two places of a pair, of which a first scan was made at one, and
            whose way along a corridor is tested together in both directions; -1: not tested.
        weights: (p,) weight of each pair, since its beams share errors.
        gate: See `beam_residual` [m].
        stride: Every `stride`-th beam is used, with `stride` times the weight.
    """
    H, g = np.zeros((len(pairs), 8, 8)), np.zeros((len(pairs), 8))
    at_place = np.zeros((len(pairs), 4))  # information on x, x and y, y; what is imitated
    for p in range(len(pairs)):
        matched, _, imitated = accumulate(scans, pairs[p, 0], pairs[p, 1], gate, stride, H[p], g[p])
        scale = weights[p] * stride if matched * stride >= MIN_MATCHED else 0.0
        H[p] *= scale
        g[p] *= scale
        if places[p] >= 0:
            for i, value in enumerate((H[p, 0, 0], H[p, 0, 1], H[p, 1, 1], scale * imitated)):
                at_place[places[p], i] += value
    for p in range(len(pairs)):
        xx, xy, yy, imitated = at_place[max(places[p], 0)]
        if places[p] >= 0 and 0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy) < _IMITATED * imitated:
            _remove_direction(H[p], g[p], 0.5 * math.atan2(2.0 * xy, xx - yy) + 0.5 * math.pi)
    return H, g


@cached_njit
def _remove_direction(H: FloatArray, g: FloatArray, angle: float) -> None:
    """Remove the information of a pair on its offset in the direction of an angle.

    In a corridor no wall is across. What the lines seem to tell of the way along it are errors of their
    normals, which are small but add up over many beams, and would be taken for measurements.
    """
    x, y = math.cos(angle), math.sin(angle)
    for first in (0, 4):
        along = x * g[first] + y * g[first + 1]
        g[first] -= along * x
        g[first + 1] -= along * y
        for c in range(8):
            along = x * H[first, c] + y * H[first + 1, c]
            H[first, c] -= along * x
            H[first + 1, c] -= along * y
        for r in range(8):
            along = x * H[r, first] + y * H[r, first + 1]
            H[r, first] -= along * x
            H[r, first + 1] -= along * y


_APART_M = 0.2  # Minimum distance of another place from the best one
SEARCH_BEAMS = 60  # Number of beams of a stop used by the search


class Lattice(NamedTuple):
    """Lattice of offsets around a pose."""

    reach: float  # Maximum offset along x and y of map [m]
    step: float  # Step along x and y [m]
    turn_reach: float  # Maximum offset of the heading [rad]
    turn_step: float  # Step of the heading [rad]


class BestOffset(NamedTuple):
    """The best offset."""

    offset: FloatArray  # (3,) x [m], y [m], theta [rad] to add to the pose
    score: float  # Share of beams that fit any of the other stops, minus their losses
    other: float  # The best score of another place


def search_offsets(scans: Scans, parts: IntArray, against: IntArray, lattice: Lattice) -> BestOffset:
    """The offset of stops (p,), a rigid body that turns about the first, that fits others (q,) best."""
    cells = 2 * int(lattice.reach / lattice.step) + 1
    scores = np.zeros((2 * int(lattice.turn_reach / lattice.turn_step) + 1, cells, cells))
    for k in parts:
        stride = max(3, int(scans.beams.counts[k]) // SEARCH_BEAMS)
        scores += _scores(scans, int(k), int(parts[0]), against, lattice, stride)
    best = np.unravel_index(int(scores.argmax()), scores.shape)
    half = (np.array(scores.shape) - 1) // 2
    a, b, c = (int(index) for index in best - half)
    offset = np.array([b * lattice.step, c * lattice.step, a * lattice.turn_step])
    along_x, along_y = np.ogrid[:cells, :cells]
    apart = np.hypot(along_x - best[1], along_y - best[2]) * lattice.step > _APART_M
    other = float(scores[:, apart].max()) if apart.any() else 0.0
    count = len(parts)
    return BestOffset(offset, float(scores[best]) / count, other / count)


@cached_njit
def _scores(scans: Scans, k: int, pivot: int, against: IntArray, lattice: Lattice, stride: int) -> FloatArray:
    """The score of every offset of the lattice."""
    turns, cells = int(lattice.turn_reach / lattice.turn_step), int(lattice.reach / lattice.step)
    scores = np.zeros((2 * turns + 1, 2 * cells + 1, 2 * cells + 1))
    states = scans.states
    before = states[k].copy()
    arm_x, arm_y = before[0] - states[pivot, 0], before[1] - states[pivot, 1]
    centre_x, centre_y = states[pivot, 0], states[pivot, 1]
    for a in range(-turns, turns + 1):
        turn = a * lattice.turn_step
        cos, sin = math.cos(turn), math.sin(turn)
        for b in range(-cells, cells + 1):
            for c in range(-cells, cells + 1):
                states[k, 0] = centre_x + cos * arm_x - sin * arm_y + b * lattice.step
                states[k, 1] = centre_y + sin * arm_x + cos * arm_y + c * lattice.step
                states[k, 2] = before[2] + turn
                scores[a + turns, b + cells, c + cells] = score(scans, k, against, stride)
    states[k] = before
    return scores


@cached_njit
def score(scans: Scans, k: int, against: IntArray, stride: int) -> float:
    """The share of every `stride`-th beam of a stop that fits any of the others, minus its loss."""
    good, tried = 0.0, 0
    for i in range(0, scans.beams.counts[k], stride):
        if scans.beams.inverse[k, i] <= 0.0:
            continue
        best, can_tell = 0.0, False
        for j in against:
            status, residual, variance, _, _, _, _ = beam_residual(scans, k, i, j, 0.0)
            can_tell = can_tell or status != UNUSABLE
            if status == FIT:
                best = max(best, 1.0 - math.log(1.0 + residual * residual / variance / CAUCHY))
        good += best
        tried += can_tell
    return good / max(1, tried)
