"""The pattern on a robot's top: a black disc, in its front half a white half-disc; the same on all robots.

The disc's rim gives the place, the straight edge of the half-disc across the robot's middle the heading. On a
dark floor a white margin sets the disc off; it does not count to the disc's diameter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.circles import DIRECTIONS, sampled
from swarm_loc_vision.aerial.rectification import Plain

MARK_RADIUS = 0.58
"""Of the white half-disc, in radii of the black disc."""
MARGIN = 0.2
"""Width of the white margin, in radii of the black disc."""


def inside_mark(places: FloatArray) -> FloatArray:
    """(...) how deep places (..., 2) lie in the mark, negative outside; radii of the disc, x to the front."""
    return np.asarray(np.minimum(MARK_RADIUS - np.linalg.norm(places, axis=-1), places[..., 0]))


def draw_pattern(side_px: int) -> NDArray[np.uint8]:
    """The pattern with its margin as a picture (side, side) to be printed; the front is to the right."""
    fine = 4
    axis = (np.arange(side_px * fine) + 0.5) / (side_px * fine) * 2.0 - 1.0
    places = np.stack(np.meshgrid(axis, -axis), axis=-1) * (1.0 + MARGIN)
    white = (np.linalg.norm(places, axis=-1) > 1.0) | (inside_mark(places) > 0.0)
    shares = white.reshape(side_px, fine, side_px, fine).mean(axis=(1, 3))
    return np.asarray(np.rint(255.0 * shares), np.uint8)


_TURNS = 48
_RINGS, _SPOKES, _OUTERMOST = 7, 48, 0.82
_SOFTNESSES = (0.07, 0.14, 0.28)
"""Blur of the mark's edges that are tried, in radii of the disc: robots may look small."""
_MIN_EXPLAINED = 0.7
"""Share of what a plane of light leaves that the mark must explain."""
_MIN_MARK = 0.3
"""Of the mark's step, over that of the disc's rim."""
_RIM = 0.85, 1.25
"""Inside and outside of the rim, in radii."""
_NEWTON_ROUNDS = 4
_TURN_STEP = 1e-3
_MIN_SIGMA = 0.004
"""Of a heading [rad]: what prints and mounts leave."""


class Marks(NamedTuple):
    """Of discs, one row each.

    Attributes:
        theta: (C,) headings [rad] in the grid's axes; NaN where no mark is seen.
        variance: (C,) of them [rad^2].
        step: (C,) by how much the mark is brighter than its disc [counts]; 0 where no mark is seen.
        softness: (C,) blur of its edges, in radii of the disc.
    """

    theta: FloatArray
    variance: FloatArray
    step: FloatArray
    softness: FloatArray

    def light(self, places: FloatArray) -> FloatArray:
        """(C, ...) what the marks add at places (..., 2), in radii of their discs [counts]."""
        shape = (-1, *(1,) * (places.ndim - 1))
        theta = np.nan_to_num(self.theta).reshape(shape)
        return self.step.reshape(shape) * _model(places, theta, self.softness.reshape(shape))


class _Inside(NamedTuple):
    """Places (P, 2) inside a disc in its radii, roots of their weights (P,), and plain light there (P, 3)."""

    places: FloatArray
    root: FloatArray
    light: FloatArray

    def without_light(self, values: FloatArray) -> FloatArray:
        """Weighted values (..., P) less the plane of light that fits them best."""
        rows = values * self.root
        return np.asarray(rows - rows @ self.light @ self.light.T)


