"""Validation of measurements: finite values of plausible size, valid covariances."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.small_matrix import cholesky3
from swarm_loc_estimator.filter.measurement_model import MODELS, NOBODY, MeasurementArray

VALID = 0
REJECT_REASONS = ("", "non_finite", "absurd", "bad_covariance", "bad_measurement")
"""Reasons to reject a measurement, indexed by the result of `reject_reasons`."""
BAD_MEASUREMENT = REJECT_REASONS.index("bad_measurement")

_MAX_DISTANCE_M = 1e6
_MIN_VARIANCE, _MAX_VARIANCE = 1e-14, 1e14
_ASYMMETRY, _ROUNDING = 1e-6, 1e-9


def reject_reasons(measurements: MeasurementArray) -> IntArray:
    """Reasons (m,) to reject measurements (m,), as indices of `REJECT_REASONS`; `VALID` if none."""
    value = measurements["value"]
    reasons = np.full(measurements.size, VALID)
    _check_covariances(measurements["covariance"], reasons)
    reasons[np.abs(value).max(axis=1) > _MAX_DISTANCE_M] = REJECT_REASONS.index("absurd")
    reasons[~np.isfinite(value).all(axis=1)] = REJECT_REASONS.index("non_finite")
    return reasons


def is_about_swarm(measurements: MeasurementArray, robots: int, landmarks: int) -> BoolArray:
    """Whether measurements (m,) have a registered model, valid indices, and finite parameters."""
    return _are_about_swarm(
        measurements["kind"],
        measurements["observer"],
        measurements["target"],
        measurements["landmark"],
        measurements["sensor"],
        measurements["marker"],
        measurements["stamp_variance"],
        measurements["gate"],
        np.array(list(MODELS)),
        robots,
        landmarks,
    )


@cached_njit
def _are_about_swarm(
    kind: IntArray,
    observer: IntArray,
    target: IntArray,
    landmark: IntArray,
    sensor: FloatArray,
    marker: FloatArray,
    stamp_variance: FloatArray,
    gate: FloatArray,
    models: IntArray,
    robots: int,
    landmarks: int,
) -> BoolArray:
    valid = np.zeros(kind.size, dtype=np.bool_)
    for k in range(kind.size):
        good = NOBODY <= observer[k] < robots and NOBODY <= target[k] < robots
        good = good and 0 <= landmark[k] <= landmarks and (observer[k] != target[k] or observer[k] == NOBODY)
        good = good and math.isfinite(stamp_variance[k]) and stamp_variance[k] >= 0.0
        good = good and not math.isnan(gate[k])
        for i in range(3):
            good = good and math.isfinite(sensor[k, i]) and math.isfinite(marker[k, i])
        known = False
        for number in models:
            known = known or kind[k] == number
        valid[k] = good and known
    return valid


_BAD_COVARIANCE = REJECT_REASONS.index("bad_covariance")


@cached_njit
def _check_covariances(matrices: FloatArray, reasons: IntArray) -> None:
    """Mark matrices that are not symmetric positive definite or of implausible magnitude."""
    scaled = np.empty((3, 3))
    for k in range(reasons.size):
        good = True
        for i in range(3):
            good = good and _MIN_VARIANCE <= matrices[k, i, i] <= _MAX_VARIANCE
        if good:
            for i in range(3):
                for j in range(3):
                    scaled[i, j] = matrices[k, i, j] / math.sqrt(matrices[k, i, i] * matrices[k, j, j])
            for i in range(3):
                for j in range(3):
                    good = good and abs(scaled[i, j] - scaled[j, i]) < _ASYMMETRY
                scaled[i, i] -= _ROUNDING
            factor = cholesky3(scaled)  # NaN if not positive definite
            good = good and math.isfinite(factor[0, 0] + factor[1, 1] + factor[2, 2])
        if not good:
            reasons[k] = _BAD_COVARIANCE
