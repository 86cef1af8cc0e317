"""Robust regression with a prior, and the common prior of robots of one type."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray

TO_SIGMA = 1.4826  # Standard deviation per median absolute deviation, for normal errors


def spread(residuals: FloatArray) -> float:
    """Robust standard deviation of residuals about zero; NaN without any."""
    return float(TO_SIGMA * np.median(np.abs(residuals))) if residuals.size else float("nan")


def population(values: FloatArray, sigma: FloatArray, wide: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (p,) and standard deviation (p,) of the parameters of the robots of a type, as prior of each.

    Args:
        values: (n, p) parameters of each robot fitted alone.
        sigma: (n, p) their standard deviations.
        wide: (p,) the prior of those fits; the result is between a tenth of it and it.
    """
    weight = 1.0 / (sigma**2 + (0.3 * wide) ** 2)
    mean = np.sum(weight * values, axis=0) / np.sum(weight, axis=0)
    between = np.sum(weight * (values - mean) ** 2, axis=0) / np.sum(weight, axis=0)
    count = values.shape[0]
    between *= count / max(count - 1, 1)
    if count == 1:
        return mean, wide
    return mean, np.clip(np.sqrt(between), 0.1 * wide, wide)


def ridge(
    basis: FloatArray, wanted: FloatArray, penalty: FloatArray, prior: FloatArray, rounds: int = 6
) -> FloatArray:
    """Parameters (p,) of basis (m, p) @ parameters = wanted (m,), robustly.

    Args:
        basis: (m, p).
        wanted: (m,).
        penalty: (p, p) information of the prior in units of the good rows' own, per row.
        prior: (p,) mean of the prior.
        rounds: Of reweighting.
    """
    weight = np.ones(wanted.size)
    for _ in range(rounds):
        weighted = basis * weight[:, None]
        normal = weighted.T @ basis / wanted.size + penalty
        found: FloatArray = np.linalg.solve(normal, weighted.T @ wanted / wanted.size + penalty @ prior)
        error = wanted - basis @ found
        weight = 1.0 / np.maximum(1.0, np.abs(error) / (2.0 * max(spread(error), 1e-12)))
    return found
