"""The scatter of sightings: noise of each robot's own, and sway of its camera.

Bearing errors that all markers share at one time are errors of the camera's yaw: the mount sways, or the
robot leans. They last for seconds, so a filter that takes them for noise of single sightings is too sure.
Their covariance over the time between two sightings of different markers gives their standard deviation and
time constant, those of a first-order Gauss-Markov process. What remains is noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.offline.calibration.camera import CameraFit
from swarm_loc_estimator.offline.calibration.robust import spread
from swarm_loc_estimator.swarm.swarm import Robot

# Sway: checked by test_scatter.py.
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
