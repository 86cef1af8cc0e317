"""Fault detection and exclusion: outliers are attributed to an observer, to a source, or to their pair.

A measurement is an outlier when the squared Mahalanobis distance of its position exceeds a threshold that one
good measurement in twenty exceeds, or when the whitened innovations of its last few have a trend. An outlier
raises the fault score of whichever of observer and source has the larger share of outliers among its pairs.
A robot whose camera was turned disagrees with all that it sees; a landmark that was moved disagrees with all
that see it. Either is contradicted once its fault score reaches a limit. If both agree with others, the
outlier is evidence against the pair alone, and the pair is excluded. Inliers lower scores and evidence.
"""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.filter.belief import NEVER_NS, BeliefArrays, IntegrityArrays
from swarm_loc_estimator.filter.integrity.motion_noise import LOG_SCALES, WINDOWS
from swarm_loc_estimator.filter.integrity.noise_inflation import inflate_noise
from swarm_loc_estimator.filter.integrity.pairs import (
    AGAIN_NS,
    EXCLUDED,
    MAX_EVIDENCE,
    RECENT_NS,
    TREND,
    find_pair,
    links_disagree,
    new_pair,
    source_of,
    weight_of_trend,
)
from swarm_loc_estimator.filter.measurement_model import POLAR, MeasurementColumns
from swarm_loc_estimator.swarm.calibration_states import CAMERA_YAW

_SUSPECT = 7.5  # Fault score from which a robot is not reported as tracked

_SOURCES = 16
_OUTLIER = 6.0
_MAX_WEIGHT = 3.0
_UNEXPLAINED_WEIGHT = 2.0
NOISE, DESCRIPTION, KIDNAPPED = 0, 1, 2
"""Possible causes of an innovation: noise, a wrong description, or a robot at another place."""
_NOISE_M = 0.05
_EXPLAINED_M, _EXPLAINED_SHARE = 0.1, 0.35
"""Error that a wrong description can explain: a constant, and a share of the distance."""
_SMALL_M, _SMALL_SHARE = 0.003, 0.005
"""Errors up to this constant and share of the distance are inliers whatever the noise is."""
_SINGLE_WEIGHT = 0.3  # Weight of an outlier whose observer has no other one
_MAX_SINGLE_DOUBT = 5.0
"""A single source raises the fault score of an observer up to here, which does not contradict it."""
_SHARED_WEIGHT = 0.2  # Weight for the source where observer and source are equally likely to be wrong
_INLIER_WEIGHT = 0.25
_ONE_IMAGE_NS = 20_000_000
_REPORTED_NS = 3_000_000_000
_INDEPENDENT_NS = 100_000_000  # Measurements of a pair that follow each other faster share their errors


