"""Likelihood of exchanges as a function of the relative gain of one element, marginalized over poses.

The relative pose is unknown, so the likelihood is marginalized over a grid of relative poses. It is computed
for a few relative gains of each sensor of the receiver and emitter of the transmitter; all other elements
follow the board. Residuals are computed after a variance-stabilizing transform. Any reading may be blocked or
too bright, at the rates of the board.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.solution import DARKEST
from swarm_loc_estimator.infrared.start_table import start_table
from swarm_loc_estimator.swarm.ir_board import IrPlatform

SHARES: FloatArray = np.array([0.0, 0.15, 0.35, 0.7, 1.0, 1.4])
"""Relative gains of an element that are compared; the first is zero."""
WHOLE = 4  # Index of the relative gain one
_PER_ELEMENT, _MAX_DIRECTIONS = 4, 24  # Number of bearings, and of headings, of the grid
_SHOWN = 10.0  # Minimum of readings that determine the discretization error of the grid [sigma]
_NOISE_RATIO = 1.2  # Maximum relative difference in noise of exchanges that share a table
_NEGLIGIBLE = 8.0  # Maximum log-likelihood ratio to the best pose; less likely poses are skipped
BRIGHT_SPAN = 20.0  # Width of the uniform distribution of readings that are too bright [sigma]
MIN_SHARE = 1e-3  # Minimum assumed share of outliers
PEAK = 1.0 / math.sqrt(2.0 * math.pi)
LOWEST = 1e-300
_FAR_OFF = 8.0  # Maximum residual with a non-negligible likelihood [sigma]

Float32Array = NDArray[np.float32]


class ElementLikelihoods(NamedTuple):
    """Likelihoods of the elements of exchanges."""

    # (k, 2, n, S) log likelihood for each relative gain of `SHARES`, of the receiver's sensors and the
    # transmitter's emitters
    log: FloatArray
    directions: FloatArray  # (k, 2) bearing and heading [rad] of the most likely pose


def element_likelihoods(
    platform: IrPlatform, readings: FloatArray, saturation: FloatArray
) -> ElementLikelihoods:
    """Log likelihoods of k exchanges as functions of the relative gain of each element.

    Args:
        platform: The board of both robots.
        readings: (k, n, n) [count] at full power, [sensor, emitter]; NaN where not measured or left out.
        saturation: (k,) of each exchange [count].
    """
    count, n = len(readings), platform.n
    poses, light, log_prior = _grid(platform)
    found = np.empty((count, 2, n, SHARES.size))
    best = np.zeros(count, dtype=np.int64)
    relative = math.sqrt(
        platform.relative**2 + 2.0 * platform.element_sigma**2 + _grid_variance(platform, light)
    )
    bright = np.nan_to_num(readings, nan=0.0).max(axis=(1, 2))
    noise = np.hypot(platform.noise, platform.stray_noise * np.minimum(bright, saturation))
    level = np.rint(np.log(noise / platform.noise) / math.log(_NOISE_RATIO)).astype(np.int64)
    blocked, stray = max(platform.blocked_share, MIN_SHARE), max(platform.bright_share, MIN_SHARE)
    for one in np.unique(level).tolist():
        rows = np.flatnonzero(level == one)
        sigma = platform.noise * _NOISE_RATIO**one
        table = np.stack([_stabilized(share * light, sigma, relative) for share in SHARES])
        present = np.isfinite(readings[rows]) & (readings[rows] >= DARKEST * sigma)
        limit = saturation[rows, None, None]
        saturated = present & (readings[rows] >= limit)
        stable = _stabilized(np.where(present, np.minimum(readings[rows], limit), 0.0), sigma, relative)
        kinds = present.astype(np.int8) + saturated
        dark = np.where(saturated, 0.0, blocked * PEAK * np.exp(-0.5 * np.square(stable, dtype=np.float64)))
        outlier = dark + stray / BRIGHT_SPAN
        part, places = np.empty((rows.size, 2, n, SHARES.size)), np.zeros(rows.size, dtype=np.int64)
        _marginalize(table, log_prior, stable.astype(np.float64), kinds, outlier, part, places)
        found[rows], best[rows] = part, places
    return ElementLikelihoods(found, poses[best, 1:])


def direction_step(platform: IrPlatform) -> float:
    """Step of the grid in bearing and heading [rad]."""
    return 2.0 * math.pi / min(_PER_ELEMENT * platform.n, _MAX_DIRECTIONS)


def _grid(platform: IrPlatform) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses (g, 3), expected readings (g, n, n), and log prior (g,), uniform over the plane."""
    full = replace(platform, amplitudes=platform.amplitudes[:1])
    ranges = start_table(full).ranges
    angles = np.arange(-math.pi, math.pi - 1e-9, direction_step(platform))
    poses = np.stack(np.meshgrid(ranges, angles, angles, indexing="ij"), axis=-1).reshape(-1, 3)
    return poses, expected_brightness(full, poses)[:, 0], 2.0 * np.log(poses[:, 0] / ranges[-1])


