"""Loss of track: confirmation of assumed poses, reported uncertainty, and when a robot is lost."""

from __future__ import annotations

from typing import NamedTuple

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.filter.belief import BeliefArrays, IntegrityArrays, covariance_within
from swarm_loc_estimator.filter.integrity.pairs import source_of
from swarm_loc_estimator.filter.measurement_model import MeasurementColumns

CONFIRMED = 2  # Number of agreeing sightings after which an assumed pose counts as known
WELL_CONFIRMED = 12
_SUSPECT = 2.0
_SUSPECT_SIGMA = (0.03, 0.03, 0.06)
"""Standard deviations added while a pose is suspect or little confirmed: x [m], y [m], heading [rad]."""
_SEEN_RELIEF = 1.0
"""Decrease of the fault score by a detection from above, which depends on no other estimate."""
_GATED_AGAIN_NS = 250_000_000
_MAX_GATED_FIXES = 3
"""Gated fixes after which a robot is re-initialized from its fixes, whatever other robots measure of it."""
_CONFIRMED_AGAIN_NS = 150_000_000
"""Sightings within this time count as one confirmation, because their errors are correlated."""


class LossLimits(NamedTuple):
    """Limits beyond which a robot is lost."""

    position_sigma: float  # Standard deviation of its position [m]
    heading_sigma: float  # Of its heading [rad]
    gated_in_a_row: int  # Gated measurements since the last accepted one
    max_fault_score: float  # Fault score from which a robot or landmark is contradicted


@inlined_njit
def confirm(measurements: MeasurementColumns, k: int, belief: BeliefArrays, accepted: bool) -> int:
    """Check measurement k against assumed poses; return a robot that is kidnapped, or -1."""
    observer, target = measurements.observer[k], measurements.target[k]
    known = belief.integrity.confirmations
    knows_observer = observer < 0 or known[observer] >= CONFIRMED
    knows_target = target < 0 or known[target] >= CONFIRMED
    if accepted:
        if knows_observer and target >= 0:
            _count_confirmation(belief.integrity, target, measurements.stamp_ns[k])
        if knows_target and observer >= 0:
            _count_confirmation(belief.integrity, observer, measurements.stamp_ns[k])
        return -1
    if knows_observer and knows_target:
        return -1
    elsewhere: int = target if knows_observer else observer
    return elsewhere


@inlined_njit
def _count_confirmation(state: IntegrityArrays, robot: int, stamp_ns: int) -> None:
    if stamp_ns - state.confirmed_ns[robot] >= _CONFIRMED_AGAIN_NS:
        state.confirmations[robot] += 1
        state.confirmed_ns[robot] = stamp_ns


@inlined_njit
def is_uncertain(belief: BeliefArrays, robot: int, pose: FloatArray, limits: LossLimits) -> bool:
    """Whether the standard deviation of the robot's position or heading at `pose` (3,) exceeds its limit."""
    first = 3 * robot
    xx, yy = covariance_within(belief, first, 0, 0), covariance_within(belief, first, 1, 1)
    xt, yt = covariance_within(belief, first, 0, 2), covariance_within(belief, first, 1, 2)
    tt = covariance_within(belief, first, 2, 2)
    x = xx - 2.0 * pose[1] * xt + pose[1] * pose[1] * tt
    y = yy + 2.0 * pose[0] * yt + pose[0] * pose[0] * tt
    uncertain: bool = max(x, y) > limits.position_sigma**2 or tt > limits.heading_sigma**2
    return uncertain


@inlined_njit
def inflate_suspect_covariance(state: IntegrityArrays, robot: int, covariance: FloatArray) -> None:
    """Inflate the covariance (3, 3) of a pose that is suspect or little confirmed."""
    if state.fault_score[robot] > _SUSPECT or state.confirmations[robot] < WELL_CONFIRMED:
        for i in range(3):
            covariance[i, i] += _SUSPECT_SIGMA[i] ** 2


def count_missed(state: IntegrityArrays, robot: int, weight: float) -> float:
    """Raise the fault score of a robot that was not detected where it was expected; return the score."""
    state.fault_score[robot] += weight
    return float(state.fault_score[robot])


def count_seen(state: IntegrityArrays, robot: int) -> None:
    """Lower the fault score of a robot that was detected from above where it was expected."""
    state.fault_score[robot] = max(0.0, state.fault_score[robot] - _SEEN_RELIEF)


@inlined_njit
def count_gated(
    measurements: MeasurementColumns, k: int, belief: BeliefArrays, accepted: bool, limits: LossLimits
) -> int:
    """Count fixes and gated measurements; return a robot with too many gated in a row, or -1.

    One source alone counts at most four times a second.
    """
    observer, target = measurements.observer[k], measurements.target[k]
    lost, state = -1, belief.integrity
    for side in (observer, target):
        if side >= 0:
            source = source_of(measurements, k, belief) if side == observer else observer
            now_ns = measurements.stamp_ns[k]
            if accepted:
                state.gated_in_a_row[side] = 0
            elif state.gated_source[side] != source or now_ns - state.gated_ns[side] > _GATED_AGAIN_NS:
                state.gated_in_a_row[side] += 1
                state.gated_source[side], state.gated_ns[side] = source, now_ns
            if state.gated_in_a_row[side] >= limits.gated_in_a_row:
                lost = side
    if observer < 0 and not accepted and _is_off_its_fixes(state, target, measurements.stamp_ns[k]):
        lost = target
    if accepted and (observer < 0 or target < 0):
        fixed = max(observer, target)
        state.gated_fixes[fixed] = 0
        belief.last_fix_ns[fixed] = max(belief.last_fix_ns[fixed], measurements.stamp_ns[k])
    return lost


@cached_njit
def _is_off_its_fixes(state: IntegrityArrays, robot: int, stamp_ns: int) -> bool:
    """Count a gated fix; return whether there are too many since the last absolute measurement.

    Robots initialized from this one agree with it wherever it is, so their measurements do not count.
    """
    if stamp_ns - state.gated_fix_ns[robot] > _GATED_AGAIN_NS:
        state.gated_fixes[robot] += 1
        state.gated_fix_ns[robot] = stamp_ns
    off: bool = state.gated_fixes[robot] >= _MAX_GATED_FIXES
    return off
