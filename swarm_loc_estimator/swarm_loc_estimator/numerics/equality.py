"""Whether what was computed before may be used again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.numerics.jit import compiled


@compiled
def are_equal(one: NDArray[np.generic], other: NDArray[np.generic]) -> bool:
    """Whether all numbers (k,) are equal."""
    if one.size != other.size:
        return False
    for k in range(one.size):  # noqa: SIM110  # which numba does not compile
        if one[k] != other[k]:
            return False
    return True