def _grid_variance(platform: IrPlatform, light: FloatArray) -> float:
    """Mean squared relative error of readings due to the discretization of poses."""
    n, size = platform.n, round(2.0 * math.pi / direction_step(platform))
    logs = np.log(np.clip(light, platform.noise, platform.saturation)).reshape(-1, size, size, n * n)
    shown = logs > math.log(_SHOWN * platform.noise)
    total = 0.0
    for axis in range(3):
        steps = np.diff(logs, axis=axis)
        one, other = (np.delete(shown, end, axis=axis) for end in (-1, 0))
        total += float(np.mean(np.square(steps[one | other])))
    return total / 12.0  # uniform within a step


def _stabilized(values: FloatArray, noise: float, relative: float) -> Float32Array:
    """Variance-stabilizing transform of readings with additive and relative noise [sigma]."""
    stable: Float32Array = (np.arcsinh(relative / noise * values) / relative).astype(np.float32)
    return stable


@cached_njit
def _marginalize(
    table: Float32Array,
    log_prior: FloatArray,
    stable: FloatArray,
    kinds: NDArray[np.int8],
    outlier: FloatArray,
    found: FloatArray,
    best: NDArray[np.int64],
) -> None:
    """Write `found` (k, 2, n, S) and the most likely pose of each exchange.

    Args:
        table: (S, g, n, n) expected readings by relative gain.
        log_prior: (g,).
        stable: (k, n, n) readings.
        kinds: (k, n, n) 0 missing, 1 measured, 2 saturated.
        outlier: (k, n, n) densities under the outlier hypotheses.
        found: Written.
        best: (k,) written.
    """
    shares, poses, n = table.shape[0], table.shape[1], stable.shape[1]
    sides, logs, tops = np.empty((poses, 2, n)), np.empty(poses), np.empty((2, n))
    dark, changed = np.empty((2, n)), np.empty((shares, 2, n))
    for k in range(stable.shape[0]):
        _likelihoods(table[0, 0], stable[k], kinds[k], outlier[k], changed[0])  # the same at all poses
        dark[:] = np.log(changed[0])
        tops[:] = -math.inf
        best[k] = 0
        for g in range(poses):
            logs[g] = log_prior[g] + _by_side(table[WHOLE, g], stable[k], kinds[k], outlier[k], sides[g])
            if logs[g] > logs[best[k]]:
                best[k] = g
            for side in range(2):
                for e in range(n):
                    tops[side, e] = max(tops[side, e], logs[g] - sides[g, side, e] + dark[side, e])
        found[k] = 0.0
        base = logs[best[k]]
        for g in range(poses):
            if not _counts(logs[g], base, sides[g], dark, tops):
                continue
            changed[WHOLE] = np.exp(sides[g])
            for s in range(1, shares):
                if s != WHOLE:
                    _likelihoods(table[s, g], stable[k], kinds[k], outlier[k], changed[s])
            for side in range(2):
                for e in range(n):
                    others = math.exp(logs[g] - sides[g, side, e] - base)
                    for s in range(shares):
                        found[k, side, e, s] += others * changed[s, side, e]
        for side in range(2):
            for e in range(n):
                for s in range(shares):
                    found[k, side, e, s] = base + math.log(max(found[k, side, e, s], LOWEST))


@cached_njit
def _counts(log: float, base: float, sides: FloatArray, dark: FloatArray, tops: FloatArray) -> bool:
    """Whether a pose is not negligible, with all elements working or any one of them dead."""
    if log > base - _NEGLIGIBLE:
        return True
    for side in range(2):
        for e in range(sides.shape[1]):
            if log - sides[side, e] + dark[side, e] > tops[side, e] - _NEGLIGIBLE:
                return True
    return False


@cached_njit
def _by_side(
    light: Float32Array,
    stable: FloatArray,
    kinds: NDArray[np.int8],
    outlier: FloatArray,
    sides: FloatArray,
) -> float:
    """Write the log likelihood of each sensor's and each emitter's readings (2, n); returns the total."""
    _likelihoods(light, stable, kinds, outlier, sides)
    total = 0.0
    for e in range(stable.shape[0]):
        sides[0, e], sides[1, e] = math.log(sides[0, e]), math.log(sides[1, e])
        total += sides[0, e]
    return total


@cached_njit
def _likelihoods(
    light: Float32Array,
    stable: FloatArray,
    kinds: NDArray[np.int8],
    outlier: FloatArray,
    sides: FloatArray,
) -> None:
    """Write the likelihood of each sensor's and each emitter's readings (2, n), at least `LOWEST`."""
    n = stable.shape[0]
    for e in range(n):
        sides[1, e] = 1.0
    for i in range(n):
        row = 1.0
        for j in range(n):
            if kinds[i, j] == 0:
                continue
            off, density = stable[i, j] - light[i, j], outlier[i, j]
            if kinds[i, j] == 2:
                density += 0.5 * math.erfc(off / math.sqrt(2.0))
            elif abs(off) < _FAR_OFF:
                density += PEAK * math.exp(-0.5 * off * off)
            row *= density
            sides[1, j] *= density
        sides[0, i] = max(row, LOWEST)
    for e in range(n):
        sides[1, e] = max(sides[1, e], LOWEST)
