"""The three methods of the paper to identify a robot by its own motion; motions are complex numbers.

The robot moves by W in the frame in which its heading was zero; the image shows that it moved by D. Then
D = c W with c = lambda exp(i theta), lambda the scale of the image and theta the heading (aerial
self-localization paper, eqs. (12)-(14); its eqs. (15)-(23) are the real parts of this equation, solved with
arctan, arccos and arcsin, which lose the quadrant and one of two roots each).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle

ComplexArray = NDArray[np.complex128]


def own_displacement(speeds: ArrayLike, turn_rates: ArrayLike, step_s: float) -> ComplexArray:
    """The motion W (..., 1) [m] by constant commands of a step each: sum of v_j exp(i dt sum_k<=j r_k) dt.

    A backward difference as eqs. (10) and (13) of the paper: a step goes along the heading at its end.

    Args:
        speeds: (..., m) [m/s].
        turn_rates: (..., m) [rad/s].
        step_s: Duration of a step [s].
    """
    heading = step_s * np.cumsum(np.asarray(turn_rates, dtype=float), axis=-1)
    moved: ComplexArray = step_s * np.sum(np.asarray(speeds, dtype=float) * np.exp(1j * heading), axis=-1)
    return moved


class Relation(NamedTuple):
    """How displacements in an image relate to a robot's own."""

    heading: FloatArray  # (...) theta [rad]
    scale: FloatArray  # (...) lambda, in units of the image per metre


def relation(displacement: ArrayLike, own: ArrayLike) -> Relation:
    """The relation from one displacement each: theta = arg D - arg W, lambda = |D| / |W|.

    Args:
        displacement: (...) D, complex.
        own: (...) W, complex and not zero.
    """
    ratio = np.asarray(displacement) / np.asarray(own)
    return Relation(np.angle(ratio), np.abs(ratio))


class Fit(NamedTuple):
    """Chains of positions fitted by a robot's own motion."""

    coefficient: ComplexArray  # (...) c
    cost: FloatArray  # (...) sum of squared residuals over the positions' variance, and the scale's misfit


def fit_chains(
    positions: ComplexArray, own: ComplexArray, sigma: float, scale: float = 1.0, scale_sigma: float = np.inf
) -> Fit:
    """Fit z_k = p + c W_k to chains by complex least squares, with or without a known scale.

    Args:
        positions: (..., k) positions of a chain in k images.
        own: (k,) where the robot was by its own motion.
        sigma: Standard deviation of each coordinate of a position.
        scale: |c| as far as it is known.
        scale_sigma: How unsure that is, in the same unit; infinite: unknown.
    """
    z, w = positions - positions.mean(axis=-1, keepdims=True), own - own.mean()
    power = float(np.sum(np.abs(w) ** 2))
    correlation: ComplexArray = z @ w.conj()
    weight = (
        sigma / scale_sigma
    ) ** 2  # the information on |c| of the prior, that of the positions is `power`
    length = (np.abs(correlation) + weight * scale) / max(power + weight, np.finfo(float).tiny)
    coefficient = length * np.exp(1j * np.angle(correlation))
    residual = z - coefficient[..., None] * w
    cost = np.sum(np.abs(residual) ** 2, axis=-1) / sigma**2
    return Fit(coefficient, cost + ((length - scale) / scale_sigma) ** 2)


def turn_misfits(headings: FloatArray, own_turns: FloatArray) -> FloatArray:
    """By how much each robot in a series of images turned otherwise: sums of squared differences (..., n).

    Args:
        headings: (..., k + 1, n) of the robots in each image [rad]; they stand, so each keeps its place.
        own_turns: (..., k) own turn between consecutive images, with its sign [rad].
    """
    turned = np.diff(headings, axis=-2)
    misfit: FloatArray = np.sum(wrap_angle(turned - own_turns[..., None]) ** 2, axis=-2)
    return misfit


def identify_by_turns(headings: FloatArray, own_turns: FloatArray) -> int:
    """Which robot (of n) one that turned so is; arguments as for `turn_misfits`."""
    return int(np.argmin(turn_misfits(headings, own_turns)))


def chain_costs(
    images: ComplexArray, way: FloatArray, sigma: float, scale: float, scale_sigma: float
) -> FloatArray:
    """Costs (n, n, n) of all chains of three images, of n^3 that the paper tests, too.

    Args:
        images: (3, n) positions in each image.
        way: (3,) driven by each image, in a straight line [m].
        sigma: Standard deviation of each coordinate of a position.
        scale: Of the image, in its units per metre.
        scale_sigma: How unsure that is; infinite: unknown.
    """
    n = images.shape[1]
    chains = np.empty((n, n, n, 3), dtype=complex)
    chains[..., 0] = images[0][:, None, None]
    chains[..., 1] = images[1][None, :, None]
    chains[..., 2] = images[2][None, None, :]
    return fit_chains(chains, way.astype(complex), sigma, scale, scale_sigma).cost


def identify_by_speeds(
    images: ComplexArray, way: FloatArray, sigma: float, scale: float, scale_sigma: float
) -> tuple[int, ...]:
    """Which position of each of three images is that of a robot that drove so; arguments as above."""
    cost = chain_costs(images, way, sigma, scale, scale_sigma)
    return tuple(int(place) for place in np.unravel_index(np.argmin(cost), cost.shape))


def pair_misfits(first: ComplexArray, second: ComplexArray, own: complex) -> FloatArray:
    """By how much the distances of all pairs (n, m) differ from the own way: | |D| - |W| |.

    Args:
        first: (n,) positions in the first image.
        second: (m,) positions in the second one.
        own: W, the own motion in between, in the frame of the first heading.
    """
    misfit: FloatArray = np.abs(np.abs(second[None, :] - first[:, None]) - abs(own))
    return misfit


def identify_by_way(first: ComplexArray, second: ComplexArray, own: complex) -> tuple[int, int, float]:
    """Which position in each image is that of a robot that moved by W, and its first heading [rad].

    Arguments as for `pair_misfits`; W must not be zero for the heading to mean anything.
    """
    misfit = pair_misfits(first, second, own)
    i, j = (int(place) for place in np.unravel_index(np.argmin(misfit), misfit.shape))
    return i, j, float(relation(second[j] - first[i], own).heading)
