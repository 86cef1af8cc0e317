"""Method 3 of the aerial self-localization paper: any motion between two images.

Eqs. (15)-(23) ask for a heading that explains the motion along x and along y alike. That is one complex
equation, D = lambda exp(i theta) W, which always has a heading: the whole test is |D| = lambda |W|. A robot
that stood, or came back to where it was (rho = 0 in the paper, "no solution"), has D = 0 and any heading.
"""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.identification.own_motion import ComplexArray, relation


def pair_misfits(first: ComplexArray, second: ComplexArray, own: complex, scale: float = 1.0) -> FloatArray:
    """By how much the distances of all pairs (n, m) differ from the own way: | |D| - lambda |W| |.

    Args:
        first: (n,) positions in the first image.
        second: (m,) positions in the second one.
        own: W, the own motion in between, in the frame of the first heading.
        scale: lambda.
    """
    misfit: FloatArray = np.abs(np.abs(second[None, :] - first[:, None]) - scale * abs(own))
    return misfit


def identify_by_way(
    first: ComplexArray, second: ComplexArray, own: complex, scale: float = 1.0
) -> tuple[int, int, float]:
    """Which position in each image is that of a robot that moved by W, and its first heading [rad].

    Arguments as for `pair_misfits`; W must not be zero for the heading to mean anything.
    """
    misfit = pair_misfits(first, second, own, scale)
    i, j = (int(place) for place in np.unravel_index(np.argmin(misfit), misfit.shape))
    return i, j, float(relation(second[j] - first[i], own).heading)
