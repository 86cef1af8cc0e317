"""Size of the robots by the image itself: the diameter at which the clearest discs are found."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray

_RATIO = 1.3
_ALIKE = 1.1


def ladder(low: float, high: float) -> FloatArray:
    """Diameters from low to high, each a little larger than the one before."""
    count = max(int(np.ceil(np.log(high / low) / np.log(_RATIO))), 0) + 1
    return np.asarray(low * _RATIO ** np.arange(count))


def commonest(diameters: FloatArray, scores: FloatArray) -> float:
    """The diameter that most discs (N,) agree upon by their scores (N,); 0: there are none."""
    if not len(diameters):
        return 0.0
    alike = np.abs(np.log(diameters[:, None] / diameters)) < np.log(_ALIKE)
    best = int(np.argmax(alike @ scores))
    return float(np.median(diameters[alike[best]]))
