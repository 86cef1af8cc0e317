"""How well any estimator could do: the information that brightness matrices hold on the pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm

from swarm_loc_estimator.core.ir.brightness import expected_with_slopes
from swarm_loc_estimator.core.ir.platform import IrPlatform
from swarm_loc_estimator.core.se2 import FloatArray

_FAR = 8.0
"""Beyond so many sigmas from saturation a reading holds all information, or none."""


def information(platform: IrPlatform, poses: ArrayLike) -> FloatArray:
    """Fisher information (k, 3, 3) on range [m], bearing and heading [rad] of poses (k, 3), all gains known.

    Its inverse is the Cramer-Rao bound. A reading that may saturate holds the information of a normal
    variable that is cut off: all of it below, and beyond only on which side it is.
    """
    bright, slopes = expected_with_slopes(platform, poses)
    sigma = np.hypot(platform.noise, platform.relative_noise * np.clip(bright, 0.0, platform.saturation))
    z = np.clip((platform.saturation - bright) / sigma, -_FAR, _FAR)
    share = norm.cdf(z) - z * norm.pdf(z) + norm.pdf(z) ** 2 / norm.sf(z)
    share = np.where(z >= _FAR, 1.0, np.where(z <= -_FAR, 0.0, share))
    return np.asarray(np.einsum("kmij,kmija,kmijb->kab", share / sigma**2, slopes, slopes))