def new_integrity(robots: int, landmarks: int) -> IntegrityArrays:
    """All fault scores zero, no pair known."""
    return IntegrityArrays(
        source=np.full((robots, _SOURCES), -1),
        source_ns=np.full((robots, _SOURCES), NEVER_NS // 2),
        counted_ns=np.full((robots, _SOURCES), NEVER_NS // 2),
        outlier=np.zeros((robots, _SOURCES), dtype=bool),
        unexplained=np.zeros((robots, _SOURCES), dtype=bool),
        trending=np.zeros((robots, _SOURCES), dtype=bool),
        evidence=np.zeros((robots, _SOURCES)),
        whitened=np.zeros((robots, _SOURCES, 2)),
        squares=np.zeros((robots, _SOURCES)),
        looks=np.zeros((robots, _SOURCES), dtype=np.int64),
        fault_score=np.zeros(robots + landmarks),
        confirmations=np.zeros(robots, dtype=np.int64),
        confirmed_ns=np.full(robots, NEVER_NS // 2),
        gated_in_a_row=np.zeros(robots, dtype=np.int64),
        gated_source=np.full(robots, -1),
        gated_ns=np.full(robots, NEVER_NS // 2),
        gated_fixes=np.zeros(robots, dtype=np.int64),
        gated_fix_ns=np.full(robots, NEVER_NS // 2),
        noise_inflation=np.zeros(robots),
        drift_ns=np.full((robots, WINDOWS), NEVER_NS // 2),
        drift_transform=np.zeros((robots, WINDOWS, 3)),
        drift_noise=np.zeros((robots, WINDOWS, 3, 3)),
        drift_covariance=np.zeros((robots, WINDOWS, 3, 3)),
        motion_likelihood=np.zeros((robots, LOG_SCALES.size)),
        motion_scale=np.ones(robots),
        motion_explained=np.zeros(robots, dtype=bool),
        excess=np.zeros((robots, 3, 3)),
        repeated=np.zeros((robots, _SOURCES, 2, 3, 3)),
        repeated_at=np.zeros((robots, _SOURCES, 2)),
    )


@inlined_njit
def assess(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    max_fault_score: float,
    distance: float,
    whitened: tuple[float, float],
    cause: int,
) -> int:
    """Update fault scores and evidence by measurement k.

    Args:
        measurements: (m,).
        k: Which one.
        belief: Its integrity is changed.
        max_fault_score: Fault score from which a robot or landmark is contradicted.
        distance: Squared Mahalanobis distance of the position.
        whitened: The innovation over its standard deviation.
        cause: What may explain it, see `cause_of`.

    Returns:
        The robot or landmark (as N + l) that is contradicted; -1: nobody.
    """
    observer, source = measurements.observer[k], source_of(measurements, k, belief)
    if observer < 0 or source < 0:
        return -1
    state, now_ns = belief.integrity, measurements.stamp_ns[k]
    place = find_pair(measurements, k, belief)
    if place < 0:
        place = new_pair(state, observer, source)
    state.source_ns[observer, place] = max(now_ns, state.source_ns[observer, place])
    state.outlier[observer, place] = distance > _OUTLIER
    state.unexplained[observer, place] = cause == KIDNAPPED
    if now_ns - state.counted_ns[observer, place] < AGAIN_NS:
        return -1
    state.counted_ns[observer, place] = now_ns
    weight = min(distance / _OUTLIER, _MAX_WEIGHT) if distance > _OUTLIER else 0.0
    if weight == 0.0:
        weight = weight_of_trend(state, observer, place, whitened, TREND)
    if weight == 0.0:
        if not state.trending[observer, place]:
            _count_inlier(state, observer, source, place)
        return -1
    if not _attribute(state, (observer, source), weight, cause == KIDNAPPED, now_ns):
        state.evidence[observer, place] = min(state.evidence[observer, place] + weight, MAX_EVIDENCE)
    for node in (observer, source):
        if state.fault_score[node] >= max_fault_score:
            if cause != NOISE or not _is_estimated(belief, node) or not inflate_noise(belief, observer):
                return node
            _reset_evidence(state, node)
    return -1


@cached_njit
def _is_estimated(belief: BeliefArrays, node: int) -> bool:
    """Whether the parameters of a robot or the place of a landmark are states already."""
    robots, table = belief.tracked.size, belief.table
    column = table.column[node, CAMERA_YAW] if node < robots else table.survey_column[node - robots]
    estimated: bool = column >= 0
    return estimated


@cached_njit
def _reset_evidence(state: IntegrityArrays, node: int) -> None:
    """Reset the fault score of a robot or landmark, and the evidence against its pairs."""
    state.fault_score[node] = 0.0
    robots, places = state.source.shape
    for robot in range(robots):
        for place in range(places):
            if node in (robot, state.source[robot, place]):
                state.evidence[robot, place] = 0.0


def excluded_pairs(state: IntegrityArrays, now_ns: int) -> list[tuple[int, int]]:
    """The excluded pairs of observer and source among those measured recently."""
    aside = (state.evidence >= EXCLUDED) & (now_ns - state.source_ns < _REPORTED_NS)
    return [(int(observer), int(state.source[observer, place])) for observer, place in np.argwhere(aside)]


@inlined_njit
def is_excluded(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> bool:
    """Whether the pair of measurement k is excluded."""
    observer, place = measurements.observer[k], find_pair(measurements, k, belief)
    aside: bool = place >= 0 and belief.integrity.evidence[observer, place] >= EXCLUDED
    return aside


@inlined_njit
def cause_of(kind: int, innovation: FloatArray, predicted: FloatArray) -> int:
    """Smallest cause that explains an innovation (3,) of a prediction (3,), of the three above."""
    if kind == POLAR:
        distance, along, across = predicted[0], abs(innovation[0]), abs(innovation[1]) * predicted[0]
    else:
        distance = math.hypot(predicted[0], predicted[1])
        along, across = abs(innovation[0]), abs(innovation[1])
    error = math.hypot(along, across)
    if error > _EXPLAINED_M + _EXPLAINED_SHARE * distance:
        return KIDNAPPED
    return DESCRIPTION if error > _NOISE_M else NOISE


@inlined_njit
def small_variances(kind: int, predicted: FloatArray) -> tuple[float, float]:
    """Variances of position errors too small to be outliers: forward or range, left or bearing."""
    distance = predicted[0] if kind == POLAR else math.hypot(predicted[0], predicted[1])
    small = (_SMALL_M + _SMALL_SHARE * abs(distance)) ** 2
    return small, (small / max(distance * distance, 1e-6) if kind == POLAR else small)


@inlined_njit
def is_kidnapped(state: IntegrityArrays, robot: int, within_ns: int = RECENT_NS) -> bool:
    """Whether most recent measurements of a robot can only mean that it is at another place."""
    newest_ns, elsewhere, count = state.source_ns[robot, 0], 0, 0
    for place in range(state.source.shape[1]):
        newest_ns = max(newest_ns, state.source_ns[robot, place])
    for place in range(state.source.shape[1]):
        recent = newest_ns - state.source_ns[robot, place] < within_ns
        is_link = state.source[robot, place] >= state.fault_score.size
        recent = recent and not is_link and state.source[robot, place] >= 0
        if recent and state.evidence[robot, place] < EXCLUDED:
            count += 1
            elsewhere += 1 if state.unexplained[robot, place] else 0
    return 2 * elsewhere > count


@inlined_njit
def is_contradicted(state: IntegrityArrays, robot: int) -> bool:
    """Whether the newest measurements contradict the pose of a robot; it is not tracked then."""
    contradicted: bool = (
        state.fault_score[robot] >= _SUSPECT
        or state.gated_fixes[robot] > 0
        or is_kidnapped(state, robot, _ONE_IMAGE_NS)
        or links_disagree(state, robot)
    )
    return contradicted


@inlined_njit
def _count_inlier(state: IntegrityArrays, observer: int, source: int, place: int) -> None:
    """Lower evidence and fault scores by an inlier."""
    state.evidence[observer, place] = max(0.0, state.evidence[observer, place] - _INLIER_WEIGHT)
    for node in (observer, source):
        state.fault_score[node] = max(0.0, state.fault_score[node] - _INLIER_WEIGHT)


@cached_njit
def _attribute(
    state: IntegrityArrays, pair: tuple[int, int], weight: float, unexplained: bool, now_ns: int
) -> bool:
    """Attribute an outlier to whichever of a pair has the larger share of them; False: to neither."""
    observer, source = pair
    bad_observer, share_observer = _outliers(state, observer, now_ns)
    _, share_source = _outliers(state, source, now_ns)
    if share_observer > 0.5 and share_observer >= share_source:
        if bad_observer >= 2:
            state.fault_score[observer] += weight * (_UNEXPLAINED_WEIGHT if unexplained else 1.0)
        elif state.fault_score[observer] < _MAX_SINGLE_DOUBT:
            state.fault_score[observer] += _SINGLE_WEIGHT * weight
        if share_observer == share_source and state.fault_score[source] < _MAX_SINGLE_DOUBT:
            state.fault_score[source] += _SHARED_WEIGHT * weight
        return True
    if share_source > 0.5:
        state.fault_score[source] += weight
        return True
    return False


@cached_njit
def _outliers(state: IntegrityArrays, node: int, now_ns: int) -> tuple[int, float]:
    """Number and share of outliers among the pairs of a robot or landmark, as observer and as source."""
    robots, places = state.source.shape
    bad, count = 0, 0
    for robot in range(robots):
        named = 0
        for place in range(places):  # most robots have not measured it: a quick check first
            named += state.source[robot, place] == node
        for place in range(places if named or robot == node else 0):
            source = state.source[robot, place]
            about = 0 <= source < state.fault_score.size and node in (robot, source)
            if about and now_ns - state.source_ns[robot, place] < RECENT_NS:
                count += 1
                bad += 1 if state.outlier[robot, place] or state.trending[robot, place] else 0
    return bad, bad / max(1, count)


@inlined_njit
def noise_of_frequent_looks(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> float:
    """Factor on the noise of measurement k that follows closely on another one of its pair."""
    observer, place = measurements.observer[k], find_pair(measurements, k, belief)
    if place < 0:
        return 1.0
    since_ns = measurements.stamp_ns[k] - belief.integrity.source_ns[observer, place]
    return _INDEPENDENT_NS / since_ns if 0 < since_ns < _INDEPENDENT_NS else 1.0
