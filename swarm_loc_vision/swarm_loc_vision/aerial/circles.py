"""Discs in a rectified image: candidates by voting, then rims measured along rays, to sub-pixels.

Edges on rays from the middle of a disc: found in the logarithm of brightness, located in counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.rectification import Brightness, Plain, logarithm

# Shares and limits were chosen on the pictures of `make bench-aerial`, see `detector`.
_NEAREST, _FARTHEST, _SAMPLES = 0.45, 1.6, 47
SHARES = np.linspace(_NEAREST, _FARTHEST, _SAMPLES)  # Samples on a ray, over the length to the expected edge
_SIDE = 5  # Number of samples compared on each side of an edge: an eighth of the diameter
_RAMP = 16  # Samples on each side of a blurred edge that show its ends: 0.4 of the radius
_AWAY = 6  # Largest distance of the steepest counts from the steepest logarithm [samples]
_NEIGHBOURS, _WEAK = 12, 0.8
"""Rays on each side whose median step an edge is compared with, and its least share of that."""


class EdgesOnRays(NamedTuple):
    """Edges on rays."""

    where: FloatArray  # (C, R) distance from the centre [px]
    step: FloatArray  # (C, R) step of the logarithm of brightness
    is_edge: NDArray[np.bool_]  # (C, R) whether there is an edge


def strongest(
    values: FloatArray,
    is_rim: NDArray[np.bool_],
    reach: FloatArray,
    polarity: float,
    least: Callable[[FloatArray], FloatArray],
    soft: NDArray[np.bool_],
) -> EdgesOnRays:
    """The strongest edges of values (C, R, S), logarithms of brightness, at `SHARES` of reaches (C, R) [px].

    At a rim (C, R, S) brightness changes across the outline and not along it; `least` are the least steps of
    edges by their darker side, and edges of soft discs (C,) are taken for blurred ones.
    """
    sums = np.concatenate([np.zeros((*values.shape[:2], 1)), np.cumsum(values, axis=2)], axis=2)
    inner = (sums[..., _SIDE:-_SIDE] - sums[..., : -2 * _SIDE]) / _SIDE
    outer = (sums[..., 2 * _SIDE :] - sums[..., _SIDE:-_SIDE]) / _SIDE
    steps = polarity * (inner - outer)
    may_be = is_rim[..., _SIDE - 1 : -_SIDE] | is_rim[..., _SIDE : 1 - _SIDE]
    best = np.argmax(np.where(may_be, steps, 0.0), axis=2)
    between = np.clip(best, 1, steps.shape[2] - 2)
    pitch = SHARES[1] - SHARES[0]
    share = SHARES[0] + pitch * (between + _vertex(steps, between) + _SIDE - 0.5)
    if soft.any():
        # motion makes an edge a ramp, whose middle is the rim; the logarithm is steepest at its dark end
        ramp = np.arange(-_RAMP, _RAMP + 1)
        window = np.clip(best[soft][..., None] + _SIDE + ramp, 0, values.shape[2] - 1)
        counts = polarity * np.take_along_axis(np.exp(values[soft]), window, axis=2)
        above = counts - 0.5 * (counts[..., :1] + counts[..., -1:])
        last = np.clip(np.argmax(above < 0.0, axis=2), 1, 2 * _RAMP)[..., None]
        before, after = (np.take_along_axis(above, last - k, axis=2)[..., 0] for k in (1, 0))
        part = np.clip(before / np.maximum(before - after, 1e-9), 0.0, 1.0)
        share[soft] = SHARES[0] + pitch * (np.take_along_axis(window, last - 1, axis=2)[..., 0] + part)
    step = np.take_along_axis(steps, best[..., None], axis=2)[..., 0]
    darkest = np.minimum(inner.min(axis=2), outer.min(axis=2))
    inside = (best > 0) & (best < steps.shape[2] - 1)
    return EdgesOnRays(share * reach, step, inside & (step > least(darkest)))


def steepest(values: FloatArray, reach: FloatArray, polarity: float, edges: EdgesOnRays) -> EdgesOnRays:
    """Edges (C, R) moved to where counts are steepest; values and reach as for `strongest`.

    Blur moves the steepest place of the logarithm to the dark side, the more the larger the step. So light
    that differs around a rim, as near a mark or in a shadow, would move the centre. An edge that is weaker
    than those around it has another disc nearby, whose rim is in the same blur.
    """
    pitch = SHARES[1] - SHARES[0]
    near = np.rint((edges.where / reach - SHARES[0]) / pitch + 0.5).astype(np.int64) - _SIDE
    counts = polarity * np.exp(values)
    sums = np.concatenate([np.zeros((*counts.shape[:2], 1)), np.cumsum(counts, axis=2)], axis=2)
    steps = (2.0 * sums[..., _SIDE:-_SIDE] - sums[..., : -2 * _SIDE] - sums[..., 2 * _SIDE :]) / _SIDE
    between = np.clip(near, 1, steps.shape[2] - 2)
    for _ in range(_AWAY):  # uphill: a higher step farther away is another edge
        around = np.stack([np.take_along_axis(steps, between[..., None] + k, 2)[..., 0] for k in (-1, 0, 1)])
        between = np.clip(between + np.argmax(around, axis=0) - 1, 1, steps.shape[2] - 2)
    share = SHARES[0] + pitch * (between + _vertex(steps, between) + _SIDE - 0.5)
    size = np.take_along_axis(steps, between[..., None], axis=2)[..., 0]
    around = np.pad(np.where(edges.is_edge, size, 0.0), ((0, 0), (_NEIGHBOURS, _NEIGHBOURS)), mode="wrap")
    usual = np.median(sliding_window_view(around, 2 * _NEIGHBOURS + 1, axis=1), axis=2)
    return EdgesOnRays(share * reach, edges.step, edges.is_edge & (size >= _WEAK * usual))


def _vertex(steps: FloatArray, between: NDArray[np.int64]) -> FloatArray:
    """(C, R) offset of the vertex of the parabola through steps (C, R, S) at and next to places (C, R)."""
    rows = np.indices(between.shape)
    left, mid, right = (steps[rows[0], rows[1], between + k] for k in (-1, 0, 1))
    bend = left - 2.0 * mid + right
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(bend < 0.0, 0.5 * (left - right) / bend, 0.0)
    return np.asarray(np.clip(offset, -1.0, 1.0))


_RADII = np.array([0.82, 0.91, 1.0, 1.09, 1.18])
_MAX_EDGES = 400_000
_EDGE_SHARE = 0.15  # Least slope of an edge per pixel, over the least contrast
_BLUR_SHARE, _APART_SHARE = 0.08, 0.3  # Smoothing of votes and least distance of candidates, in diameters
_LEAST_VOTES = 0.2  # Least votes of a candidate, over the most


class Edges:
    """Edges of an image where it is `seen` (rows, columns); `contrast` is the least step of an edge."""

    def __init__(self, image: Brightness, seen: NDArray[np.bool_], contrast: float) -> None:
        self._shape = seen.shape
        across, down = image.log[..., 1], image.log[..., 2]
        slope = np.hypot(across, down)
        # the rim of the valid area is no edge
        slope[cv2.erode(seen.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0] = 0.0
        least = _EDGE_SHARE * contrast
        rows, columns = np.nonzero(slope > least)
        strength = slope[rows, columns]
        if len(strength) > _MAX_EDGES:
            kept = np.argpartition(-strength, _MAX_EDGES)[:_MAX_EDGES]
            rows, columns, strength = rows[kept], columns[kept], strength[kept]
        self._x, self._y = columns.astype(np.float32), rows.astype(np.float32)
        self._across, self._down = (part[rows, columns] / strength for part in (across, down))
        # strong edges count little more than weak ones: a shadow may weaken one side of a disc
        self._weight = strength / (strength + 2.0 * least)

    def votes(self, diameter_px: float, polarity: float) -> Plain:
        """(rows, columns) votes for centres of discs."""
        margin = int(0.5 * diameter_px * _RADII[-1]) + 2
        rows, columns = (n + 2 * margin for n in self._shape)
        middle, flat = np.float32(margin + 0.5), []
        for reach in (0.5 * polarity * diameter_px * _RADII).astype(np.float32):
            row, column = self._y + reach * self._down + middle, self._x + reach * self._across + middle
            flat.append(row.astype(np.int32) * columns + column.astype(np.int32))
        total = np.bincount(np.concatenate(flat), np.tile(self._weight, len(_RADII)), rows * columns)
        inner = slice(margin, -margin)
        votes = total.reshape(rows, columns)[inner, inner].astype(np.float32)
        return np.asarray(cv2.GaussianBlur(votes, (0, 0), max(_BLUR_SHARE * diameter_px, 0.8)), np.float32)


def peaks(votes: Plain, diameter_px: float, most: int) -> FloatArray:
    """(C, 2) columns and rows of the highest peaks of votes, in descending order, at most `most`.

    Robots that look alike get alike many votes, unless their rims are hidden.
    """
    side = 2 * max(int(_APART_SHARE * diameter_px), 1) + 1
    highest = cv2.dilate(votes, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
    rows, columns = np.nonzero((votes >= highest) & (votes > _LEAST_VOTES * votes.max(initial=0.0)))
    order = np.argsort(-votes[rows, columns], kind="stable")[:most]
    return np.stack([columns[order], rows[order]], axis=1).astype(float)


RAYS = 64
_WIDEST = 0.3  # Largest relative difference of a rim from the expected radius
_OFF, _NEAR = 0.08, 0.12
"""Largest distance of an edge of a circle, and of one that shows its errors, from the circle in radii."""
_ALONG = 0.92  # Least cosine of the angle between the slope of brightness at an edge and the normal there
_BLOCK = 30_000  # OpenCV's images have fewer than 2^15 rows
_ROUNDS = 3
_EVERY, _LIKELY = 4, 0.4  # Candidates are first tested on every fourth ray; this share must meet an edge
_MIN_RAYS = 12
_NOISES = 0.5  # Least step of an edge over the noise of one pixel: its two sides are means over many pixels
_TOGETHER = 3.0  # Neighbouring rays that share pixels, and so one error
_MIN_PAIRS = 8  # Least opposite rays with edges that show the errors which move a centre

_OVAL_RIDGE = 1.0  # Prior information on the oval, in edges: half a rim says little of it

_ANGLES = 2.0 * np.pi * np.arange(RAYS) / RAYS
DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
_OVALS, _SQUARES = (np.stack([np.cos(n * _ANGLES), np.sin(n * _ANGLES)], axis=1) for n in (2, 4))


class Circles(NamedTuple):
    """Measured candidates, one row each."""

    centre: FloatArray  # (C, 2) column and row [px]
    radius: FloatArray  # (C,) [px]
    coverage: FloatArray  # (C,) share of the rays that meet an edge of the outline
    contrast: FloatArray  # (C,) median step of these edges, of the logarithm of brightness
    spread: FloatArray  # (C,) root mean square distance of these edges from the outline [px]
    oval: FloatArray  # (C, 2) cosine and sine of the second harmonic of the outline, as left by motion [px]
    covariance: FloatArray  # (C, 2, 2) of the centre [px^2]
    squareness: FloatArray  # (C,) how much these edges lie on four sides; about 0.7: those of a square
    kind: NDArray[np.int64]  # (C,) `TOP`, `SIDES`, `PARTLY` or `INNER`: what the outline is
    soft: NDArray[np.bool_]  # (C,) whether the edges are taken for blurred ones

    def select(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Circles:
        """Some of the rows."""
        columns: list[NDArray[Any]] = [column[rows] for column in self]
        return Circles(*columns)

    def updated(self, rows: NDArray[np.int64], others: Circles) -> Circles:
        """These candidates, but others (len(rows),) in some rows."""
        columns: list[NDArray[Any]] = [column.copy() for column in self]
        for column, new in zip(columns, others, strict=True):
            column[rows] = new
        return Circles(*columns)


TOP, SIDES, PARTLY, INNER = range(4)
"""What the outline of a robot is: its top, top and sides, the top and sides that are narrower below, or a
circle on the top, as the rim of a lid."""


class Sides(NamedTuple):
    """Sides of upright cylinders of one height, seen on the rectified plane of their tops.

    A cylinder hides the hull of its top and of its base, which is a smaller circle nearer to the foot.
    """

    foot: FloatArray  # (2,) column and row below the camera
    share: float  # Height of the cylinders over that of the camera

    def outline(
        self, centre: FloatArray, radius: FloatArray, kind: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray]:
        """Length of rays (C, R) from centres to the outline, in radii, and its normals (C, R, 2) there."""
        length, normal = np.ones((len(centre), RAYS)), np.tile(DIRECTIONS, (len(centre), 1, 1))
        base = (self.foot - centre) * (self.share / radius)[:, None]
        away = np.linalg.norm(base, axis=1)
        rows = np.flatnonzero(
            (kind != TOP) & (kind != INNER) & (away > self.share)
        )  # otherwise the top hides the base
        base, away, size = base[rows], away[rows], 1.0 - self.share
        along = base @ DIRECTIONS.T
        # where a ray meets the base's circle, and the tangent of both circles on its side
        far = along + np.sqrt(np.maximum(size**2 - away[:, None] ** 2 + along**2, 0.0))
        of_base = (far[..., None] * DIRECTIONS - base[:, None]) / size
        towards = base / away[:, None]
        cos = self.share / away
        aside = np.stack([-towards[:, 1], towards[:, 0]], axis=1)
        side = np.where(aside @ DIRECTIONS.T < 0.0, -1.0, 1.0)[..., None]
        of_line = (cos[:, None] * towards)[:, None] + side * (np.sqrt(1.0 - cos**2)[:, None] * aside)[:, None]
        is_base = np.einsum("cri,ci->cr", of_base, base) >= self.share
        beyond = along > self.share
        found = np.where(is_base[..., None], of_base, of_line)
        reach = np.where(is_base, far, 1.0 / np.einsum("cri,ri->cr", of_line, DIRECTIONS))
        length[rows] = np.where(beyond, reach, 1.0)
        normal[rows] = np.where(beyond[..., None], found, DIRECTIONS)
        return length, normal


def sampled(image: Plain, cells: FloatArray) -> Plain:
    """Values (...) or (..., K) of an image at columns and rows (..., 2), linear between pixels."""
    columns, rows = np.ascontiguousarray(cells.reshape(-1, 2).T, np.float32)[..., None]
    out = np.empty((len(columns), *image.shape[2:]), np.float32)
    for begin in range(0, len(columns), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        values = cv2.remap(
            image, columns[part], rows[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        out[part] = values[:, 0]
    return out.reshape(*cells.shape[:-1], *image.shape[2:])


Light = Callable[[FloatArray], FloatArray]
"""Light to subtract from discs: (C, ...) counts at places (..., 2) in their radii."""


@dataclass(frozen=True)
class Rims:
    """Measures rims of discs."""

    image: Brightness  # The image
    polarity: float  # Polarity of the discs
    min_contrast: float  # Least step of an edge in the logarithm of brightness
    sides: Sides  # The discs' sides; a share of 0: they are flat

    def measure(
        self,
        centre: FloatArray,
        radius: FloatArray,
        kind: NDArray[np.int64],
        soft: NDArray[np.bool_],
        without: Light | None = None,
        *,
        fine: bool = False,
    ) -> Circles:
        """Fit outlines near centres (C, 2) of about radii (C,) [px].

        `fine` takes edges where counts are steepest: slower, and exact where blur reaches other edges.
        """
        low, high = (1.0 - _WIDEST) * radius, (1.0 + _WIDEST) * radius
        found = radius
        for _ in range(_ROUNDS):
            start = np.clip(found, low, high)
            length, normal = self.sides.outline(centre, start, kind)
            reach = start[:, None] * length
            edge, step, is_edge = self.edges(centre, start, reach, normal, soft, without, fine=fine)
            away = edge - reach
            # narrower sides end anywhere between the rim of the top and those of a cylinder
            hidden = (kind[:, None] == PARTLY) & (length > 1.0)
            loose = (
                hidden & (edge >= (1.0 - _OFF) * start[:, None]) & (away <= _OFF * start[:, None]) & is_edge
            )
            shift, found, oval, covariance, spread, own = _fit(away, is_edge & ~hidden, start, normal)
            centre = centre + shift
        coverage = np.where((found >= low) & (found <= high), (own | loose).mean(axis=1), 0.0)
        contrast = _masked_median(step, own, np.zeros(len(step)))
        squareness = np.hypot(*(own @ _SQUARES).T) / np.maximum(own.sum(axis=1), 1)
        return Circles(centre, found, coverage, contrast, spread, oval, covariance, squareness, kind, soft)

    def edges(
        self,
        centre: FloatArray,
        radius: FloatArray,
        reach: FloatArray,
        normal: FloatArray,
        soft: NDArray[np.bool_],
        without: Light | None,
        *,
        fine: bool,
    ) -> EdgesOnRays:
        """The strongest edge on each ray near the outline at `reach` (C, R) [px], R a divisor of `RAYS`."""
        rays = DIRECTIONS[:: RAYS // reach.shape[1]]
        places = reach[..., None, None] * (SHARES[:, None] * rays[:, None])
        cells = centre[:, None, None] + places
        values, *slope = np.moveaxis(sampled(self.image.log, cells), -1, 0)
        towards = (-self.polarity * normal).astype(np.float32)
        across = slope[0] * towards[..., :1] + slope[1] * towards[..., 1:]
        is_rim = (across > 0.0) & (across**2 > np.float32(_ALONG**2) * (slope[0] ** 2 + slope[1] ** 2))
        if without is not None:
            plain = sampled(self.image.plain, cells)
            values = logarithm(plain - without(places / radius[:, None, None, None]))

        def least(darkest: FloatArray) -> FloatArray:
            return np.maximum(self.min_contrast, _NOISES * self.image.noise * np.exp(-darkest))

        edges = strongest(values, is_rim, reach, self.polarity, least, soft)
        return steepest(values, reach, self.polarity, edges) if fine else edges


def likely(rims: Rims, centres: FloatArray, radius: float) -> FloatArray:
    """The candidates (C, 2) with enough edges around to be discs of about a radius [px]."""
    count, none = len(centres), np.zeros(len(centres), np.bool_)
    size, normal = np.full(count, radius), np.tile(DIRECTIONS[::_EVERY], (count, 1, 1))
    reach = np.tile(size[:, None], RAYS // _EVERY)
    is_edge = rims.edges(centres, size, reach, normal, none, None, fine=False).is_edge
    return np.asarray(centres[is_edge.mean(axis=1) >= _LIKELY], float)


def _masked_median(values: FloatArray, mask: NDArray[np.bool_], otherwise: FloatArray) -> FloatArray:
    """(C,) medians over the masked entries of each row (C, R)."""
    count = mask.sum(axis=1)
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2], axis=1)
    ordered = np.sort(np.where(mask, values, np.inf), axis=1)
    return np.where(count > 0, np.take_along_axis(ordered, middle, axis=1).mean(axis=1), otherwise)


def _fit(
    away: FloatArray, is_edge: NDArray[np.bool_], radius: FloatArray, normal: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Shift of centres, radius, second harmonic, covariance of the centre, spread, and the edges used.

    Outlines are fitted to distances (C, R) of edges along the rays, with normals (C, R, 2) there.
    """
    # along a ray an outline moves by its motion along the normal over the cosine to it
    slope = 1.0 / np.einsum("cri,ri->cr", normal, DIRECTIONS)[..., None]
    design = np.concatenate([slope * normal, slope, np.broadcast_to(_OVALS, normal.shape)], axis=2)
    ridge = np.diag([1e-6, 1e-6, 1e-6, _OVAL_RIDGE, _OVAL_RIDGE])
    middle = _masked_median(away, is_edge, np.zeros(len(away)))
    size = (radius + middle)[:, None]
    residual = away - middle[:, None]
    for limit in (0.3, 0.2, _OFF):
        used = design * (is_edge & (np.abs(residual) <= limit * size))[..., None]
        weights = np.swapaxes(used, 1, 2)
        solution = np.linalg.solve(weights @ design + ridge, weights @ away[..., None])
        residual = away - (design @ solution)[..., 0]
    near, own = (is_edge & (np.abs(residual) <= limit * size) for limit in (_NEAR, _OFF))
    count = own.sum(axis=1)
    spread = np.sqrt(np.sum(own * residual**2, axis=1) / np.maximum(count - 5, 1))
    used = design * own[..., None]
    # what is alike on opposite sides, as the blur by motion and tilt, does not move a centre
    half = RAYS // 2
    both = near[:, :half] & near[:, half:]
    uneven, pairs = 0.5 * (residual[:, :half] - residual[:, half:]), both.sum(axis=1)
    seen = 2.0 * np.sum(both * uneven**2, axis=1) / np.maximum(pairs - 2, 1)
    variance = _TOGETHER * np.where(pairs >= _MIN_PAIRS, seen, spread**2)
    covariance = variance[:, None, None] * np.linalg.inv(np.swapaxes(used, 1, 2) @ design + ridge)[:, :2, :2]
    few = count < _MIN_RAYS
    own[few] = False
    solution = np.where(few[:, None], 0.0, solution[..., 0])
    return solution[:, :2], radius + solution[:, 2], solution[:, 3:], covariance, spread, own
