"""Estimates: poses of all robots at an instant, covariances and transforms to the odom frames."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.se2_scalar import composed, wrap
from swarm_loc_estimator.common.small_matrix import add_scaled
from swarm_loc_estimator.filter.belief import NEVER_NS, BeliefArrays, IntegrityArrays
from swarm_loc_estimator.filter.integrity import CONFIRMED, inflate_suspect_covariance, is_contradicted
from swarm_loc_estimator.filter.prediction import new_scratch, write_predicted
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.track_arrays import TrackArrays, look_up, new_sample
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.settings import Settings


class Status(IntEnum):
    """Localization status of a robot; the values of SwarmPose.status."""

    WAITING = 0  # not localized
    TRACKED = 1
    STALE = 2  # localized, but its odometry has timed out
    UNCONFIRMED = 3  # initialized, but not confirmed by a sighting yet
    CONTRADICTED = 4  # its newest sightings contradict its pose
    UNCERTAIN = 5  # localized, but its standard deviation exceeds lost_sigma or lost_heading_sigma


_WAITING, _TRACKED, _STALE = int(Status.WAITING), int(Status.TRACKED), int(Status.STALE)
_UNCONFIRMED, _CONTRADICTED = int(Status.UNCONFIRMED), int(Status.CONTRADICTED)
_UNCERTAIN = int(Status.UNCERTAIN)


class TrackedLimits(NamedTuple):
    """Limits beyond which a localized robot is not reported as tracked."""

    timeout_s: FloatArray  # (N,) age of the newest odometry [s]
    position_sigma: float  # Standard deviation of x and of y [m]
    heading_sigma: float  # Standard deviation of the heading [rad]

    @classmethod
    def of(cls, swarm: Swarm, settings: Settings) -> TrackedLimits:
        """Limits of a swarm's robots."""
        timeout_s = np.array([robot.odometry.timeout_s for robot in swarm.robots])
        return cls(timeout_s, settings.lost_sigma, settings.lost_heading_sigma)


class Estimate(NamedTuple):
    """Poses of all robots at one instant."""

    stamp_ns: int  #: The instant
    poses: FloatArray  #: (N, 3) x [m], y [m], theta [rad] in `map`; NaN for robots that are not localized
    covariances: FloatArray  #: (N, 3, 3) of x, y, theta; NaN where `poses` are
    map_to_odom: FloatArray  #: (N, 3) transform from `map` to the robot's odom frame; NaN where `poses` are
    status: NDArray[np.uint8]  #: (N,) of `Status`
    fix_age_s: FloatArray  #: (N,) age of the newest accepted landmark sighting or absolute fix [s]; -1: none


def estimate_at(state: SwarmState, tracks: TrackArrays, limits: TrackedLimits, now_ns: int) -> Estimate:
    """Predict the estimate to an instant.

    Args:
        state: State at the newest measurements.
        tracks: Odometry, used for the prediction.
        limits: Decide which robots are tracked.
        now_ns: The instant.
    """
    estimate = _new_estimate(now_ns, state.tracked.size)
    _write_all(state.arrays(), tracks, limits, estimate)
    return estimate


@cached_njit
def _new_estimate(now_ns: int, robots: int) -> Estimate:
    """An estimate without localized robots."""
    return Estimate(
        now_ns,
        np.full((robots, 3), np.nan),
        np.full((robots, 3, 3), np.nan),
        np.full((robots, 3), np.nan),
        np.full(robots, _WAITING, dtype=np.uint8),
        np.full(robots, -1.0),
    )


@cached_njit
def _write_all(belief: BeliefArrays, tracks: TrackArrays, limits: TrackedLimits, out: Estimate) -> None:
    """Write the predictions of all tracked robots to an estimate."""
    sample, scratch, t, error = new_sample(1), new_scratch(), np.empty(3), np.empty((3, 3))
    track, raw = sample.pose[0], sample.raw[0]
    for i in range(belief.tracked.size):
        if belief.last_fix_ns[i] != NEVER_NS:
            out.fix_age_s[i] = (out.stamp_ns - belief.last_fix_ns[i]) * 1e-9
        if not belief.tracked[i]:
            continue
        look_up(tracks, i, out.stamp_ns, sample, 0)
        to = Preintegrated(out.stamp_ns, sample.covariance[0], sample.jacobian[0])
        write_predicted(belief, i, to, scratch, t, error)
        add_scaled(error, belief.integrity.excess[i], 1.0)
        x, y, theta = composed(t[0], t[1], t[2], track[0], track[1], track[2])
        out.poses[i, 0], out.poses[i, 1], out.poses[i, 2] = x, y, wrap(theta)
        _pose_covariance(x, y, error, out.covariances[i])
        inflate_suspect_covariance(belief.integrity, i, out.covariances[i])
        out.status[i] = _status(belief.integrity, i, sample.silence_s[0], limits, out.covariances[i])
        cos, sin = np.cos(theta - raw[2]), np.sin(theta - raw[2])
        out.map_to_odom[i, 0] = x - cos * raw[0] + sin * raw[1]
        out.map_to_odom[i, 1] = y - sin * raw[0] - cos * raw[1]
        out.map_to_odom[i, 2] = wrap(theta - raw[2])


@inlined_njit
def _status(
    integrity: IntegrityArrays, robot: int, silence_s: float, limits: TrackedLimits, covariance: FloatArray
) -> int:
    """Status of a localized robot with the reported covariance (3, 3)."""
    if silence_s > limits.timeout_s[robot]:
        return _STALE
    if integrity.confirmations[robot] < CONFIRMED:
        return _UNCONFIRMED
    if is_contradicted(integrity, robot):
        return _CONTRADICTED
    position = max(covariance[0, 0], covariance[1, 1])
    if position > limits.position_sigma**2 or covariance[2, 2] > limits.heading_sigma**2:
        return _UNCERTAIN
    return _TRACKED


@inlined_njit
def _pose_covariance(x: float, y: float, error: FloatArray, out: FloatArray) -> None:
    """Write the covariance (3, 3) of x, y, theta, converted from that of the right-invariant error."""
    shear = (-y, x, 0.0)
    for a in range(3):
        for b in range(3):
            out[a, b] = error[a, b] + shear[a] * error[2, b] + error[a, 2] * shear[b]
            out[a, b] += shear[a] * error[2, 2] * shear[b]
