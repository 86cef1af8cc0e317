"""Readings of a pair as the likelihood takes them: which are missing or saturated, and how bright all are."""

from __future__ import annotations

import math

from swarm_loc_estimator.core.infrared.board import IrModel
from swarm_loc_estimator.core.infrared.solution import DARKEST
from swarm_loc_estimator.core.infrared.solvers.cost import MEASURED, MISSING, SATURATED, Pair, stabilized
from swarm_loc_estimator.core.infrared.solvers.start_table import Float32Array, compress
from swarm_loc_estimator.numerics.jit import compiled


@compiled
def compress_readings(model: IrModel, pair: Pair, pattern: Float32Array, present: Float32Array) -> None:
    """Write the readings as they would be without the elements' gains, in the form of the table."""
    f = 0
    for m in range(pair.readings.shape[0]):
        for i in range(pair.sensor.size):
            for j in range(pair.emitter.size):
                there = pair.kinds[m, i, j] != MISSING
                gain = pair.sensor[i] * pair.emitter[j]
                pattern[f] = compress(model, pair.readings[m, i, j] / gain) if there else 0.0
                present[f] = 1.0 if there else 0.0
                f += 1


@compiled
def classify(model: IrModel, pair: Pair) -> tuple[int, int, float]:
    """Write `kinds` and `stable`; returns how many are measured, how many saturated, and how bright all are.

    Returns:
        The brightness is the sum of squares in sigmas.
    """
    readings, kinds = pair.readings, pair.kinds
    measured, saturated, bright = 0, 0, 0.0
    for m in range(readings.shape[0]):
        for i in range(readings.shape[1]):
            for j in range(readings.shape[2]):
                reading = readings[m, i, j]
                dead = math.isnan(pair.sensor[i] * pair.emitter[j])
                if dead or not math.isfinite(reading) or reading < DARKEST * model.noise:
                    kinds[m, i, j] = MISSING
                    continue
                sigmas = min(reading, pair.saturation[m]) / model.noise
                bright += sigmas * sigmas
                pair.stable[m, i, j] = stabilized(model.errors, min(reading, pair.saturation[m]))[0]
                if reading >= pair.saturation[m]:
                    kinds[m, i, j] = SATURATED
                    saturated += 1
                else:
                    kinds[m, i, j] = MEASURED
                    measured += 1
    return measured, saturated, bright
