"""The pattern on the robots: a black disc with a white half-disc as mark in its front half.

The rim of the disc gives the position, the mark the heading: a model of the mark is turned until it fits the
image best. On a dark floor a white margin surrounds the disc; it is not part of the diameter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.circles import DIRECTIONS, sampled
from swarm_loc_vision.aerial.rectification import Plain

MARK_RADIUS = 0.58  # Radius of the white half-disc, in radii of the black disc
MARGIN = 0.2  # Width of the white margin, in radii of the black disc


def inside_mark(places: FloatArray) -> FloatArray:
    """(...) depth of places (..., 2) in the mark, negative outside, in radii of the disc; x to the front."""
    return np.asarray(np.minimum(MARK_RADIUS - np.linalg.norm(places, axis=-1), places[..., 0]))


# Samples and limits of the mark were chosen on the pictures of `make bench-aerial`, see `detector`.
_TURNS = 48
_RINGS, _SPOKES, _OUTERMOST = 7, 48, 0.82
_SOFTNESSES = (0.07, 0.14, 0.28)  # Candidates for the blur of the mark's edges, in radii of the disc
_MIN_EXPLAINED = 0.7  # Least share of the residuals of a plane of light that the mark must explain
_MIN_MARK = 0.3  # Least step of the mark over that of the disc's rim
_RIM = 0.85, 1.25  # Radii of the samples inside and outside of the rim, over the radius
_NEWTON_ROUNDS = 4
_TURN_STEP = 1e-3
_MIN_SIGMA = 0.004  # Error of a heading by print and mounting [rad]


class Marks(NamedTuple):
    """Marks of discs, one row each."""

    theta: FloatArray  # (C,) headings in the axes of the grid [rad]; NaN where there is no mark
    variance: FloatArray  # (C,) variance of the headings [rad^2]
    step: FloatArray  # (C,) brightness of the mark minus that of the disc [counts]; 0 where there is no mark
    softness: FloatArray  # (C,) blur of the edges, in radii of the disc

    def light(self, places: FloatArray) -> FloatArray:
        """(C, R, S) light of the marks at places (C, R, S, 2) in radii of their discs [counts]."""
        shape = (-1, 1, 1)
        theta = np.nan_to_num(self.theta).reshape(shape)
        return self.step.reshape(shape) * _model(places, theta, self.softness.reshape(shape))


class _Inside(NamedTuple):
    """Places (P, 2) inside a disc in its radii, roots of their weights (P,), and a basis of planes (P, 3)."""

    places: FloatArray
    root: FloatArray
    light: FloatArray

    def without_light(self, values: FloatArray) -> FloatArray:
        """Weighted values (..., P) minus the plane of light that fits them best."""
        rows = values * self.root
        return np.asarray(rows - rows @ self.light @ self.light.T)


def find_marks(plain: Plain, centre: FloatArray, radius: FloatArray, polarity: float) -> Marks:
    """Find the marks of discs with centres (C, 2) and radii (C,) [px] in an image (rows, columns) [counts].

    A mark has the opposite polarity of its disc.
    """
    if not len(centre):
        return Marks(*np.zeros((4, 0)))
    # places spread evenly over a disc
    radii = _OUTERMOST * (np.arange(_RINGS) + 0.5) / _RINGS
    angles = 2.0 * np.pi * np.arange(_SPOKES) / _SPOKES
    r, a = np.meshgrid(radii, angles, indexing="ij")
    places = np.stack([r * np.cos(a), r * np.sin(a)], axis=-1).reshape(-1, 2)
    root = np.sqrt(r / r.mean()).ravel()
    plane = np.concatenate([np.ones((len(places), 1)), places], axis=1) * root[:, None]
    inside = _Inside(places, root, np.linalg.qr(plane)[0])
    # the best of some turns and softnesses, refined
    values = sampled(plain, centre[:, None] + radius[:, None, None] * inside.places).astype(float)
    bare = inside.without_light(values)
    angles = np.tile(2.0 * np.pi * np.arange(_TURNS) / _TURNS, len(_SOFTNESSES))
    softnesses = np.repeat(_SOFTNESSES, _TURNS)
    models = inside.without_light(_model(inside.places, angles[:, None], softnesses[:, None]))
    models /= np.linalg.norm(models, axis=1, keepdims=True)
    best = np.argmax(-polarity * bare @ models.T, axis=1)
    found = _refined(bare, inside, angles[best], softnesses[best])
    explained = 1.0 - found.variance / np.maximum(np.sum(bare**2, axis=1), 1e-12)
    # the mark must explain the light, and be as clear as the rim of its disc
    rim = [sampled(plain, centre[:, None] + share * radius[:, None, None] * DIRECTIONS) for share in _RIM]
    rim_step = np.abs(np.median(rim[1] - rim[0], axis=1))
    is_seen = (explained >= _MIN_EXPLAINED) & (-polarity * found.step >= _MIN_MARK * rim_step)
    # of the headings, for noise of one count in each sample
    information = np.maximum(np.sum(_slope(found, inside) ** 2, axis=1), 1e-12)
    # samples are closer than pixels and share their noise: about every fourth one is independent
    variance = 4.0 * found.variance / len(values[0]) * np.mean(inside.root**2) / information
    return Marks(
        np.where(is_seen, se2.wrap_angle(found.theta), np.nan),
        np.where(is_seen, np.maximum(variance, _MIN_SIGMA**2), np.nan),
        np.where(is_seen, found.step, 0.0),
        found.softness,
    )


def _model(places: FloatArray, angle: FloatArray, softness: FloatArray) -> FloatArray:
    """Brightness of a mark, 0 to 1, at places (..., 2); heading and blur broadcast against (...)."""
    cos, sin = np.cos(angle), np.sin(angle)
    ahead = cos * places[..., 0] + sin * places[..., 1]
    aside = cos * places[..., 1] - sin * places[..., 0]
    return np.asarray(0.5 + 0.5 * np.tanh(inside_mark(np.stack([ahead, aside], axis=-1)) / softness))


def _slope(found: Marks, inside: _Inside) -> FloatArray:
    """(C, P) derivative of the light by the heading."""
    theta, softness = found.theta[:, None], found.softness[:, None]
    ahead, behind = (_model(inside.places, theta + s * _TURN_STEP, softness) for s in (0.5, -0.5))
    return np.asarray(found.step[:, None] * inside.without_light((ahead - behind) / _TURN_STEP))


def _refined(bare: FloatArray, inside: _Inside, theta: FloatArray, softness: FloatArray) -> Marks:
    """Refine headings (C,) by Gauss-Newton; `variance` is the remaining sum of squares."""
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
