"""Checks of odometry steps: jumps, resets, and odometry whose pose is constant while its twist is not.

A step is compared with what the robot can do between two stamps, and with the twists at both ends. Drivers
report the twist of the step before, of the step after or of the instant, so the mean twist of a step lies
between the two; while it does not, or the twist is not filled, it proves nothing.
"""

from __future__ import annotations

import math

from swarm_loc_estimator.common.jit import inlined_njit, norefcount_njit
from swarm_loc_estimator.odometry.track_arrays import BEFORE_ALL_NS, TrackArrays

NO_FAULT, JUMP, RESET = 0, 1, 2
"""Faults of a step: none; beyond the speed limits; contradicts the twist, or a restart at the origin."""

_TURN_SLACK = 0.2  # Tolerance of a turn beyond the maximum turn rate [rad], because stamps jitter
_TWIST_TURN_SLACK = 0.03  # Tolerance of a turn outside the twists [rad]
_TWIST_PATH_SLACK = 0.1  # Tolerance of a displacement outside the twists, in wheel separations
_LEAST_RATE = 0.05
"""Share of the maximum rates by which rates may vary in a step, until the robot has reported larger ones."""
_AGREED_ENOUGH, _AGREED_MOST, _AGREED_LOSS = 20, 60, 30
"""Number of agreeing steps from which the twist is used, its maximum, and its loss at a contradiction."""
_RESTART_GAP = 2.5  # Pause before a restart at the origin, in previous steps
_ROUNDING = 1e-9
_UNMOVED_M, _UNMOVED_RAD = 0.02, 0.2  # Motion by the twist from which a constant pose is not believed
_UNMOVED_ROWS = 3  # Minimum number of rows with that pose
_UNMOVED_S = 10.0
"""Time constant with which this motion is forgotten, so that a small bias of the twist is no motion."""


@norefcount_njit
def fault_of_step(
    tracks: TrackArrays, robot: int, row: int, step: tuple[float, float, float], duration_s: float
) -> int:
    """Fault of a step forward, left [m] and turn [rad] to a row; updates the row's evidence of the twist."""
    model = tracks.model[robot]
    agreed, fastest = tracks.agreed[robot, row], tracks.fastest[robot, row]
    for i in range(2):
        agreed[i], fastest[i] = tracks.agreed[robot, row - 1, i], tracks.fastest[robot, row - 1, i]
    fault = NO_FAULT
    if _is_beyond_limits(tracks, robot, step, duration_s):
        fault = JUMP
    elif _is_restart(tracks, robot, row, duration_s):
        fault = RESET
    earlier, later = tracks.twist[robot, row - 1], tracks.twist[robot, row]
    known = math.isfinite(earlier[0] + earlier[1] + earlier[2] + later[0] + later[1] + later[2])
    if not known or duration_s > model.timeout_s:
        return fault
    speeds = math.hypot(earlier[0], earlier[1]), math.hypot(later[0], later[1])
    rates = abs(earlier[2]), abs(later[2])
    fastest[0] = max(fastest[0], speeds[0], speeds[1], _LEAST_RATE * model.max_speed)
    fastest[1] = max(fastest[1], rates[0], rates[1], _LEAST_RATE * model.max_turn_rate)
    half = 0.5 * step[2]
    arc = math.hypot(step[0], step[1]) * (half / math.sin(half) if half != 0.0 else 1.0)
    slack = _TWIST_PATH_SLACK * model.wheel_separation + fastest[0] * duration_s
    turn_slack = _TWIST_TURN_SLACK + fastest[1] * duration_s
    away = _outside(arc, speeds[0] * duration_s, speeds[1] * duration_s)  # some drivers turn the velocity
    turned = _outside(step[2], earlier[2] * duration_s, later[2] * duration_s)
    moves = (speeds[0] + speeds[1] > 0.0 and arc > 0.0), (rates[0] + rates[1] > 0.0 and step[2] != 0.0)
    for i, contradicts in enumerate((away > slack, turned > turn_slack)):
        if contradicts:
            if agreed[i] >= _AGREED_ENOUGH and fault == NO_FAULT:
                fault = RESET
            agreed[i] = max(0, agreed[i] - _AGREED_LOSS)
        elif moves[i]:
            agreed[i] = min(_AGREED_MOST, agreed[i] + 1)
    return fault


