"""Method 2 of the aerial self-localization paper: straight motion at speeds that change at each image.

The paper compares ratios of distances (7), which lose direction and scale, and have no variance when a
robot hardly moves. A robot that drives straight also keeps its direction; with it, and with the scale as
far as it is known, a chain of positions is that of motion along a line: z_k = p + c s_k with the way s_k
driven.
"""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.identification.own_motion import ComplexArray, fit_chains


def chain_costs(
    images: ComplexArray, way: FloatArray, sigma: float, scale: float = 1.0, scale_sigma: float = np.inf
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
    images: ComplexArray, way: FloatArray, sigma: float, scale: float = 1.0, scale_sigma: float = np.inf
) -> tuple[int, ...]:
    """Which position of each of three images is that of a robot that drove so; arguments as above."""
    cost = chain_costs(images, way, sigma, scale, scale_sigma)
    return tuple(int(place) for place in np.unravel_index(np.argmin(cost), cost.shape))
