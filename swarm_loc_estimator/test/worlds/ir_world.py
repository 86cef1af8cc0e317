"""The Droplet paper's equations once more, written as printed in plain numpy, and random pairs of robots."""

from dataclasses import replace

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.cost import Pair, new_costs, write_costs
from swarm_loc_estimator.infrared.search import classify
from swarm_loc_estimator.swarm.ir_board import IrModel, IrPlatform, PairGains, load_ir_platform

RHO = 0.022
ANGLES = np.radians([-30.0, -90.0, -150.0, 150.0, 90.0, 30.0])


def droplet(element_sigma: float = 0.0) -> IrPlatform:
    """The Droplet; its elements alike unless told otherwise."""
    return replace(load_ir_platform("droplet"), element_sigma=element_sigma)


def sensor_19(angle: FloatArray) -> FloatArray:
    """Eq. (19), of wrapped angles."""
    with np.errstate(divide="ignore"):
        return np.where(np.abs(angle) < 0.6186, 1.0 - angle**4, 1.0 / (8.0 * angle**4))


def emitter_20(angle: FloatArray) -> FloatArray:
    """Eq. (20), of wrapped angles."""
    with np.errstate(divide="ignore"):
        return np.where(np.abs(angle) < 0.7205, -(angle**4) + 0.5 * angle**2 + 0.9375, 1.0 / (4.0 * angle**4))


def far_21(r: FloatArray) -> FloatArray:
    """Eq. (21), r [m]."""
    return 14000.0 / (100.0 * r - 3.0) ** 2 - 1.0


def wrapped(angle: FloatArray) -> FloatArray:
    """Angles [rad] in [-pi, pi)."""
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi


def units(angles: FloatArray) -> FloatArray:
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def droplet_matrix(pose: FloatArray, *, turn_emitters: bool = True, wrap: bool = True) -> FloatArray:
    """Lambda (6, 6) of the far power by eqs (1)-(4); the two switches choose what the print leaves out."""
    distance, bearing, heading = pose
    i = units(ANGLES)[:, None]
    j = units(ANGLES + heading if turn_emitters else ANGLES)[None]
    r = distance * units(bearing) - RHO * i + RHO * j
    length = np.linalg.norm(r, axis=-1)
    along = np.arctan2(r[..., 1], r[..., 0])
    alpha = along - ANGLES[:, None]
    beta = along + np.pi - ANGLES[None] - heading
    if wrap:
        alpha, beta = wrapped(alpha), wrapped(beta)
    return sensor_19(alpha) * emitter_20(beta) * far_21(length)


def random_poses(count: int, seed: int, low: float = 0.06, high: float = 0.28) -> FloatArray:
    """(count, 3) ranges [m], bearings and headings [rad], uniform."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-np.pi, np.pi, (count, 2))
    return np.column_stack([rng.uniform(low, high, count), angles])


def readings_of(
    platform: IrPlatform, poses: FloatArray, seed: int, gains: PairGains | None = None
) -> FloatArray:
    """Readings (k, modes, n, n) of poses with the platform's noise, cut at saturation."""
    bright = expected_brightness(platform, poses, gains)
    spread = np.hypot(platform.noise, platform.relative_noise * bright)
    noise = spread * np.random.default_rng(seed).standard_normal(bright.shape)
    return np.minimum(bright + noise, platform.saturation)


def differing_gains(count: int, n: int, sigma: float, seed: int) -> PairGains:
    """Gains of pairs whose elements all differ, with nothing left unknown."""
    factors = np.exp(sigma * np.random.default_rng(seed).standard_normal((2, count, n)))
    return PairGains(factors[0], factors[1], np.zeros((count, 4)))


def pose_errors(found: FloatArray, poses: FloatArray) -> FloatArray:
    """(k, 3) with angles wrapped [m, rad, rad]."""
    errors = found - poses
    errors[:, 1:] = wrapped(errors[:, 1:])
    return errors


def pair_of(
    model: IrModel,
    readings: FloatArray,
    saturation: float,
    gains: FloatArray | None = None,
    prior: FloatArray | None = None,
) -> Pair:
    """A pair's readings (modes, n, n) as the likelihood takes them; gains (2, n) of sensors and emitters."""
    size, n = readings.size, readings.shape[1]
    sensor, emitter = np.ones((2, n)) if gains is None else gains
    pair = Pair(
        readings.ravel(),
        np.zeros(size),
        np.zeros(size),
        np.zeros(size, np.int8),
        new_costs(size),
        sensor,
        emitter,
        np.zeros((2, 2)) if prior is None else prior,
        nearest=0.044,
        farthest=1.0,
    )
    classify(model, np.full(len(readings), saturation), pair)
    write_costs(model.errors, pair)
    return pair
