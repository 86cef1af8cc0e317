"""Proximity sensors of an e-puck among walls and other robots, by ray casting."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.epuck.hardware import PROXIMITY_BEARINGS, PROXIMITY_RADIUS_M
from swarm_loc_drivers.epuck.proximity import FIELD_OF_VIEW, raw_of_distance
from swarm_loc_estimator.common.arrays import FloatArray

_LARGEST = 4095
_NOISE = 6.0
_RAYS = np.array([-0.5, 0.0, 0.5]) * FIELD_OF_VIEW
"""A sensor reports the nearest of what these rays of its cone meet."""


def proximity_values(
    poses: FloatArray, robot: int, arena: tuple[float, float], rng: np.random.Generator
) -> NDArray[np.int64]:
    """Raw values (8,) of one robot.

    Args:
        poses: (N, 3) of all robots in map.
        robot: Index of the one.
        arena: Its size along x and y, around map's origin [m].
        rng: Source of the noise.
    """
    x, y, heading = poses[robot]
    outwards = heading + np.array(PROXIMITY_BEARINGS)
    origins = np.array([x, y]) + PROXIMITY_RADIUS_M * np.column_stack([np.cos(outwards), np.sin(outwards)])
    angles = outwards[:, None] + _RAYS
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    others = np.delete(poses[:, :2], robot, axis=0)
    distance = np.minimum(_to_walls(origins, rays, arena), _to_discs(origins, rays, others)).min(axis=1)
    raw = raw_of_distance(distance) + _NOISE * rng.standard_normal(len(distance))
    return np.clip(np.rint(raw), 0, _LARGEST).astype(np.int64)


def _to_walls(origins: FloatArray, rays: FloatArray, arena: tuple[float, float]) -> FloatArray:
    """Along rays (S, R, 2) from origins (S, 2) to the walls (S, R) [m]; 0 from outside of them."""
    half = 0.5 * np.array(arena)
    with np.errstate(divide="ignore"):
        along = (half - np.sign(rays) * origins[:, None]) / np.abs(rays)
    nearest: FloatArray = np.maximum(along.min(axis=-1), 0.0)
    return nearest


def _to_discs(origins: FloatArray, rays: FloatArray, centres: FloatArray) -> FloatArray:
    """Along rays (S, R, 2) to robots at (M, 2) (S, R) [m]; infinite where they meet none."""
    if not len(centres):
        return np.full(rays.shape[:2], math.inf)
    to_centre = centres - origins[:, None, None]
    along = (to_centre * rays[:, :, None]).sum(axis=-1)
    beside = (to_centre**2).sum(axis=-1) - along**2
    depth = np.sqrt(np.maximum(PROXIMITY_RADIUS_M**2 - beside, 0.0))
    met = (beside < PROXIMITY_RADIUS_M**2) & (along > 0.0)
    nearest: FloatArray = np.where(met, np.maximum(along - depth, 0.0), math.inf).min(axis=-1)
    return nearest
