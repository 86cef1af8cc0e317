"""Integrity: what the newest measurements say of the belief, whom they contradict, and when a robot is lost.

A measurement is a surprise when the squared Mahalanobis distance of its position exceeds a threshold that one
good measurement in twenty does, or when the whitened innovations of its last few have a trend. Every surprise
counts against its pair of observer and source. It counts against one of the two, too, where the other one is
in agreement: for each, the share of its pairs that are surprises, as observer and as source, is compared. A
robot whose camera was turned disagrees with all that it sees, a landmark that was moved with all that see it;
they are contradicted once enough speaks against them. A false sighting disagrees with nobody but itself: the
pair is set aside. Every measurement that is no surprise counts for those whom it is about.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.core.filter.belief import NEVER_NS, BeliefArrays, IntegrityArrays
from swarm_loc_estimator.core.filter.measurement_model import POLAR, MeasurementColumns
from swarm_loc_estimator.numerics.arrays import FloatArray
from swarm_loc_estimator.numerics.jit import compiled

CONFIRMED = 2
"""So many sightings that agree make a pose that was assumed one that is known."""
_ASIDE, _MAX_EVIDENCE = 10.0, 15.0
"""Evidence from which on a pair is set aside, and the most that is counted."""
DENIED = 7.5
"""From here on a robot is not told as tracked."""
_DOUBTFUL = 2.0
WELL_CONFIRMED = 12
_HIDDEN_SIGMA = (0.03, 0.03, 0.06)
"""What sensors may hide while a pose is doubtful, or few sightings have confirmed it [m], [m], [rad]."""

_SOURCES = 16
_SURPRISE = 6.0
_MAX_WEIGHT = 3.0
_UNEXPLAINED_WEIGHT = 2.0
_EXPLAINED_M, _EXPLAINED_SHARE = 0.1, 0.35
"""A wrong description explains errors of so much, and of that share of the distance or so many radians."""
_SINGLE_WEIGHT = 0.3
"""A surprise of an observer with no other one."""
_MAX_SINGLE_DOUBT = 5.0
"""One source alone makes an observer doubtful, but does not contradict it."""
_SHARED_WEIGHT = 0.2
"""The source's part where it cannot be told who is wrong."""
_RELIEF = 0.25
_RECENT_NS = 400_000_000
_TOLD_NS = 3_000_000_000
_AGAIN_NS = 90_000_000
"""What comes sooner after the last look of a pair is no new evidence."""
_INDEPENDENT_NS = 100_000_000
"""The errors of looks that follow each other faster are the same."""
_GATED_AGAIN_NS = 250_000_000
_TREND_LOOKS = 8
_TREND = 3.0
"""Squared sum of so many whitened innovations over the sum of their squares; 1 on average without a trend."""
_MIN_TREND = 0.6
"""A mean of whitened innovations that matters: calibrated sensors have trends that their noise covers."""
_TREND_WEIGHT = 4.0


class LossLimits(NamedTuple):
    """Beyond which a robot is given up.

    Attributes:
        position_sigma: Standard deviation of its position [m].
        heading_sigma: Of its heading [rad].
        gated_in_a_row: Gated measurements since the last accepted one.
        max_doubt: How much may speak against a robot or landmark before it is contradicted.
    """

    position_sigma: float
    heading_sigma: float
    gated_in_a_row: int
    max_doubt: float


