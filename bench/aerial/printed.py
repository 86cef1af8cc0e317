"""The paper's methods as they are printed, with what is missing filled in as kindly as can be."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from swarm_loc_estimator.common.se2 import wrap_angle

if TYPE_CHECKING:
    from bench.aerial.paper_methods import ComplexArray
    from swarm_loc_estimator.common.arrays import FloatArray


def algorithm_1(first: FloatArray, second: FloatArray, own_turn: float) -> int:
    """The answer (of n) of Algorithm 1 taken literally: `mini` is written, `min` is compared with.

    Args:
        first: (n,) headings in the first image [rad].
        second: (n,) in the second one.
        own_turn: r dt [rad].
    """
    least, answer = 2.0 * np.pi, 0
    mini = least
    for p in range(first.size):
        turned = abs(first[p] - second[p])
        if abs(own_turn - turned) < least:
            answer = p
            mini = abs(own_turn - turned)  # what the next test should have read
    assert mini <= 4.0 * np.pi  # noqa: S101 # the variable has no other use, as printed
    return answer


def turn_misfits(headings: FloatArray, own_turns: FloatArray) -> FloatArray:
    """Algorithm 1 with its loop mended, but absolute differences that are not wrapped: misfits (t, n).

    Args:
        headings: (t, 2, n) of t trials [rad], as a detector gives them, in [-pi, pi).
        own_turns: (t,) [rad].
    """
    turned = np.abs(headings[:, 0] - headings[:, 1])
    misfit: FloatArray = np.abs(own_turns[:, None] - turned)
    return misfit


def ratio_misfits(images: ComplexArray, speeds: tuple[float, float]) -> FloatArray:
    """Eq. (7): misfits (n, n, n) of the ratio of distances between three images (3, n) to that of speeds."""
    first = np.abs(images[1][None, :] - images[0][:, None])
    second = np.abs(images[2][None, :] - images[1][:, None])
    ratio = first[:, :, None] / np.maximum(second[None, :, :], 1e-12)
    misfit: FloatArray = np.abs(ratio - speeds[0] / speeds[1])
    return misfit


def angle_misfits(first: ComplexArray, second: ComplexArray, own: complex, scale: float) -> FloatArray:
    """Eqs. (15)-(23): by how much the headings from x and from y differ, for all pairs (n, m) [rad].

    With atan2 in (19) and both roots of (20) and of (22); infinite where there is no solution.
    """
    away = (second[None, :] - first[:, None]) / (scale * abs(own))
    solvable = (np.abs(away.real) <= 1.0) & (np.abs(away.imag) <= 1.0)
    along_x = np.arccos(np.clip(away.real, -1.0, 1.0))
    along_y = np.arcsin(np.clip(away.imag, -1.0, 1.0))
    of_x, of_y = np.stack([along_x, -along_x]), np.stack([along_y, np.pi - along_y])
    difference = np.abs(wrap_angle(of_x[:, None] - of_y[None, :]))
    misfit: FloatArray = np.where(solvable, difference.min(axis=(0, 1)), np.inf)
    return misfit
