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
    valid = np.empty(measurements.size, dtype=np.bool_)
    _check_parameters(measurements, np.array(list(MODELS)), robots, landmarks, valid)
    return valid


@cached_njit
def _check_parameters(
    measurements: MeasurementArray, models: IntArray, robots: int, landmarks: int, valid: BoolArray
) -> None:
    for k in range(valid.size):
        one = measurements[k]
        good = NOBODY <= one.observer < robots and NOBODY <= one.target < robots
        good = good and 0 <= one.landmark <= landmarks
        good = good and (one.observer != one.target or one.observer == NOBODY)
        good = good and math.isfinite(one.stamp_variance) and one.stamp_variance >= 0.0
        good = good and not math.isnan(one.gate)
        for i in range(3):
            good = good and math.isfinite(one.sensor[i]) and math.isfinite(one.marker[i])
        known = False
        for number in models:
            known = known or one.kind == number
        valid[k] = good and known


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
