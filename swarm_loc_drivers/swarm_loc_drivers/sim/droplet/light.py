"""Brightness on the sensors of Droplets: models of their board, true gains, occlusion by robots."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.droplet.hardware import FULL_POWER
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.infrared.brightness import expected
from swarm_loc_estimator.swarm.ir_board import IrPlatform, PairGains


class DropletLight:
    """The light of one emitter at a time.

    Args:
        platform: The board of all robots.
        gains: (2, N, n) true factors of the sensors and of the emitters of all robots.
        near_power: Power at which the emitters follow the board's near model, below 256.
    """

    def __init__(self, platform: IrPlatform, gains: FloatArray, near_power: int) -> None:
        self._platform = platform
        self._gains = gains
        self._powers = (0.0, float(near_power), float(FULL_POWER))
        angles = np.array(platform.angles)
        self._elements = platform.radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)

    def falling_on(
        self, poses: FloatArray, receivers: NDArray[np.int64], transmitter: int, emitter: int, power: int
    ) -> FloatArray:
        """Counts (k, n) that the sensors of receivers (k,) would read without noise.

        Args:
            poses: (N, 3) of all robots in map.
            receivers: Their indices.
            transmitter: Index of the robot that emits.
            emitter: Which of its emitters is lit.
            power: How bright, 0 to 256.
        """
        seen = se2.between(poses[receivers], poses[transmitter])
        distance, bearing = np.hypot(seen[:, 0], seen[:, 1]), np.arctan2(seen[:, 1], seen[:, 0])
        relative = np.stack([distance, bearing, seen[:, 2]], axis=-1)
        count = len(receivers)
        gains = PairGains(
            self._gains[0, receivers],
            np.repeat(self._gains[1, [transmitter]], count, axis=0),
            np.zeros((count, 4)),
        )
        far_near = expected(self._platform, relative, gains)[..., emitter]  # (k, modes, n)
        levels = np.stack([np.zeros_like(far_near[:, 0]), far_near[:, -1], far_near[:, 0]])
        share = np.array([np.interp(power, self._powers, corner) for corner in np.eye(3)])
        light: FloatArray = np.einsum("l,lkn->kn", share, levels)
        return np.where(self._blocked(poses, receivers, transmitter, emitter), 0.0, light)

    def _blocked(
        self, poses: FloatArray, receivers: NDArray[np.int64], transmitter: int, emitter: int
    ) -> BoolArray:
        """Which sensors (k, n) have another robot between them and the emitter."""
        sensors = se2.transform_points(poses[receivers, None], self._elements)
        lit = se2.transform_points(poses[transmitter], self._elements[emitter])
        others = np.ones((len(receivers), len(poses)), dtype=bool)
        others[:, transmitter] = False
        others[np.arange(len(receivers)), receivers] = False
        near = distance_to_segments(sensors, lit, poses[:, :2]) < self._platform.radius
        return np.asarray((near & others[:, None]).any(axis=-1))


def distance_to_segments(begins: FloatArray, end: FloatArray, points: FloatArray) -> FloatArray:
    """Distances (..., N) of points (N, 2) from the segments from `begins` (..., 2) to one `end` (2,)."""
    way = end - begins
    square = np.maximum((way**2).sum(axis=-1, keepdims=True), 1e-18)
    there = points - begins[..., None, :]
    along = np.clip((there * way[..., None, :]).sum(axis=-1) / square, 0.0, 1.0)
    nearest = begins[..., None, :] + along[..., None] * way[..., None, :]
    distance: FloatArray = np.linalg.norm(points - nearest, axis=-1)
    return distance
