"""What the state says at an instant: poses of all robots, their covariances and the drivers' frames."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.compiled import compiled, composed, wrap
from swarm_loc_estimator.core.motion import TrackArrays, look_up
from swarm_loc_estimator.core.prediction import predicted
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.state import NEVER_NS, BeliefArrays, SwarmState


class Status(IntEnum):
    """How a robot stands; the values of SwarmPose.status."""

    WAITING = 0  # not located
    TRACKED = 1
    STALE = 2  # located, but its odometry is silent


_WAITING, _TRACKED, _STALE = int(Status.WAITING), int(Status.TRACKED), int(Status.STALE)


@dataclass(frozen=True)
class SwarmEstimate:
    """Poses of all robots at one instant.

    Attributes:
        stamp_ns: The instant.
        poses: (N, 3) x [m], y [m], theta [rad] in `map`; NaN for robots that are not located.
        covariances: (N, 3, 3) of x, y, theta; NaN likewise.
        map_to_odom: (N, 3) from `map` to the driver's own odom frame; NaN likewise.
        status: (N,) of `Status`.
        fix_age_s: (N,) since the newest measurement tied to a landmark or an absolute fix; -1: never.
    """

    stamp_ns: int
    poses: FloatArray
    covariances: FloatArray
    map_to_odom: FloatArray
    status: NDArray[np.uint8]
    fix_age_s: FloatArray


def read_out(state: SwarmState, tracks: TrackArrays, timeout_s: FloatArray, now_ns: int) -> SwarmEstimate:
    """The estimate at an instant.

    Args:
        state: Belief at its newest measurements.
        tracks: Odometry, which leads from there to the instant.
        timeout_s: (N,) silence of the odometry after which a robot is stale.
        now_ns: The instant.
    """
    n = state.tracked.size
    poses, covariances, map_to_odom = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3))
    status, fix_age_s = np.empty(n, dtype=np.uint8), np.empty(n)
    estimate = SwarmEstimate(now_ns, poses, covariances, map_to_odom, status, fix_age_s)
    _read_all(state.arrays(), tracks, timeout_s, now_ns, poses, covariances, map_to_odom, status, fix_age_s)
    return estimate


@compiled
def _read_all(
    belief: BeliefArrays,
    tracks: TrackArrays,
    timeout_s: FloatArray,
    now_ns: int,
    poses: FloatArray,
    covariances: FloatArray,
    map_to_odom: FloatArray,
    status: NDArray[np.uint8],
    fix_age_s: FloatArray,
) -> None:
    """Fill the arrays (N, ...) of an estimate."""
    track, raw, t = np.empty(3), np.empty(3), np.empty(3)
    gathered, error = np.empty((2, 3, 3)), np.empty((3, 3))
    for i in range(belief.tracked.size):
        fixed_ns = belief.last_fix_ns[i]
        fix_age_s[i] = -1.0 if fixed_ns == NEVER_NS else (now_ns - fixed_ns) * 1e-9
        if not belief.tracked[i]:
            status[i] = _WAITING
            poses[i].fill(np.nan)
            covariances[i].fill(np.nan)
            map_to_odom[i].fill(np.nan)
            continue
        silence_s = look_up(tracks, i, now_ns, track, raw, gathered)
        status[i] = _STALE if silence_s > timeout_s[i] else _TRACKED
        predicted(belief, i, gathered, now_ns, t, error)
        x, y, theta = composed(t[0], t[1], t[2], track[0], track[1], track[2])
        poses[i, 0], poses[i, 1], poses[i, 2] = x, y, wrap(theta)
        _pose_covariance(x, y, error, covariances[i])
        cos, sin = np.cos(theta - raw[2]), np.sin(theta - raw[2])
        map_to_odom[i, 0] = x - cos * raw[0] + sin * raw[1]
        map_to_odom[i, 1] = y - sin * raw[0] - cos * raw[1]
        map_to_odom[i, 2] = wrap(theta - raw[2])


@compiled
def _pose_covariance(x: float, y: float, error: FloatArray, out: FloatArray) -> None:
    """Write the covariance (3, 3) of x, y, theta from that of the right-invariant error."""
    shear = (-y, x, 0.0)
    for a in range(3):
        for b in range(3):
            out[a, b] = error[a, b] + shear[a] * error[2, b] + error[a, 2] * shear[b]
            out[a, b] += shear[a] * error[2, 2] * shear[b]
