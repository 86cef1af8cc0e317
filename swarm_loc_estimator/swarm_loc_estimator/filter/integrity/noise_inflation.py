"""Noise inflation: measurements that scatter more than described get more noise, in units per robot.

A robot whose measurements still contradict the estimate although all its parameters are states has more
noise than described: its markers are mounted inexactly, its images are stamped inexactly. Each time its
measurements are contradicted, their noise grows by one unit.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.filter.belief import BeliefArrays, IntegrityArrays
from swarm_loc_estimator.filter.measurement_model import POLAR, MeasurementColumns
from swarm_loc_estimator.swarm.error_models import SensorModel

_POSITION_SIGMA, _BEARING_SIGMA, _HEADING_SIGMA, _STAMP_SIGMA = 0.004, 0.01, 0.03, 0.03
"""One unit of inflation [m], [rad], [rad], [s]."""
_SUSPECT_UNITS, MAX_UNITS = 2.0, 5.0


@inlined_njit
def stamp_variance(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> float:
    """Variance of the stamp of measurement k, as described and with inflation [s^2]."""
    variance: float = measurements.stamp_variance[k]
    observer = measurements.observer[k]
    if observer >= 0:
        variance += (belief.integrity.noise_inflation[observer] * _STAMP_SIGMA) ** 2
    return variance


@inlined_njit
def add_noise_inflation(
    measurements: MeasurementColumns, k: int, belief: BeliefArrays, noise: FloatArray
) -> None:
    """Add the noise inflation of its observer to the noise (3, 3) of measurement k."""
    observer = measurements.observer[k]
    units = belief.integrity.noise_inflation[observer] if observer >= 0 else 0.0
    if units > 0.0:
        noise[0, 0] += (units * _POSITION_SIGMA) ** 2
        noise[1, 1] += (units * (_BEARING_SIGMA if measurements.kind[k] == POLAR else _POSITION_SIGMA)) ** 2
        noise[2, 2] += (units * _HEADING_SIGMA) ** 2


@cached_njit
def inflate_noise(belief: BeliefArrays, observer: int) -> bool:
    """Inflate the noise of an observer by one unit; False: it is at its maximum."""
    units = belief.integrity.noise_inflation[observer]
    belief.integrity.noise_inflation[observer] = min(units + 1.0, MAX_UNITS)
    raised: bool = units < MAX_UNITS
    return raised


def inflate_all_noise(state: IntegrityArrays) -> None:
    """Inflate the noise of all robots, because their description has proved wrong."""
    np.maximum(state.noise_inflation, _SUSPECT_UNITS, out=state.noise_inflation)


def with_noise_inflation(sensor: SensorModel, units: float) -> SensorModel:
    """A sensor model with the noise inflation included."""
    unit_of = {
        "forward_sigma": _POSITION_SIGMA,
        "left_sigma": _POSITION_SIGMA,
        "heading_sigma": _HEADING_SIGMA,
        "range_sigma": _POSITION_SIGMA,
        "bearing_sigma": _BEARING_SIGMA,
        "residual_position_sigma": _POSITION_SIGMA,
        "residual_heading_sigma": _HEADING_SIGMA,
        "time_sigma_s": _STAMP_SIGMA,
    }
    return replace(
        sensor, **{name: math.hypot(getattr(sensor, name), units * unit) for name, unit in unit_of.items()}
    )
