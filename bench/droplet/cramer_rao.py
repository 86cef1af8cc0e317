"""The Cramer-Rao bound of a relative pose from brightness matrices."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import expected_with_slopes
from swarm_loc_estimator.swarm.ir_board import IrPlatform

_FAR = 8.0  # Beyond so many sigmas from saturation a reading holds all information, or none


def information(platform: IrPlatform, poses: ArrayLike) -> FloatArray:
    """Fisher information (k, 3, 3) on range [m], bearing and heading [rad] of poses (k, 3), all gains known.

    Its inverse is the Cramer-Rao bound. A reading that may saturate holds the information of a normal
    variable that is cut off: all of it below, and beyond only on which side it is.
    """
    bright, slopes = expected_with_slopes(platform, poses)
    sigma = np.hypot(platform.noise, platform.relative * np.clip(bright, 0.0, platform.saturation))
    z = np.clip((platform.saturation - bright) / sigma, -_FAR, _FAR)
    density = np.exp(-(z**2) / 2.0) / np.sqrt(2.0 * np.pi)
    share = ndtr(z) - z * density + density**2 / ndtr(-z)
    share = np.where(z >= _FAR, 1.0, np.where(z <= -_FAR, 0.0, share))
    return np.asarray(np.einsum("kmij,kmija,kmijb->kab", share / sigma**2, slopes, slopes))
