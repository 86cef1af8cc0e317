"""Readings of a pair as the likelihood takes them: which are missing or saturated, and how bright all are."""

from __future__ import annotations

import math

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import norefcount_njit
from swarm_loc_estimator.infrared.solution import DARKEST
from swarm_loc_estimator.infrared.solvers.cost import Pair
from swarm_loc_estimator.infrared.solvers.reading_cost import MEASURED, MISSING, SATURATED, stabilized
from swarm_loc_estimator.infrared.solvers.start_table import Float32Array, compress
from swarm_loc_estimator.swarm.ir_board import IrModel


@norefcount_njit
def compress_readings(model: IrModel, pair: Pair, pattern: Float32Array, present: Float32Array) -> None:
    """Write the readings as they would be without the elements' gains, in the form of the table."""
    n = pair.sensor.size
    for f in range(pair.kinds.size):
        there = pair.kinds[f] != MISSING
        gain = pair.sensor[f // n % n] * pair.emitter[f % n]
        pattern[f] = compress(model, pair.readings[f] / gain) if there else 0.0
        present[f] = 1.0 if there else 0.0


@norefcount_njit
def classify(model: IrModel, saturation: FloatArray, pair: Pair) -> tuple[int, int, float]:
    """Write `cut`, `stable` and `kinds`; returns how many are measured and saturated, and how bright all are.

    Args:
        model: Of the platform.
        saturation: (modes,) from where on readings are SATURATED [count].
        pair: The readings.

    Returns:
        The brightness is the sum of squares in sigmas.
    """
    n, measured, saturated, bright = pair.sensor.size, 0, 0, 0.0
    for f in range(pair.kinds.size):
        reading, limit = pair.readings[f], saturation[f // (n * n)]
        dead = math.isnan(pair.sensor[f // n % n] * pair.emitter[f % n])
        pair.kinds[f], pair.cut[f] = MISSING, 0.0
        if dead or not math.isfinite(reading) or reading < DARKEST * model.noise:
            continue
        pair.cut[f] = min(reading, limit)
        sigmas = pair.cut[f] / model.noise
        bright += sigmas * sigmas
        pair.stable[f] = stabilized(model.errors, pair.cut[f])[0]
        if reading >= limit:
            pair.kinds[f] = SATURATED
            saturated += 1
        else:
            pair.kinds[f] = MEASURED
            measured += 1
    return measured, saturated, bright