def find_marks(plain: Plain, centre: FloatArray, radius: FloatArray, polarity: float) -> Marks:
    """The marks of discs.

    Args:
        plain: Where they are (rows, columns) [counts].
        centre: (C, 2) [px].
        radius: (C,) [px].
        polarity: Of the discs; their mark has the other one.
    """
    if not len(centre):
        return Marks(*np.zeros((4, 0)))
    inside = _inside()
    values = sampled(plain, centre[:, None] + radius[:, None, None] * inside.places)
    bare = inside.without_light(values)
    angles = np.tile(2.0 * np.pi * np.arange(_TURNS) / _TURNS, len(_SOFTNESSES))
    softnesses = np.repeat(_SOFTNESSES, _TURNS)
    models = inside.without_light(_model(inside.places, angles[:, None], softnesses[:, None]))
    models /= np.linalg.norm(models, axis=1, keepdims=True)
    best = np.argmax(-polarity * bare @ models.T, axis=1)
    found = _refined(bare, inside, angles[best], softnesses[best])
    explained = 1.0 - found.variance / np.maximum(np.sum(bare**2, axis=1), 1e-12)
    is_seen = (explained >= _MIN_EXPLAINED) & (
        -polarity * found.step >= _MIN_MARK * np.abs(_rim_steps(plain, centre, radius))
    )
    information = _information(found, inside)
    # samples are nearer together than pixels and share their noise: about every fourth one counts
    variance = 4.0 * found.variance / len(values[0]) * np.mean(inside.root**2) / information
    return Marks(
        np.where(is_seen, se2.wrap_angle(found.theta), np.nan),
        np.where(is_seen, np.maximum(variance, _MIN_SIGMA**2), np.nan),
        np.where(is_seen, found.step, 0.0),
        found.softness,
    )


def _inside() -> _Inside:
    """Places evenly spread over the inside of a disc."""
    radii = _OUTERMOST * (np.arange(_RINGS) + 0.5) / _RINGS
    angles = 2.0 * np.pi * np.arange(_SPOKES) / _SPOKES
    r, a = np.meshgrid(radii, angles, indexing="ij")
    places = np.stack([r * np.cos(a), r * np.sin(a)], axis=-1).reshape(-1, 2)
    root = np.sqrt(r / r.mean()).ravel()
    plane = np.concatenate([np.ones((len(places), 1)), places], axis=1) * root[:, None]
    return _Inside(places, root, np.linalg.qr(plane)[0])


def _model(places: FloatArray, angle: FloatArray, softness: FloatArray) -> FloatArray:
    """A mark's brightness, 0 to 1, at places (..., 2); heading and blur broadcast against (...)."""
    cos, sin = np.cos(angle), np.sin(angle)
    ahead = cos * places[..., 0] + sin * places[..., 1]
    aside = cos * places[..., 1] - sin * places[..., 0]
    return np.asarray(0.5 + 0.5 * np.tanh(inside_mark(np.stack([ahead, aside], axis=-1)) / softness))


def _slope(found: Marks, inside: _Inside) -> FloatArray:
    """(C, P) by how much the light inside changes with the heading."""
    theta, softness = found.theta[:, None], found.softness[:, None]
    ahead, behind = (_model(inside.places, theta + s * _TURN_STEP, softness) for s in (0.5, -0.5))
    return np.asarray(found.step[:, None] * inside.without_light((ahead - behind) / _TURN_STEP))


def _information(found: Marks, inside: _Inside) -> FloatArray:
    """(C,) of the headings, for noise of one count in each sample."""
    return np.asarray(np.maximum(np.sum(_slope(found, inside) ** 2, axis=1), 1e-12))


def _refined(bare: FloatArray, inside: _Inside, theta: FloatArray, softness: FloatArray) -> Marks:
    """Headings (C,) from first ones by Gauss and Newton; `variance` is the sum of squares that is left."""
    found = Marks(theta, np.zeros(len(theta)), np.zeros(len(theta)), softness)
    for _ in range(_NEWTON_ROUNDS):
        mark = inside.without_light(_model(inside.places, found.theta[:, None], softness[:, None]))
        step = np.sum(bare * mark, axis=1) / np.sum(mark**2, axis=1)
        rest = bare - step[:, None] * mark
        found = found._replace(step=step, variance=np.sum(rest**2, axis=1))
        slope = _slope(found, inside)
        turn = np.sum(slope * rest, axis=1) / np.maximum(np.sum(slope**2, axis=1), 1e-12)
        found = found._replace(theta=found.theta + np.clip(turn, -0.1, 0.1))
    return found


def _rim_steps(plain: Plain, centre: FloatArray, radius: FloatArray) -> FloatArray:
    """(C,) by how much the surroundings are brighter than the disc [counts]."""
    inner, outer = (
        sampled(plain, centre[:, None] + share * radius[:, None, None] * DIRECTIONS) for share in _RIM
    )
    return np.asarray(np.median(outer - inner, axis=1))