@inlined_njit
def _is_beyond_limits(
    tracks: TrackArrays, robot: int, step: tuple[float, float, float], duration_s: float
) -> bool:
    """Whether a step exceeds the maximum speed or turn rate."""
    model = tracks.model[robot]
    # tolerance of half a robot's width, because stamps jitter
    near = math.hypot(step[0], step[1]) <= model.max_speed * duration_s + 0.5 * model.wheel_separation
    return not (near and abs(step[2]) <= model.max_turn_rate * duration_s + _TURN_SLACK)  # True for NaN


@inlined_njit
def _is_restart(tracks: TrackArrays, robot: int, row: int, duration_s: float) -> bool:
    """Whether the pose is zero after a pause, and was not before."""
    if row < 2 or not _is_zero(tracks, robot, row) or _is_zero(tracks, robot, row - 1):
        return False
    stamps = tracks.stamp_ns[robot]
    return bool(duration_s > _RESTART_GAP * 1e-9 * (stamps[row - 1] - stamps[row - 2]))


@inlined_njit
def _is_zero(tracks: TrackArrays, robot: int, row: int) -> bool:
    """Whether the reported pose of a row is zero up to rounding."""
    pose = tracks.raw[robot, row]
    return bool(abs(pose[0]) + abs(pose[1]) < _ROUNDING and math.cos(pose[2]) == 1.0)


@inlined_njit
def _outside(value: float, one: float, other: float) -> float:
    """Distance of a value from the interval between two others."""
    return max(0.0, value - max(one, other), min(one, other) - value)


@norefcount_njit
def update_unmoved(tracks: TrackArrays, robot: int, row: int, oldest_ns: int) -> bool:
    """Note whether a row's pose has changed; return whether the twist is integrated from now on.

    A pose that has been constant since the first row while the twist says that the robot has moved is not
    filled by its driver. Rows not older than `oldest_ns` are then integrated by their twists until the pose
    changes for the first time.
    """
    before, after = tracks.raw[robot, row - 1], tracks.raw[robot, row]
    moved = tracks.unmoved[robot, row]
    stamp_ns, before_ns = tracks.stamp_ns[robot, row], tracks.stamp_ns[robot, row - 1]
    if after[0] != before[0] or after[1] != before[1] or after[2] != before[2]:
        tracks.twist_until_ns[robot] = min(tracks.twist_until_ns[robot], before_ns)
        moved[0] = moved[1] = moved[2] = math.nan
        return False
    duration_s = (stamp_ns - before_ns) * 1e-9
    left = math.exp(-duration_s / _UNMOVED_S)
    if duration_s > tracks.model[robot].timeout_s:
        duration_s = 0.0
    for i in range(3):
        mean = 0.5 * (tracks.twist[robot, row - 1, i] + tracks.twist[robot, row, i])
        moved[i] = left * tracks.unmoved[robot, row - 1, i] + (
            mean * duration_s if math.isfinite(mean) else 0.0
        )
    has_moved = math.hypot(moved[0], moved[1]) > _UNMOVED_M or abs(moved[2]) > _UNMOVED_RAD  # False for NaN
    if row < _UNMOVED_ROWS or not has_moved or stamp_ns > tracks.twist_from_ns[robot]:
        return False
    begin_ns = tracks.begin_ns[robot]
    if oldest_ns > BEFORE_ALL_NS:
        begin_ns = max(begin_ns, oldest_ns + tracks.delay_ns[robot])
    tracks.twist_from_ns[robot] = begin_ns
    return True
