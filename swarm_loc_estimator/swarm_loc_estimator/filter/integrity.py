"""Integrity: which measurements are wrong, whose fault that is, and when a robot is lost.

**Faults.** A measurement is an outlier when the squared Mahalanobis distance of its position exceeds a
threshold that one good measurement in twenty exceeds, or when the whitened innovations of its last few have a
trend. An outlier raises the fault score of whichever of observer and source has the larger share of outliers
among its pairs. A robot whose camera was turned disagrees with all that it sees; a landmark that was moved
disagrees with all that see it. Either is contradicted once its fault score reaches a limit. If both agree
with others, the outlier is evidence against the pair alone, and the pair is excluded. Inliers lower scores
and evidence.

**Links.** Where measurements of models without a kernel contradict, such as ranges by radio, their link is
wrong more often than one of its ends: a wall between two radios lengthens ranges for seconds. They are
evidence against their pair only, which is counted apart from that of other sensors, and which also inflates
their noise.

**Noise inflation.** A robot whose measurements still contradict the estimate although all its parameters are
states has more noise than described: its markers are mounted inexactly, its images are stamped inexactly.
Each time its measurements are contradicted, their noise grows by one unit.

**Loss.** An assumed pose is confirmed by measurements that agree, or refuted. A robot is lost that is too
uncertain, or with too many gated measurements in a row.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.filter.measurements import LossReason, Measurements
from swarm_loc_estimator.filter.models import POLAR, has_kernel
from swarm_loc_estimator.filter.state import NEVER_NS, BeliefArrays, IntegrityArrays, covariance_within
from swarm_loc_estimator.swarm.calibration_states import CAMERA_YAW
from swarm_loc_estimator.swarm.error_models import SensorModel

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
    measurements: Measurements, k: int, belief: BeliefArrays, distance: float, whitened: float
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
def find_pair(measurements: Measurements, k: int, belief: BeliefArrays) -> int:
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
def source_of(measurements: Measurements, k: int, belief: BeliefArrays) -> int:
    """The source of measurement k: a robot, N + l for landmark l, or -1.

    N + L more for a model without a kernel.
    """
    landmark: int = measurements.landmark[k]
    target: int = measurements.target[k]
    source = belief.tracked.size + landmark if landmark >= 0 else target
    is_link = source >= 0 and not has_kernel(measurements, k)
    return source + belief.integrity.fault_score.size if is_link else source


_POSITION_SIGMA, _BEARING_SIGMA, _HEADING_SIGMA, _STAMP_SIGMA = 0.004, 0.01, 0.03, 0.03
"""One unit of inflation [m], [rad], [rad], [s]."""
MAX_UNITS = 5.0


@inlined_njit
def stamp_variance(measurements: Measurements, k: int, belief: BeliefArrays) -> float:
    """Variance of the stamp of measurement k, as described and with inflation [s^2]."""
    variance: float = measurements.stamp_variance[k]
    observer = measurements.observer[k]
    if observer >= 0:
        variance += (belief.integrity.noise_inflation[observer] * _STAMP_SIGMA) ** 2
    return variance


@inlined_njit
def add_noise_inflation(measurements: Measurements, k: int, belief: BeliefArrays, noise: FloatArray) -> None:
    """Add the noise inflation of its observer to the noise (3, 3) of measurement k."""
    observer = measurements.observer[k]
    units = belief.integrity.noise_inflation[observer] if observer >= 0 else 0.0
    if units > 0.0:
        noise[0, 0] += (units * _POSITION_SIGMA) ** 2
        noise[1, 1] += (units * (_BEARING_SIGMA if measurements.model[k] == POLAR else _POSITION_SIGMA)) ** 2
        noise[2, 2] += (units * _HEADING_SIGMA) ** 2


@cached_njit
def inflate_noise(belief: BeliefArrays, observer: int) -> bool:
    """Inflate the noise of an observer by one unit; False: it is at its maximum."""
    units = belief.integrity.noise_inflation[observer]
    belief.integrity.noise_inflation[observer] = min(units + 1.0, MAX_UNITS)
    raised: bool = units < MAX_UNITS
    return raised


def with_noise_inflation(sensor: SensorModel, units: float) -> SensorModel:
    """A sensor model with the noise inflation included."""
    unit_of = {
        "forward_sigma": _POSITION_SIGMA,
        "left_sigma": _POSITION_SIGMA,
        "heading_sigma": _HEADING_SIGMA,
        "range_sigma": _POSITION_SIGMA,
        "bearing_sigma": _BEARING_SIGMA,
        "residual_position_sigma": _POSITION_SIGMA,
        "residual_heading_sigma": _HEADING_SIGMA,
        "time_sigma_s": _STAMP_SIGMA,
    }
    return replace(
        sensor, **{name: math.hypot(getattr(sensor, name), units * unit) for name, unit in unit_of.items()}
    )


_SUSPECT = 7.5  # Fault score from which a robot is not reported as tracked

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


@inlined_njit
def assess(
    measurements: Measurements,
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
def is_excluded(measurements: Measurements, k: int, belief: BeliefArrays) -> bool:
    """Whether the pair of measurement k is excluded."""
    observer, place = measurements.observer[k], find_pair(measurements, k, belief)
    aside: bool = place >= 0 and belief.integrity.evidence[observer, place] >= EXCLUDED
    return aside


@inlined_njit
def cause_of(model: int, innovation: FloatArray, predicted: FloatArray) -> int:
    """Smallest cause that explains an innovation (3,) of a prediction (3,), of the three above."""
    if model == POLAR:
        distance, along, across = predicted[0], abs(innovation[0]), abs(innovation[1]) * predicted[0]
    else:
        distance = math.hypot(predicted[0], predicted[1])
        along, across = abs(innovation[0]), abs(innovation[1])
    error = math.hypot(along, across)
    if error > _EXPLAINED_M + _EXPLAINED_SHARE * distance:
        return KIDNAPPED
    return DESCRIPTION if error > _NOISE_M else NOISE


@inlined_njit
def small_variances(model: int, predicted: FloatArray) -> tuple[float, float]:
    """Variances of position errors too small to be outliers: forward or range, left or bearing."""
    distance = predicted[0] if model == POLAR else math.hypot(predicted[0], predicted[1])
    small = (_SMALL_M + _SMALL_SHARE * abs(distance)) ** 2
    return small, (small / max(distance * distance, 1e-6) if model == POLAR else small)


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
def noise_of_frequent_looks(measurements: Measurements, k: int, belief: BeliefArrays) -> float:
    """Factor on the noise of measurement k that follows closely on another one of its pair."""
    observer, place = measurements.observer[k], find_pair(measurements, k, belief)
    if place < 0:
        return 1.0
    since_ns = measurements.stamp_ns[k] - belief.integrity.source_ns[observer, place]
    return _INDEPENDENT_NS / since_ns if 0 < since_ns < _INDEPENDENT_NS else 1.0


_GATED, _OFF_FIXES = int(LossReason.GATED), int(LossReason.OFF_FIXES)
CONFIRMED = 2  # Number of agreeing sightings after which an assumed pose counts as known
WELL_CONFIRMED = 12
_SUSPECT_SCORE = 2.0
_SUSPECT_SIGMA = (0.03, 0.03, 0.06)
"""Standard deviations added while a pose is suspect or little confirmed: x [m], y [m], heading [rad]."""
_SEEN_RELIEF = 1.0
"""Decrease of the fault score by a detection from above, which depends on no other estimate."""
_GATED_AGAIN_NS = 250_000_000
_MAX_GATED_FIXES = 3
"""Gated fixes after which a robot is re-initialized from its fixes, whatever other robots measure of it."""
_CONFIRMED_AGAIN_NS = 150_000_000
"""Sightings within this time count as one confirmation, because their errors are correlated."""
_SHARE_OF_HEADING, _SHARE_OF_DRIVER = 0.5, 0.1
"""Share of a position's variance by the heading from which its error lies on an arc, and that of a robot with
odometry: its earlier headings, which the present one does not tell, have moved it, too."""


class LossLimits(NamedTuple):
    """Limits beyond which a robot is lost."""

    position_sigma: float  # Standard deviation of its position [m]
    heading_sigma: float  # Of its heading [rad]
    gated_in_a_row: int  # Gated measurements since the last accepted one
    max_fault_score: float  # Fault score from which a robot or landmark is contradicted


@inlined_njit
def confirm(measurements: Measurements, k: int, belief: BeliefArrays, accepted: bool) -> int:
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
def is_uncertain(
    belief: BeliefArrays, robot: int, pose: FloatArray, limits: LossLimits, drives: bool, by_axes: bool
) -> bool:
    """Whether the robot at `pose` (3,) is too uncertain for a measurement.

    So is a position beyond its limit, and one that depends on an uncertain heading. An uncertain heading
    alone is not, unless the robot measures along its axes (`by_axes`), which is not linear in the heading.
    """
    first = 3 * robot
    xx, yy = covariance_within(belief, first, 0, 0), covariance_within(belief, first, 1, 1)
    xt, yt = covariance_within(belief, first, 0, 2), covariance_within(belief, first, 1, 2)
    tt = covariance_within(belief, first, 2, 2)
    x = xx - 2.0 * pose[1] * xt + pose[1] * pose[1] * tt
    y = yy + 2.0 * pose[0] * yt + pose[0] * pose[0] * tt
    uncertain: bool = max(x, y) > limits.position_sigma**2
    if tt > limits.heading_sigma**2:
        sideways = (xt - pose[1] * tt, yt + pose[0] * tt)
        uncertain = uncertain or by_axes or depends_on_heading(x + y, sideways, tt, drives)
    return uncertain


@inlined_njit
def depends_on_heading(position: float, sideways: tuple[float, float], heading: float, drives: bool) -> bool:
    """Whether much of a position's variance stems from the heading, so that its error lies on an arc.

    Args:
        position: Variance of x plus that of y [m^2].
        sideways: Covariances of x and of y with the heading [m rad].
        heading: Variance of the heading [rad^2].
        drives: Whether the robot has odometry.
    """
    share = _SHARE_OF_DRIVER if drives else _SHARE_OF_HEADING
    depends: bool = sideways[0] ** 2 + sideways[1] ** 2 > share * position * heading
    return depends


@inlined_njit
def inflate_suspect_covariance(state: IntegrityArrays, robot: int, covariance: FloatArray) -> None:
    """Inflate the covariance (3, 3) of a pose that is suspect or little confirmed."""
    if state.fault_score[robot] > _SUSPECT_SCORE or state.confirmations[robot] < WELL_CONFIRMED:
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
    measurements: Measurements, k: int, belief: BeliefArrays, accepted: bool, limits: LossLimits
) -> tuple[int, int]:
    """Count fixes and gated measurements; return a robot that is lost by too many in a row, or -1, and why.

    One source alone counts at most four times a second.
    """
    observer, target = measurements.observer[k], measurements.target[k]
    lost, why, state = -1, 0, belief.integrity
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
                lost, why = side, _GATED
    if observer < 0 and not accepted and _is_off_its_fixes(state, target, measurements.stamp_ns[k]):
        lost, why = target, _OFF_FIXES
    if accepted and (observer < 0 or target < 0):
        fixed = max(observer, target)
        state.gated_fixes[fixed] = 0
        belief.last_fix_ns[fixed] = max(belief.last_fix_ns[fixed], measurements.stamp_ns[k])
    return lost, why


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