def new_integrity(robots: int, landmarks: int) -> IntegrityArrays:
    """Nothing is held against anybody."""
    return IntegrityArrays(
        source=np.full((robots, _SOURCES), -1),
        source_ns=np.full((robots, _SOURCES), NEVER_NS // 2),
        counted_ns=np.full((robots, _SOURCES), NEVER_NS // 2),
        surprised=np.zeros((robots, _SOURCES), dtype=bool),
        unexplained=np.zeros((robots, _SOURCES), dtype=bool),
        trending=np.zeros((robots, _SOURCES), dtype=bool),
        evidence=np.zeros((robots, _SOURCES)),
        whitened=np.zeros((robots, _SOURCES, 2)),
        squares=np.zeros((robots, _SOURCES)),
        looks=np.zeros((robots, _SOURCES), dtype=np.int64),
        doubt=np.zeros(robots + landmarks),
        confirmations=np.zeros(robots, dtype=np.int64),
        gated_in_a_row=np.zeros(robots, dtype=np.int64),
        gated_source=np.full(robots, -1),
        gated_ns=np.full(robots, NEVER_NS // 2),
    )


@compiled
def assess(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    limits: LossLimits,
    look: tuple[float, FloatArray, bool],
) -> int:
    """Hold measurement k against what its observer and its source have shown lately.

    Args:
        measurements: (m,).
        k: Which one.
        belief: Its integrity is changed.
        limits: Beyond which a robot or landmark is contradicted.
        look: Squared Mahalanobis distance of the position, the innovation over its standard deviation (2,),
            and whether a wrong description could not explain it.

    Returns:
        The robot or landmark (as N + l) that is contradicted; -1: nobody.
    """
    observer, source = measurements.observer[k], source_of(measurements, k, belief)
    if observer < 0 or source < 0:
        return -1
    state, now_ns = belief.integrity, measurements.stamp_ns[k]
    distance, whitened, unexplained = look
    place = _find(measurements, k, belief)
    if place < 0:
        place = _new_place(state, observer, source)
    state.source_ns[observer, place] = max(now_ns, state.source_ns[observer, place])
    state.surprised[observer, place] = distance > _SURPRISE
    state.unexplained[observer, place] = unexplained
    if now_ns - state.counted_ns[observer, place] < _AGAIN_NS:
        return -1
    state.counted_ns[observer, place] = now_ns
    weight = min(distance / _SURPRISE, _MAX_WEIGHT) if distance > _SURPRISE else 0.0
    if weight == 0.0:
        weight = _weight_of_trend(state, observer, place, whitened)
    if weight == 0.0:
        if not state.trending[observer, place]:
            _relieve(state, observer, source, place)
        return -1
    if not _blame(state, (observer, source), weight, unexplained, now_ns):
        state.evidence[observer, place] = min(state.evidence[observer, place] + weight, _MAX_EVIDENCE)
    for node in (observer, source):
        if state.doubt[node] >= limits.max_doubt:
            return node
    return -1


def pairs_set_aside(state: IntegrityArrays, now_ns: int) -> list[tuple[int, int]]:
    """The pairs of observer and source that do not count, of those measured of late."""
    aside = (state.evidence >= _ASIDE) & (now_ns - state.source_ns < _TOLD_NS)
    return [(int(observer), int(state.source[observer, place])) for observer, place in np.argwhere(aside)]


@compiled
def is_set_aside(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> bool:
    """Whether the pair of measurement k has disagreed so often that it does not count."""
    observer, place = measurements.observer[k], _find(measurements, k, belief)
    aside: bool = place >= 0 and belief.integrity.evidence[observer, place] >= _ASIDE
    return aside


@compiled
def is_unexplained(kind: int, innovation: FloatArray, predicted: FloatArray) -> bool:
    """Whether an innovation (3,) of a prediction (3,) is larger than a wrong description can explain."""
    if kind == POLAR:
        far = abs(innovation[0]) > _EXPLAINED_M + _EXPLAINED_SHARE * predicted[0]
        aside: bool = far or abs(innovation[1]) > _EXPLAINED_SHARE + _EXPLAINED_M / max(predicted[0], 1e-3)
        return aside
    reach = _EXPLAINED_M + _EXPLAINED_SHARE * math.hypot(predicted[0], predicted[1])
    unexplained: bool = math.hypot(innovation[0], innovation[1]) > reach
    return unexplained


def is_elsewhere(state: IntegrityArrays, robot: int, now_ns: int) -> bool:
    """Whether most of what a robot has just measured can only mean that it is somewhere else."""
    recent = (state.source[robot] >= 0) & (now_ns - state.source_ns[robot] < _RECENT_NS)
    return bool(2 * np.sum(state.unexplained[robot, recent]) > np.sum(recent))


@compiled
def _relieve(state: IntegrityArrays, observer: int, source: int, place: int) -> None:
    """Count a look that is no surprise for those whom it is about."""
    state.evidence[observer, place] = max(0.0, state.evidence[observer, place] - _RELIEF)
    for node in (observer, source):
        state.doubt[node] = max(0.0, state.doubt[node] - _RELIEF)


@compiled
def _blame(
    state: IntegrityArrays, pair: tuple[int, int], weight: float, unexplained: bool, now_ns: int
) -> bool:
    """Add a surprise to the doubt of whoever has more of them among its pairs; False: of neither."""
    observer, source = pair
    bad_observer, share_observer = _surprises(state, observer, now_ns)
    _, share_source = _surprises(state, source, now_ns)
    if share_observer > 0.5 and share_observer >= share_source:
        if bad_observer >= 2:
            state.doubt[observer] += weight * (_UNEXPLAINED_WEIGHT if unexplained else 1.0)
        elif state.doubt[observer] < _MAX_SINGLE_DOUBT:
            state.doubt[observer] += _SINGLE_WEIGHT * weight
        if share_observer == share_source and state.doubt[source] < _MAX_SINGLE_DOUBT:
            state.doubt[source] += _SHARED_WEIGHT * weight
        return True
    if share_source > 0.5:
        state.doubt[source] += weight
        return True
    return False


@compiled
def _surprises(state: IntegrityArrays, node: int, now_ns: int) -> tuple[int, float]:
    """How many pairs of a robot or landmark are surprises, as observer and as source, and what share."""
    robots, places = state.source.shape
    bad, count = 0, 0
    for robot in range(robots):
        for place in range(places):
            source = state.source[robot, place]
            about = source >= 0 and node in (robot, source)
            if about and now_ns - state.source_ns[robot, place] < _RECENT_NS:
                count += 1
                bad += 1 if state.surprised[robot, place] or state.trending[robot, place] else 0
    return bad, bad / max(1, count)


@compiled
def _weight_of_trend(state: IntegrityArrays, observer: int, place: int, whitened: FloatArray) -> float:
    """Take a whitened innovation (2,) into the pair's sum; what speaks against it when there are enough."""
    total = state.whitened[observer, place]
    for i in range(2):
        total[i] += whitened[i]
        state.squares[observer, place] += whitened[i] * whitened[i]
    state.looks[observer, place] += 1
    if state.looks[observer, place] < _TREND_LOOKS:
        return 0.0
    squared = total[0] * total[0] + total[1] * total[1]
    trending = squared > max(_TREND * state.squares[observer, place], (_MIN_TREND * _TREND_LOOKS) ** 2)
    _forget_trend(state, observer, place)
    state.trending[observer, place] = trending
    return _TREND_WEIGHT if trending else 0.0


@compiled
def _forget_trend(state: IntegrityArrays, observer: int, place: int) -> None:
    state.whitened[observer, place, 0] = state.whitened[observer, place, 1] = 0.0
    state.squares[observer, place], state.looks[observer, place] = 0.0, 0


@compiled
def _find(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> int:
    """Where the pair of measurement k is remembered; -1: nowhere, or it is no pair."""
    observer, source = measurements.observer[k], source_of(measurements, k, belief)
    if observer >= 0 and source >= 0:
        sources = belief.integrity.source[observer]
        for place in range(sources.size):
            if sources[place] == source:
                return place
    return -1


@compiled
def _new_place(state: IntegrityArrays, observer: int, source: int) -> int:
    """Remember a new pair in place of the one seen longest ago."""
    oldest = 0
    for place in range(state.source.shape[1]):
        if state.source_ns[observer, place] < state.source_ns[observer, oldest]:
            oldest = place
    state.source[observer, oldest], state.source_ns[observer, oldest] = source, NEVER_NS // 2
    state.counted_ns[observer, oldest] = NEVER_NS // 2
    state.evidence[observer, oldest] = 0.0
    state.surprised[observer, oldest] = state.trending[observer, oldest] = False
    _forget_trend(state, observer, oldest)
    return oldest


@compiled
def source_of(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> int:
    """What measurement k is of: a robot, N + l for a landmark, or -1."""
    landmark: int = measurements.landmark[k] - 1
    target: int = measurements.target[k]
    return belief.tracked.size + landmark if landmark >= 0 else target


@compiled
def noise_of_frequent_looks(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> float:
    """By what factor the noise of measurement k counts more, so soon after another one of its pair."""
    observer, place = measurements.observer[k], _find(measurements, k, belief)
    if place < 0:
        return 1.0
    since_ns = measurements.stamp_ns[k] - belief.integrity.source_ns[observer, place]
    return _INDEPENDENT_NS / since_ns if 0 < since_ns < _INDEPENDENT_NS else 1.0


@compiled
def confirm(measurements: MeasurementColumns, k: int, belief: BeliefArrays, passed: bool) -> int:
    """Hold measurement k against poses that were assumed; return a robot that is elsewhere, or -1."""
    observer, target = measurements.observer[k], measurements.target[k]
    known = belief.integrity.confirmations
    knows_observer = observer < 0 or known[observer] >= CONFIRMED
    knows_target = target < 0 or known[target] >= CONFIRMED
    if passed:
        if knows_observer and target >= 0:
            known[target] += 1
        if knows_target and observer >= 0:
            known[observer] += 1
        return -1
    if knows_observer and knows_target:
        return -1
    elsewhere: int = target if knows_observer else observer
    return elsewhere


@compiled
def is_uncertain(belief: BeliefArrays, robot: int, pose: FloatArray, limits: LossLimits) -> bool:
    """Whether the standard deviation of the robot's position or heading at `pose` (3,) exceeds its limit."""
    p = belief.covariance[3 * robot : 3 * robot + 3, 3 * robot : 3 * robot + 3]
    x = p[0, 0] - 2.0 * pose[1] * p[0, 2] + pose[1] * pose[1] * p[2, 2]
    y = p[1, 1] + 2.0 * pose[0] * p[1, 2] + pose[0] * pose[0] * p[2, 2]
    uncertain: bool = max(x, y) > limits.position_sigma**2 or p[2, 2] > limits.heading_sigma**2
    return uncertain


@compiled
def add_hidden_errors(state: IntegrityArrays, robot: int, covariance: FloatArray) -> None:
    """Add to a pose's covariance (3, 3) what its sensors may hide."""
    if state.doubt[robot] > _DOUBTFUL or state.confirmations[robot] < WELL_CONFIRMED:
        for i in range(3):
            covariance[i, i] += _HIDDEN_SIGMA[i] ** 2


@compiled
def count_gated(
    measurements: MeasurementColumns, k: int, belief: BeliefArrays, passed: bool, limits: LossLimits
) -> int:
    """Count fixes and gated measurements; return a robot that has had too many gated in a row, or -1.

    One source alone counts four times a second at most.
    """
    observer, target = measurements.observer[k], measurements.target[k]
    lost, state = -1, belief.integrity
    for side in (observer, target):
        if side >= 0:
            source = source_of(measurements, k, belief) if side == observer else observer
            now_ns = measurements.stamp_ns[k]
            if passed:
                state.gated_in_a_row[side] = 0
            elif state.gated_source[side] != source or now_ns - state.gated_ns[side] > _GATED_AGAIN_NS:
                state.gated_in_a_row[side] += 1
                state.gated_source[side], state.gated_ns[side] = source, now_ns
            if state.gated_in_a_row[side] >= limits.gated_in_a_row:
                lost = side
    if passed and (observer < 0 or target < 0):
        fixed = max(observer, target)
        belief.last_fix_ns[fixed] = max(belief.last_fix_ns[fixed], measurements.stamp_ns[k])
    return lost
