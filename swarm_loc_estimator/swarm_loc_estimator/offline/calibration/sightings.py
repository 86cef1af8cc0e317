"""Errors of the sightings of cameras where the poses of robots are known, and how they scatter.

Bearing errors that all markers share at one time are errors of the camera's yaw: the mount sways, or the
robot leans. They last for seconds, so a filter that takes them for noise of single sightings is too sure.
Their covariance over the time between two sightings of different markers gives their standard deviation and
time constant, those of a first-order Gauss-Markov process. What remains is noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.filter.measurements import Measurements, select
from swarm_loc_estimator.filter.models import POLAR, predict_any
from swarm_loc_estimator.offline.batch.problem import BatchProblem, innovation
from swarm_loc_estimator.offline.calibration.recording import DENSE_GAP_NS
from swarm_loc_estimator.swarm.swarm import Robot

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


MIN_SIGHTINGS = 100  # Sightings needed to calibrate a camera


@dataclass(frozen=True)
class CameraFit:
    """Calibration of one robot's camera."""

    robot: Robot  # Calibrated
    sightings: Measurements  # (m,) all of which the truth is known, calibrated
    # (m, 3) measured minus true: range [m] and bearing [rad], or forward, left [m], heading [rad]
    before: FloatArray
    after: FloatArray  # (m, 3) the same errors, calibrated

    @property
    def polar(self) -> BoolArray:
        """Whether sightings (m,) are ranges and bearings."""
        return np.asarray(self.sightings.model == POLAR)

    @property
    def is_enough(self) -> bool:
        """Whether the sightings are enough to calibrate the camera."""
        return self.sightings.size >= MIN_SIGHTINGS


def camera_fits(
    before: BatchProblem, after: BatchProblem, paths: Mapping[str, Trajectory]
) -> list[CameraFit]:
    """The errors of each robot with a camera, by the paths of the robots in `map`."""
    _, old, new = np.intersect1d(before.source, after.source, return_indices=True)
    described, calibrated = errors_of(before, paths)[old], errors_of(after, paths)[new]
    sightings = select(after.sightings, new)
    known = np.isfinite(described[:, 0]) & np.isfinite(calibrated[:, 0])
    fits = []
    for index, robot in enumerate(after.swarm.robots):
        rows = known & after.is_seen[new] & (sightings.observer == index)
        if robot.camera is not None:
            fits.append(CameraFit(robot, select(sightings, rows), described[rows], calibrated[rows]))
    return fits


def errors_of(problem: BatchProblem, paths: Mapping[str, Trajectory]) -> FloatArray:
    """Measured minus true (m, 3) of all measurements; NaN where a pose is not known."""
    sightings = problem.sightings
    marks = [(mark.x, mark.y, mark.yaw or 0.0) for mark in problem.swarm.landmarks]
    # neither shifted nor biased
    marks += [(0.0, 0.0, 0.0)] * (len(problem.swarm.surveyed) - len(marks))
    places = np.where(problem.is_known[:, None], np.array(marks).reshape(-1, 3), np.nan)
    sides = np.full((2, sightings.size, 3), np.nan)
    for side, body in enumerate((sightings.mount, sightings.landmark)):
        sides[side, body >= 0] = places[body[body >= 0]]
    for index, robot in enumerate(problem.swarm.robots):
        if robot.name in paths:
            for side, who in enumerate((sightings.observer, sightings.target)):
                rows = np.flatnonzero(who == index)
                pose, known = interpolate(paths[robot.name], sightings.stamp_ns[rows], DENSE_GAP_NS)
                sides[side, rows[known]] = pose[known]
    value = predict_any(sightings, sides[0], sides[1], np.zeros((sightings.size, 3)))[0]
    return innovation(sightings, sightings.value, value)


# Sway: checked by test_calibration.py.
_EDGES_S = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0])  # Bins of the time between two sightings
_MIN_PAIRS = 30  # Minimum number of pairs of sightings of a bin that counts
_MAX_STEPS = 60  # Sightings after each one that are compared with it
_CUT = 4.0  # Errors are cut at this many spreads, so that outliers have no weight
_MIN_SHARE = 0.05  # Smallest share of the variance of bearings that counts as sway
_TIMES_S = (1.0, 60.0)  # Smallest and largest time constant


