"""The forward model: brightness that each sensor reads of each emitter, eqs (1)-(4) of the Droplet paper.

The paper's vectors live in two frames. Here all are in RX's: an emitter's direction is turned by the
heading phi before it enters (1), r = R - rho i + rho Rot(phi) j, which is not said there. Angles are signed
and wrapped.

A relative pose is range [m] from centre to centre, bearing [rad] of the transmitter in the receiver's
base_link, and heading [rad] of the transmitter's base_link relative to the receiver's.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from swarm_loc_estimator.core.infrared.board import IrModel, IrPlatform, PairGains
from swarm_loc_estimator.core.infrared.curves import amplitude_at, curve_at
from swarm_loc_estimator.numerics.arrays import FloatArray
from swarm_loc_estimator.numerics.jit import compiled
from swarm_loc_estimator.numerics.se2_scalar import direction_of


def expected(platform: IrPlatform, poses: ArrayLike, gains: PairGains | None = None) -> FloatArray:
    """Readings (k, modes, n, n) [count] without noise, not cut at saturation; [mode, sensor, emitter].

    Args:
        platform: The board of both robots.
        poses: (k, 3) range [m], bearing [rad], heading [rad].
        gains: Of the k pairs; None: all ones.
    """
    return _at(platform, poses, gains)[0]


def expected_with_slopes(
    platform: IrPlatform, poses: ArrayLike, gains: PairGains | None = None
) -> tuple[FloatArray, FloatArray]:
    """Besides, their derivatives (k, modes, n, n, 3) by range [count/m], bearing and heading [count/rad]."""
    readings, slopes = _at(platform, poses, gains)
    return readings, np.moveaxis(slopes, 1, -1)


def _at(platform: IrPlatform, poses: ArrayLike, gains: PairGains | None) -> tuple[FloatArray, FloatArray]:
    """Readings (k, modes, n, n) and slopes (k, 3, modes, n, n)."""
    at = np.atleast_2d(np.asarray(poses, dtype=float))
    modes, n = len(platform.amplitudes), platform.n
    readings = np.empty((len(at), modes, n, n))
    slopes = np.empty((len(at), 3, modes, n, n))
    _predict_all(platform.model, at, readings, slopes)
    if gains is None:
        return readings, slopes
    factor = (gains.sensor[:, :, None] * gains.emitter[:, None, :])[:, None]
    return readings * factor, slopes * factor[:, None]


@compiled
def _predict_all(model: IrModel, poses: FloatArray, readings: FloatArray, slopes: FloatArray) -> None:
    """All poses."""
    for k in range(poses.shape[0]):
        predict_brightness(model, poses[k, 0], poses[k, 1], poses[k, 2], readings[k], slopes[k])


@compiled
def predict_brightness(
    model: IrModel, distance: float, bearing: float, heading: float, readings: FloatArray, slopes: FloatArray
) -> None:
    """Write readings (modes, n, n) and their slopes (3, modes, n, n) of one pose."""
    n, modes, rho = model.angles.size, model.amplitudes.shape[0], model.radius
    ux, uy = math.cos(bearing), math.sin(bearing)
    cos, sin = math.cos(heading), math.sin(heading)
    # what is read there before it is written: the way from sensor to emitter x, y, its length and direction
    way_x, way_y, length, direction = slopes[0, 0], slopes[1, 0], slopes[2, 0], readings[0]
    for i in range(n):
        sensor_x, sensor_y = rho * model.units[i, 0], rho * model.units[i, 1]
        for j in range(n):
            jx = cos * model.units[j, 0] - sin * model.units[j, 1]
            jy = sin * model.units[j, 0] + cos * model.units[j, 1]
            way_x[i, j], way_y[i, j] = (
                distance * ux + rho * jx - sensor_x,
                distance * uy + rho * jy - sensor_y,
            )
    _measure(way_x.ravel(), way_y.ravel(), length.ravel(), direction.ravel())
    for j in range(n):
        # the emitter's direction in the receiver's frame
        jx = cos * model.units[j, 0] - sin * model.units[j, 1]
        jy = sin * model.units[j, 0] + cos * model.units[j, 1]
        for i in range(n):
            rx, ry, r, along = way_x[i, j], way_y[i, j], length[i, j], direction[i, j]
            per_r = 1.0 / r
            seen, seen_slope = curve_at(model.sensor, along - model.angles[i])
            lit, lit_slope = curve_at(model.emitter, along + math.pi - model.angles[j] - heading)
            # how the distance and the direction from sensor to emitter change with the pose
            vx, vy = rx * per_r, ry * per_r
            forward, aside = vx * ux + vy * uy, vx * uy - vy * ux
            dr_distance, da_distance = forward, aside * per_r
            dr_bearing, da_bearing = -distance * aside, distance * forward * per_r
            forward, aside = vx * jx + vy * jy, vx * jy - vy * jx
            dr_heading, da_heading = -rho * aside, rho * forward * per_r
            share = seen * lit
            turned = seen_slope * lit + seen * lit_slope  # by the direction
            for m in range(modes):
                amplitude, amplitude_slope = amplitude_at(model.amplitudes[m], r)
                by_r, by_a = share * amplitude_slope, turned * amplitude
                readings[m, i, j] = share * amplitude
                slopes[0, m, i, j] = by_r * dr_distance + by_a * da_distance
                slopes[1, m, i, j] = by_r * dr_bearing + by_a * da_bearing
                slopes[2, m, i, j] = by_r * dr_heading + by_a * da_heading - seen * lit_slope * amplitude


@compiled
def _measure(x: FloatArray, y: FloatArray, length: FloatArray, direction: FloatArray) -> None:
    """Write lengths, none of them zero, and directions [rad] of vectors, in a loop that is vectorized."""
    for k in range(x.size):
        length[k] = math.sqrt(max(x[k] * x[k] + y[k] * y[k], 1e-12))
        direction[k] = direction_of(y[k], x[k])
