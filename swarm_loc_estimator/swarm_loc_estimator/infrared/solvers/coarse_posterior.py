"""Probability of poses all around, by the coarse table of the starts.

A minimum of the cost tells nothing of other minima. Readings of which some are blocked and others too bright
often have several, some of them wide: how uncertain a pose is then follows from the probability of all poses.
"""

from __future__ import annotations

import math

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2_scalar import wrap
from swarm_loc_estimator.infrared.solvers.start_table import StartRoom, StartTable

_NEGLIGIBLE = 16.0
"""Poses whose costs are higher by this are left out."""
_BESIDE = 1.5
"""What is nearer than so many steps of the table, in range, bearing and heading, is the same minimum."""


@cached_njit
def add_spread(table: StartTable, room: StartRoom, pose: FloatArray, covariance: FloatArray) -> float:
    """Add to a pose's covariance (3, 3) what other poses that are likely make it uncertain by.

    Where robots stand is as likely everywhere in the plane. Ranges are spaced as a geometric series, so each
    counts by its square.

    Args:
        table: Of the platform.
        room: Whose costs are those of the readings.
        pose: (3,) range [m], bearing, heading [rad].
        covariance: Added to.

    Returns:
        The larger of the mean squares by which bearing and heading of all poses differ from this one's.
    """
    size, least = table.angles.size, room.costs.min()
    step = 2.0 * math.pi / size
    near = _BESIDE * math.log(table.ranges[1] / table.ranges[0])
    total, all_b, all_h = 0.0, 0.0, 0.0
    rr, rb, rh, bb, bh, hh = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for d in range(room.costs.shape[0]):
        b, h = wrap(table.angles[d // size] - pose[1]), wrap(table.angles[d % size] - pose[2])
        beside = max(abs(b), abs(h)) < _BESIDE * step
        for k in range(table.ranges.size):
            above = room.costs[d, k] - least
            if above > _NEGLIGIBLE:
                continue
            weight = table.ranges[k] ** 2 * math.exp(-above)
            total += weight
            all_b, all_h = all_b + weight * b * b, all_h + weight * h * h
            if beside and abs(math.log(table.ranges[k] / pose[0])) < near:
                continue
            r = table.ranges[k] - pose[0]
            rr, rb, rh = rr + weight * r * r, rb + weight * r * b, rh + weight * r * h
            bb, bh, hh = bb + weight * b * b, bh + weight * b * h, hh + weight * h * h
    covariance[0, 0] += rr / total
    covariance[1, 1] += bb / total
    covariance[2, 2] += hh / total
    covariance[0, 1] += rb / total
    covariance[1, 0] += rb / total
    covariance[0, 2] += rh / total
    covariance[2, 0] += rh / total
    covariance[1, 2] += bh / total
    covariance[2, 1] += bh / total
    return max(all_b, all_h) / total