def with_scatter(fits: Sequence[CameraFit]) -> list[Robot]:
    """Calibrated robots of one type with the noise of their own sightings and the sway of their own cameras.

    Robots with few sightings get the median of the others. The noise is that of single sightings; `fit_noise`
    scales it for all robots together.
    """
    found = {fit.robot.name: _numbers(fit) for fit in fits if fit.is_enough}
    if not found:
        return [fit.robot for fit in fits]
    names = {name for one in found.values() for name in one}
    typical = {
        name: float(np.median([one[name] for one in found.values() if name in one])) for name in sorted(names)
    }
    return [_with(fit.robot, found.get(fit.robot.name, typical)) for fit in fits]


def _with(robot: Robot, numbers: dict[str, float]) -> Robot:
    """The robot with noise of its sensor and the sway of its camera, rounded to three digits."""
    rounded = {name: float(f"{value:.3g}") for name, value in numbers.items()}
    sway = {name: rounded.pop(name) for name in ("yaw_sigma", "yaw_time_s")}
    camera = robot.camera and replace(robot.camera, **sway)
    return replace(robot, camera=camera, sensor=replace(robot.sensor, **rounded))


def _numbers(fit: CameraFit) -> dict[str, float]:
    """Standard deviations of a robot's sightings and its sway."""
    polar, value = fit.polar, fit.sightings.value
    far = np.maximum(value[:, 0], 0.1)
    bearing = np.where(polar, fit.after[:, 1], fit.after[:, 1] / far)
    seconds = np.multiply(fit.sightings.stamp_ns, 1e-9, dtype=float)
    sway, time_s = sway_of(seconds, fit.sightings.reading, bearing)
    own = np.sqrt(max(spread(bearing) ** 2 - sway**2, 0.1 * spread(bearing) ** 2))
    numbers = {"yaw_sigma": sway, "yaw_time_s": time_s}
    if polar.any():
        numbers["range_sigma_per_m"] = max(1e-4, spread(fit.after[polar, 0] / far[polar]))
        numbers["bearing_sigma"] = max(1e-4, float(own))
    if not polar.all():
        numbers["forward_sigma"] = max(1e-4, spread(fit.after[~polar, 0]))
        numbers["left_sigma"] = max(1e-4, spread(fit.after[~polar, 1]) * float(own) / spread(bearing))
        numbers["heading_sigma"] = max(1e-4, spread(fit.after[~polar, 2]))
    return numbers


def sway_of(time_s: FloatArray, marker: IntArray, bearing: FloatArray) -> tuple[float, float]:
    """Standard deviation [rad] and time constant [s] of bearing errors (m,) that different markers share.

    Zeros if the errors of different markers are independent.
    """
    order = np.argsort(time_s, kind="stable")
    time_s, marker, bearing = time_s[order], marker[order], bearing[order]
    bearing = np.clip(bearing, -_CUT * spread(bearing), _CUT * spread(bearing))
    total, count = np.zeros(_EDGES_S.size - 1), np.zeros(_EDGES_S.size - 1)
    for step in range(1, min(_MAX_STEPS, time_s.size)):
        other = marker[step:] != marker[:-step]
        later = np.searchsorted(_EDGES_S, (time_s[step:] - time_s[:-step])[other], side="right") - 1
        product = (bearing[step:] * bearing[:-step])[other]
        inside = later < total.size
        total += np.bincount(later[inside], product[inside], total.size)
        count += np.bincount(later[inside], minlength=total.size)
    known = count >= _MIN_PAIRS
    variance = float(np.mean(bearing**2))
    if known.sum() < 2 or not known[0] or not total[0] > _MIN_SHARE * variance * count[0]:
        return 0.0, 0.0
    between_s = 0.5 * (_EDGES_S[:-1] + _EDGES_S[1:])[known]
    covariance, weight = total[known] / count[known] / variance, np.sqrt(count[known] / count[known].sum())

    def misfit(guess: FloatArray) -> FloatArray:
        share, log_time = guess
        return np.asarray(weight * (share * np.exp(-between_s / np.exp(log_time)) - covariance))

    limits = [0.0, np.log(_TIMES_S[0])], [1.0, np.log(_TIMES_S[1])]
    share, log_time = least_squares(misfit, [min(covariance[0], 0.9), np.log(5.0)], bounds=limits).x
    return float(np.sqrt(share * variance)), float(np.exp(log_time))
