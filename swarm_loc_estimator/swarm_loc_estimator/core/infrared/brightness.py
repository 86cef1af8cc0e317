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
    for j in range(n):
        # the emitter's direction and place in the receiver's frame
        jx = cos * model.units[j, 0] - sin * model.units[j, 1]
        jy = sin * model.units[j, 0] + cos * model.units[j, 1]
        ex, ey = distance * ux + rho * jx, distance * uy + rho * jy
        for i in range(n):
            rx, ry = ex - rho * model.units[i, 0], ey - rho * model.units[i, 1]
            square = max(rx * rx + ry * ry, 1e-12)
            r = math.sqrt(square)
            per_r = 1.0 / r
            along = math.atan2(ry, rx)
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
