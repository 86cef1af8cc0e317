"""Edges on rays from the middle of a disc: found in the logarithm of brightness, located in counts."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray

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
    reach: FloatArray,
    polarity: float,
    least: Callable[[FloatArray], FloatArray],
    soft: NDArray[np.bool_] | None,
) -> EdgesOnRays:
    """The strongest edges of values (C, R, S), logarithms of brightness, along rays.

    Args:
        values: At `SHARES` of `reach`.
        reach: (C, R) [px].
        polarity: Polarity of the discs.
        least: Least steps of edges by the logarithm of brightness on their darker side.
        soft: (C,) whether the edges are taken for blurred ones.
    """
    sums = np.concatenate([np.zeros((*values.shape[:2], 1)), np.cumsum(values, axis=2)], axis=2)
    inner = (sums[..., _SIDE:-_SIDE] - sums[..., : -2 * _SIDE]) / _SIDE
    outer = (sums[..., 2 * _SIDE :] - sums[..., _SIDE:-_SIDE]) / _SIDE
    steps = polarity * (inner - outer)
    best = np.argmax(steps, axis=2)
    between = np.clip(best, 1, steps.shape[2] - 2)
    pitch = SHARES[1] - SHARES[0]
    share = SHARES[0] + pitch * (between + _vertex(steps, between) + _SIDE - 0.5)
    if soft is not None and soft.any():
        share[soft] = _halfway(np.exp(values[soft]), best[soft] + _SIDE, polarity)
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
        beside = np.stack([np.take_along_axis(steps, between[..., None] + k, 2)[..., 0] for k in (-1, 0, 1)])
        between = np.clip(between + np.argmax(beside, axis=0) - 1, 1, steps.shape[2] - 2)
    share = SHARES[0] + pitch * (between + _vertex(steps, between) + _SIDE - 0.5)
    size = np.take_along_axis(steps, between[..., None], axis=2)[..., 0]
    around = np.pad(np.where(edges.is_edge, size, 0.0), ((0, 0), (_NEIGHBOURS, _NEIGHBOURS)), mode="wrap")
    usual = np.median(sliding_window_view(around, 2 * _NEIGHBOURS + 1, axis=1), axis=2)
    return EdgesOnRays(share * reach, edges.step, edges.is_edge & (size >= _WEAK * usual))


def _vertex(steps: FloatArray, between: NDArray[np.int64]) -> FloatArray:
    """(C, R) offset of the vertex of the parabola through steps (C, R, S) at and beside places (C, R)."""
    rows = np.indices(between.shape)
    left, mid, right = (steps[rows[0], rows[1], between + k] for k in (-1, 0, 1))
    bend = left - 2.0 * mid + right
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(bend < 0.0, 0.5 * (left - right) / bend, 0.0)
    return np.asarray(np.clip(offset, -1.0, 1.0))


def _halfway(values: FloatArray, near: NDArray[np.int64], polarity: float) -> FloatArray:
    """Where counts (C, R, S) along rays are halfway between those on both sides of blurred edges, in `reach`.

    Motion makes an edge a ramp, the middle of which is the rim; the logarithm is steepest at its dark end.
    """
    window = np.clip(near[..., None] + np.arange(-_RAMP, _RAMP + 1), 0, values.shape[2] - 1)
    counts = polarity * np.take_along_axis(values, window, axis=2)
    above = counts - 0.5 * (counts[..., :1] + counts[..., -1:])
    last = np.clip(np.argmax(above < 0.0, axis=2), 1, 2 * _RAMP)[..., None]
    before, after = (np.take_along_axis(above, last - k, axis=2)[..., 0] for k in (1, 0))
    part = np.clip(before / np.maximum(before - after, 1e-9), 0.0, 1.0)
    index = np.take_along_axis(window, last - 1, axis=2)[..., 0] + part
    return np.asarray(SHARES[0] + (SHARES[1] - SHARES[0]) * index)
