"""Pairs of observer and source: evidence against each, trends of its innovations, and links without a kernel.

Where measurements of models without a kernel contradict, such as ranges by radio, their link is wrong more
often than one of its ends: a wall between two radios lengthens ranges for seconds. They are evidence against
their pair only, which is counted apart from that of other sensors, and which also inflates their noise.
"""

from __future__ import annotations

import math

from swarm_loc_estimator.common.jit import inlined_njit
from swarm_loc_estimator.filter.belief import NEVER_NS, BeliefArrays, IntegrityArrays
from swarm_loc_estimator.filter.measurement_model import MeasurementColumns, has_kernel

EXCLUDED, MAX_EVIDENCE = 10.0, 15.0  # Evidence from which a pair is excluded, and its maximum
RECENT_NS = 400_000_000
AGAIN_NS = 90_000_000  # A measurement sooner after the last one of its pair is no new evidence
_TREND_LOOKS = 8
TREND = 3.0  # Limit of the squared sum of whitened innovations over their sum of squares; 1 without a trend
_MIN_TREND = 0.6
"""Smallest mean of whitened innovations that counts: trends of calibrated sensors lie below their noise."""
_TREND_WEIGHT = 4.0
_LINK_MAX_WEIGHT, _LINK_INLIER_WEIGHT = 2.0, 1.0
"""Largest weight of an outlier of a link, and decrease by an inlier: only outliers in a row exclude it."""
_LINK_TREND = 5.0
"""`TREND` of links, of which one component is measured: one good link in a hundred exceeds it."""


@inlined_njit
def assess_link(
    measurements: MeasurementColumns, k: int, belief: BeliefArrays, distance: float, whitened: float
) -> float:
    """Update the evidence against the pair of measurement k of a model without a kernel.

    Outliers exclude the pair. A trend only inflates its noise: a bias that the description lacks would
    exclude all pairs.

    Args:
        measurements: (m,).
        k: Which one.
        belief: Its integrity is changed.
        distance: Squared Mahalanobis distance of its gated components.
        whitened: First component of the innovation over its standard deviation.

    Returns:
        Factor on its noise.
    """
    observer, source = measurements.observer[k], source_of(measurements, k, belief)
    if observer < 0 or not math.isfinite(distance):
        return 1.0
    state, now_ns = belief.integrity, measurements.stamp_ns[k]
    place = find_pair(measurements, k, belief)
    if place < 0:
        place = new_pair(state, observer, source)
    state.source_ns[observer, place] = max(now_ns, state.source_ns[observer, place])
    state.outlier[observer, place] = distance > measurements.gate[k]
    evidence: float = state.evidence[observer, place]
    if now_ns - state.counted_ns[observer, place] < AGAIN_NS:
        return 1.0 + evidence
    state.counted_ns[observer, place] = now_ns
    if distance > measurements.gate[k]:
        evidence = min(evidence + min(distance / measurements.gate[k], _LINK_MAX_WEIGHT), MAX_EVIDENCE)
    elif weight_of_trend(state, observer, place, (whitened, 0.0), _LINK_TREND) > 0.0:
        evidence = max(evidence, min(evidence + _TREND_WEIGHT, EXCLUDED - 1.0))
    elif not state.trending[observer, place]:
        evidence = max(0.0, evidence - _LINK_INLIER_WEIGHT)
    state.evidence[observer, place] = evidence
    return 1.0 + evidence


@inlined_njit
def links_disagree(state: IntegrityArrays, robot: int) -> bool:
    """Whether at least half of the newest measurements of a robot's own links are outliers, and two."""
    newest_ns, bad, count = NEVER_NS // 2, 0, 0
    for place in range(state.source.shape[1]):
        if state.source[robot, place] >= state.fault_score.size:
            newest_ns = max(newest_ns, state.source_ns[robot, place])
    for place in range(state.source.shape[1]):
        is_link = state.source[robot, place] >= state.fault_score.size
        if is_link and newest_ns - state.source_ns[robot, place] < RECENT_NS:
            count += 1
            bad += 1 if state.outlier[robot, place] else 0
    return bad >= 2 and 2 * bad >= count


@inlined_njit
def weight_of_trend(
    state: IntegrityArrays, observer: int, place: int, whitened: tuple[float, float], limit: float
) -> float:
    """Add a whitened innovation (2,) to the sum of its pair; return the weight of a trend, 0 without one."""
    total = state.whitened[observer, place]
    for i in range(2):
        total[i] += whitened[i]
        state.squares[observer, place] += whitened[i] * whitened[i]
    state.looks[observer, place] += 1
    if state.looks[observer, place] < _TREND_LOOKS:
        return 0.0
    squared = total[0] * total[0] + total[1] * total[1]
    trending = squared > max(limit * state.squares[observer, place], (_MIN_TREND * _TREND_LOOKS) ** 2)
    forget_trend(state, observer, place)
    state.trending[observer, place] = trending
    return _TREND_WEIGHT if trending else 0.0


@inlined_njit
def forget_trend(state: IntegrityArrays, observer: int, place: int) -> None:
    """Begin to look for a trend from the next innovation on."""
    state.whitened[observer, place, 0] = state.whitened[observer, place, 1] = 0.0
    state.squares[observer, place], state.looks[observer, place] = 0.0, 0


@inlined_njit
def find_pair(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> int:
    """The slot of the pair of measurement k; -1: it has none, or it is no pair."""
    observer, source = measurements.observer[k], source_of(measurements, k, belief)
    if observer >= 0 and source >= 0:
        sources = belief.integrity.source[observer]
        for place in range(sources.size):
            if sources[place] == source:
                return place
    return -1


@inlined_njit
def new_pair(state: IntegrityArrays, observer: int, source: int) -> int:
    """Give a new pair the slot of the one measured longest ago."""
    oldest = 0
    for place in range(state.source.shape[1]):
        if state.source_ns[observer, place] < state.source_ns[observer, oldest]:
            oldest = place
    state.source[observer, oldest], state.source_ns[observer, oldest] = source, NEVER_NS // 2
    state.counted_ns[observer, oldest] = NEVER_NS // 2
    state.evidence[observer, oldest] = 0.0
    state.outlier[observer, oldest] = state.trending[observer, oldest] = False
    forget_trend(state, observer, oldest)
    for side in range(2):
        for i in range(3):
            for j in range(3):
                state.repeated[observer, oldest, side, i, j] = 0.0
    return oldest


@inlined_njit
def source_of(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> int:
    """The source of measurement k: a robot, N + l for landmark l, or -1.

    N + L more for a model without a kernel.
    """
    landmark: int = measurements.landmark[k] - 1
    target: int = measurements.target[k]
    source = belief.tracked.size + landmark if landmark >= 0 else target
    is_link = source >= 0 and not has_kernel(measurements, k)
    return source + belief.integrity.fault_score.size if is_link else source
