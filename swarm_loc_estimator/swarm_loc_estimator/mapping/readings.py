"""What one robot reports: odometry with one distance straight ahead, and lights of other robots."""

from __future__ import annotations

from typing import NamedTuple

from swarm_loc_estimator.common.arrays import FloatArray, IntArray

UNSEEN = 0.0
"""The inverse distance of a beam that came back from nothing."""


class Readings(NamedTuple):
    """Readings (n,) of one robot in order of time.

    The inverse of a distance is what a camera beside a laser measures: it is linear in the pixel at which the
    reflection is seen, d = f b / (p - p_inf), so its noise does not depend on the distance.

    Attributes:
        stamp_ns: (n,).
        odometry: (n, 3) pose by odometry at each stamp, in the robot's own odom frame.
        inverse: (n,) inverse distance along x of the robot, from its centre [1/m]; `UNSEEN`: nothing.
        sigma: Standard deviation of an inverse distance, sigma_px / (f b) [1/m]; NaN where
            nothing was seen so far.
    """

    stamp_ns: IntArray
    odometry: FloatArray
    inverse: FloatArray
    sigma: float


class LightSightings(NamedTuple):
    """Lights (m,) of other robots that one robot saw.

    Attributes:
        stamp_ns: (m,).
        target: (m,) number of the robot whose light it is.
        bearing: (m,) in the frame of the robot that saw it [rad].
        sigma: (m,) its standard deviation [rad].
    """

    stamp_ns: IntArray
    target: IntArray
    bearing: FloatArray
    sigma: FloatArray
