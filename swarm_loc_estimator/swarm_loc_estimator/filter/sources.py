"""Sources: what can be wrong as one, and how much is believed of each.

A source is a robot (its wheels, its camera, its marker), a landmark, an anchor, a fixed camera, the absolute
fixes of a robot, or the direction of the marker of a robot. A link is what a robot and another source
measured of each other. Four rules hold for all:

**Floor.** No message makes the noise of a measurement smaller than the description allows (`sensors/`).

**Rate.** Measurements of a link within its correlation time share their error: each counts by its share of
that time, as information, as evidence, as confirmation and towards a loss. A repeated range counts once.

**Systematic.** What errs in the same way again is a state (`swarm/calibration_states.py`), or is considered
in the reported covariance (`correlated_noise.py`).

**Health.** A measurement is an outlier when the squared Mahalanobis distance of its position exceeds a
threshold that one good measurement in twenty exceeds; a mean of whitened innovations tells of a drift. Both
raise the fault score of that end of the link of which the larger share of links is bad; of equal shares, of
the end with more of them. A robot whose camera was turned disagrees with all that it sees, a landmark that
was moved with all that see it, a fixed camera that was moved with all that it sees. If both ends agree with
others, the outlier is evidence against the link alone, which is excluded. What agrees lowers scores and
evidence. A robot that has no other link agrees with a camera wherever that is.

From a fault score on, a source is contradicted: the parameters of a robot and the place of a landmark or
camera are opened; fixes and the direction of a marker are not used until they agree again, nor is a camera
that is contradicted again. Radios are wrong in pairs, since a wall lengthens ranges: they are evidence
against their link only, whose noise it raises.

A pose that was assumed is confirmed by measurements that agree, or refuted. A robot is lost that is too
uncertain, off its fixes, or with too many gated measurements in a row.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.jit import inlined_njit, norefcount_njit
from swarm_loc_estimator.filter.measurements import LossReason, Measurements
from swarm_loc_estimator.filter.models import POLAR, has_kernel
from swarm_loc_estimator.filter.state import NEVER_NS, BeliefArrays, SourceArrays, covariance_within

# Rate
CORRELATION_NS = 100_000_000  # Errors of a link within this time are the same
LEAST_SHARE = 1e-3
RANGE_VALUE, RANGE_DEVIATION = 0, 6
"""What `last_look` has of a link of radios: the newest range, and by how many sigmas it deviated."""
# Health; tuned on the scenarios of bench/integrity
EXCLUDED, _MAX_EVIDENCE = 10.0, 15.0  # Evidence from which a link is excluded, and its maximum
_OUTLIER = 6.0
_MAX_WEIGHT, _MAX_LINK_WEIGHT, _DRIFT_WEIGHT, RELIEF = 3.5, 2.0, 0.5, 0.25
"""Largest weights of an outlier and one of radios, weight of a drift, and decrease by what agrees."""
_FORGETTING, _DRIFT = 0.125, 0.6
"""Weight of the newest in the mean of whitened innovations, and the mean from which they drift."""
SUSPECT, WELL_CONFIRMED = 7.5, 12.0
"""Fault score from which a robot is not tracked, and confirmations up to which its covariance is widened."""
_SUSPECT_SIGMA = (0.03, 0.03, 0.06)
"""Standard deviations added while a pose is suspect or little confirmed: x [m], y [m], heading [rad]."""

DOUBTED_SHARE = 0.33  # Share of bad links from which a description is contradicted as a whole
LINK, UNDECIDED = -1, -2  # Who is wrong if no source is
RECENT_NS, _ONE_IMAGE_NS = 400_000_000, 20_000_000
_TIED_NS = 5_000_000_000  # A measurement that agreed so long ago still speaks for a pose
CONFIRMED = 2.0  # Confirmations from which an assumed pose counts as known
AGREES, DRIFTS, DEVIATES, ELSEWHERE = range(4)
"""Findings of the newest measurement of a link; an outlier that no wrong description explains: ELSEWHERE."""
_EXPLAINED_M, _EXPLAINED_SHARE = 0.1, 0.35
"""Error that a wrong description can explain: a constant, and a share of the distance."""
_SMALL_M, _SMALL_SHARE = 0.003, 0.005
"""Errors up to this constant and share of the distance are inliers whatever the noise is."""
_REPORTED_NS = 3_000_000_000
OCCUPIED_M = 0.02  # Two robots cannot be nearer [m]

_SHARE_OF_HEADING, _SHARE_OF_DRIVER = 0.5, 0.1
"""Share of a position's variance by the heading from which its error lies on an arc, and that of a robot with
odometry: its earlier headings, which the present one does not tell, have moved it, too."""


class LossLimits(NamedTuple):
    """Limits beyond which a robot is lost."""

    position_sigma: float  # Standard deviation of its position [m]
    heading_sigma: float  # Of its heading [rad]
    gated_in_a_row: int  # Gated measurements since the last accepted one
    max_fault_score: float  # Fault score from which a source is contradicted


@inlined_njit
def robot_of(measurements: Measurements, k: int) -> int:
    """The robot that has the link of measurement k: the observer, else the target; -1: none."""
    observer: int = measurements.observer[k]
    target: int = measurements.target[k]
    return observer if observer >= 0 else target


@inlined_njit
def source_of(measurements: Measurements, k: int, belief: BeliefArrays) -> int:
    """The source that measurement k links to `robot_of` it; -1: none.

    Robots are 0 to N - 1, what was surveyed follows, then the fixes of each robot, then the directions of
    their markers. A link without compiled kernel, such as that of two radios, has the number of all sources
    more, and no other links.
    """
    robots, sources = belief.tracked.size, belief.sources.score.size
    surveyed: int = max(measurements.landmark[k], measurements.mount[k])
    source: int = measurements.target[k]
    if surveyed >= 0:
        source = robots + surveyed
    elif measurements.observer[k] < 0:
        source = fixes_of(belief, source)
    return source if has_kernel(measurements, k) or source < 0 else source + sources


@inlined_njit
def fixes_of(belief: BeliefArrays, robot: int) -> int:
    """The source of the absolute fixes of a robot."""
    number: int = belief.tracked.size + belief.landmark.shape[0] + robot
    return number


@inlined_njit
def direction_of(belief: BeliefArrays, robot: int) -> int:
    """The source of the direction of a robot's marker."""
    number: int = 2 * belief.tracked.size + belief.landmark.shape[0] + robot
    return number


@inlined_njit
def is_fix(measurements: Measurements, k: int) -> bool:
    """Whether measurement k is an absolute fix, not the sighting of a fixed camera."""
    fix: bool = measurements.observer[k] < 0 and measurements.mount[k] < 0 and has_kernel(measurements, k)
    return fix


@inlined_njit
def find_link(measurements: Measurements, k: int, belief: BeliefArrays) -> int:
    """The place of the link of measurement k in the row of its robot; -1: it has none."""
    robot, source = robot_of(measurements, k), source_of(measurements, k, belief)
    if robot >= 0 and source >= 0:
        sources = belief.sources.source[robot]
        for place in range(sources.size):
            if sources[place] == source:
                return place
    return -1


@inlined_njit
def new_link(state: SourceArrays, robot: int, source: int) -> int:
    """Give a new link the place of the one measured longest ago."""
    oldest = 0
    for place in range(state.source.shape[1]):
        if state.seen_ns[robot, place] < state.seen_ns[robot, oldest]:
            oldest = place
    state.source[robot, oldest], state.seen_ns[robot, oldest] = source, NEVER_NS // 2 + 1
    state.finding[robot, oldest], state.evidence[robot, oldest] = AGREES, 0.0
    state.drift[robot, oldest].fill(0.0)
    state.last_look[robot, oldest].fill(math.nan)
    return oldest


@inlined_njit
def share_of(measurements: Measurements, k: int, belief: BeliefArrays) -> float:
    """By how much measurement k counts: its part of the correlation time since the last one of its link."""
    place = find_link(measurements, k, belief)
    if place < 0:
        return 1.0
    since_ns = measurements.stamp_ns[k] - belief.sources.seen_ns[robot_of(measurements, k), place]
    last = belief.sources.last_look[robot_of(measurements, k), place]
    if measurements.value[k, 0] == last[RANGE_VALUE] and not has_kernel(measurements, k):
        return LEAST_SHARE
    if since_ns == 0:  # two markers of one picture are two measurements, two fixes are not
        return LEAST_SHARE if is_fix(measurements, k) else 1.0
    if since_ns < 0:
        return 1.0
    share: float = max(min(1.0, since_ns / CORRELATION_NS), LEAST_SHARE)
    return share


@inlined_njit
def small_variances(measurements: Measurements, k: int, predicted: FloatArray) -> tuple[float, float]:
    """Variances of position errors too small to be outliers: forward or range, left or bearing."""
    polar, distance = measurements.model[k] == POLAR, predicted[0]
    if not polar:
        distance = 0.0 if is_fix(measurements, k) else math.hypot(predicted[0], predicted[1])
    small = (_SMALL_M + _SMALL_SHARE * abs(distance)) ** 2
    return small, (small / max(distance * distance, 1e-6) if polar else small)


@inlined_njit
def is_elsewhere(measurements: Measurements, k: int, innovation: FloatArray, predicted: FloatArray) -> bool:
    """Whether no wrong description explains an innovation (3,) of a prediction (3,)."""
    if measurements.model[k] == POLAR:
        distance, along, across = predicted[0], abs(innovation[0]), abs(innovation[1]) * predicted[0]
    else:
        distance = 0.0 if is_fix(measurements, k) else math.hypot(predicted[0], predicted[1])
        along, across = abs(innovation[0]), abs(innovation[1])
    elsewhere: bool = math.hypot(along, across) > _EXPLAINED_M + _EXPLAINED_SHARE * distance
    return elsewhere


@inlined_njit
def assess(
    measurements: Measurements,
    k: int,
    belief: BeliefArrays,
    max_fault_score: float,
    distance: float,
    whitened: tuple[float, float],
    share: float,
    elsewhere: bool,
) -> int:
    """Update the link of measurement k, fault scores and evidence.

    Of the gated components, `distance` is the squared Mahalanobis distance and `whitened` the innovation over
    its standard deviation. The measurement counts by its share, see `share_of`; `elsewhere`: no wrong
    description explains it.

    Returns:
        The robot, or N + l, that is contradicted now and is to be opened; -1: nobody.
    """
    robot, source, state = robot_of(measurements, k), source_of(measurements, k, belief), belief.sources
    if robot < 0 or source < 0 or not math.isfinite(distance):
        return -1
    place, is_link = find_link(measurements, k, belief), not has_kernel(measurements, k)
    if place < 0:
        place = new_link(state, robot, source)
    now_ns = measurements.stamp_ns[k]
    state.seen_ns[robot, place] = max(now_ns, state.seen_ns[robot, place])
    # What does it say? Outliers of fixes and radios are those that are gated; what repeats its errors drifts.
    most = _MAX_LINK_WEIGHT if is_link else _MAX_WEIGHT
    limit = measurements.gate[k] if is_link or is_fix(measurements, k) else _OUTLIER
    drift, weight = state.drift[robot, place], share
    if is_link:  # of one component; the other is the share of repeated values
        state.last_look[robot, place, RANGE_DEVIATION] = whitened[0]
        if distance <= limit:  # an outlier, which may be as large as any, tells of no drift
            drift[0] += _FORGETTING * share * (whitened[0] - drift[0])
        drift[1] += _FORGETTING * ((1.0 if share == LEAST_SHARE else 0.0) - drift[1])
    else:
        for i in range(2):
            drift[i] += _FORGETTING * share * (whitened[i] - drift[i])
    repeats = is_link or measurements.systematic_share[k, 0] > 0.0
    mean = drift[0] * drift[0] + (0.0 if is_link else drift[1] * drift[1])
    # A mean far from zero is no drift of scans in a map, which show errors of earlier scans that saw other
    # walls (late ones are found by their delay, see `sensors/lidar.py`), nor of fixes that are suspended
    # while nothing else ties their robot, whose own error lasts.
    suspended = is_suspended(belief, source, 1.5 * max_fault_score) and not _is_tied(belief, robot, now_ns)
    stays = is_fix(measurements, k) and (measurements.has_second[k] or suspended)
    if distance > limit:
        state.finding[robot, place] = ELSEWHERE if elsewhere else DEVIATES
        weight *= min(distance / limit, most)
    elif mean > ((2.0 if repeats else 1.0) * _DRIFT) ** 2 and not stays:
        state.finding[robot, place] = DRIFTS
        weight *= _DRIFT_WEIGHT
    else:
        state.finding[robot, place] = AGREES
        _relieve(belief, robot, place, share * (4.0 * RELIEF if is_link else RELIEF), now_ns)
        return -1
    # Who is wrong: one of the ends, or the link alone?
    guilty = LINK if is_link else _guilty(belief, robot, source, now_ns)
    if guilty == UNDECIDED:
        return -1
    if guilty == LINK:
        most = EXCLUDED - 1.0 if is_link and state.finding[robot, place] == DRIFTS else _MAX_EVIDENCE
        most = max(most, state.evidence[robot, place])
        state.evidence[robot, place] = min(state.evidence[robot, place] + weight, most)
        return -1
    other = _as_good(belief, robot, guilty, now_ns)
    if other >= 0:
        state.score[other] = min(state.score[other] + weight, 2.0 * max_fault_score)
    was_suspended = state.score[guilty] >= max_fault_score
    state.score[guilty] = min(state.score[guilty] + weight, 2.0 * max_fault_score)
    if was_suspended or state.score[guilty] < max_fault_score or guilty >= fixes_of(belief, 0):
        return -1
    return guilty if guilty >= belief.tracked.size else _instead(belief, guilty, max_fault_score, now_ns)


@norefcount_njit
def _as_good(belief: BeliefArrays, robot: int, guilty: int, now_ns: int) -> int:
    """The camera that contradicts a guilty one about a robot, as long as others agree with that; -1: none."""
    state, rival, agreeing = belief.sources, -1, 0
    if not _sees_robots(belief, guilty):
        return -1
    for place in range(state.source.shape[1]):
        source = state.source[robot, place]
        if source >= 0 and source != guilty and now_ns - state.seen_ns[robot, place] < RECENT_NS:
            if rival >= 0 or not _sees_robots(belief, source):
                return -1
            rival = source
    for row in range(belief.tracked.size):
        for place in range(state.source.shape[1]):
            recent = state.source[row, place] == guilty and now_ns - state.seen_ns[row, place] < RECENT_NS
            agreeing += 1 if recent and state.finding[row, place] == AGREES else 0
    return rival if agreeing > 0 else -1


@inlined_njit
def assess_direction(belief: BeliefArrays, robot: int, misread: bool, share: float, limit: float) -> None:
    """Update the fault score of the direction of a robot's marker by a measurement from outside."""
    direction, score = direction_of(belief, robot), belief.sources.score
    change = share if misread else -share * RELIEF
    score[direction] = min(max(0.0, score[direction] + change), 2.0 * limit)


@norefcount_njit
def _instead(belief: BeliefArrays, robot: int, max_fault_score: float, now_ns: int) -> int:
    """Suspend the fixes of a contradicted robot in its place; return the robot if it has none."""
    state, fixes = belief.sources, fixes_of(belief, robot)
    for place in range(state.source.shape[1]):
        if state.source[robot, place] == fixes and now_ns - state.seen_ns[robot, place] < RECENT_NS:
            if state.score[fixes] >= max_fault_score:
                return robot
            state.score[fixes], state.score[robot] = 2.0 * max_fault_score, 0.0
            return -1
    return robot


@norefcount_njit
def _relieve(belief: BeliefArrays, robot: int, place: int, relief: float, now_ns: int) -> None:
    """Lower evidence and fault scores by what agrees; of a suspect camera if others locate the robot, too."""
    state, others = belief.sources, 0
    source = state.source[robot, place]
    state.evidence[robot, place] = max(0.0, state.evidence[robot, place] - relief)
    if source >= state.score.size:
        return
    for other in range(state.source.shape[1]):
        recent = now_ns - state.seen_ns[robot, other] < RECENT_NS and other != place
        others += 1 if recent and state.finding[robot, other] == AGREES else 0
    state.score[robot] = max(0.0, state.score[robot] - relief)
    if others > 0 or not _sees_robots(belief, source) or state.score[source] < SUSPECT:
        state.score[source] = max(0.0, state.score[source] - relief)


@norefcount_njit
def _guilty(belief: BeliefArrays, robot: int, source: int, now_ns: int) -> int:
    """That end of a bad link of which more links are bad; LINK: neither; UNDECIDED."""
    bad_robot, share_robot = _bad_links(belief, robot, now_ns)
    bad_source, share_source = _bad_links(belief, source, now_ns)
    if max(share_robot, share_source) <= 0.5:
        return LINK
    outer = source >= belief.tracked.size + belief.table.first_camera
    if outer and share_robot == share_source and (bad_source >= 2 or bad_source >= bad_robot):
        return source  # many robots do not move at once, but a camera may
    if share_robot >= share_source:
        return robot if bad_robot >= 2 else UNDECIDED
    return source


@inlined_njit
def _sees_robots(belief: BeliefArrays, source: int) -> bool:
    """Whether a source is a fixed camera."""
    sees: bool = belief.tracked.size + belief.table.first_camera <= source < fixes_of(belief, 0)
    return sees


@norefcount_njit
def _bad_links(belief: BeliefArrays, node: int, now_ns: int) -> tuple[int, float]:
    """Number and share of bad links of a source; a robot with no other link agrees with a camera anywhere."""
    state, robots = belief.sources, belief.tracked.size
    bad, count = 0, 0
    for row in range(robots):
        named = 1 if row == node else 0
        for place in range(state.source.shape[1]):  # most robots have no link to it: a quick check first
            named += state.source[row, place] == node
        if not named:
            continue
        own = 0
        for place in range(state.source.shape[1]):
            about = 0 <= state.source[row, place] < state.score.size
            own += 1 if about and now_ns - state.seen_ns[row, place] < RECENT_NS else 0
        for place in range(state.source.shape[1]):
            other = state.source[row, place]
            about = 0 <= other < state.score.size and node in (row, other)
            if about and now_ns - state.seen_ns[row, place] < RECENT_NS:
                is_bad = state.finding[row, place] != AGREES
                bad += 1 if is_bad else 0
                count += 1 if is_bad or own > 1 or node < robots + belief.table.first_camera else 0
    return bad, bad / max(1, count)


@inlined_njit
def is_suspended(belief: BeliefArrays, source: int, max_fault_score: float) -> bool:
    """Whether a source is not used: fixes, directions or a fixed camera that the rest contradicts."""
    score = belief.sources.score
    return bool(belief.tracked.size <= source < score.size and score[source] >= max_fault_score)


@inlined_njit
def is_excluded(measurements: Measurements, k: int, belief: BeliefArrays, max_fault_score: float) -> bool:
    """Whether the link of measurement k, or its source, is not used."""
    place = find_link(measurements, k, belief)
    aside: bool = place >= 0 and belief.sources.evidence[robot_of(measurements, k), place] >= EXCLUDED
    return aside or is_suspended(belief, source_of(measurements, k, belief), max_fault_score)


def bad_share(state: SourceArrays, now_ns: int) -> float:
    """Share of bad links among all that were measured recently, except radios'."""
    recent = (state.source >= 0) & (state.source < state.score.size) & (now_ns - state.seen_ns < RECENT_NS)
    return float(np.sum(recent & (state.finding != AGREES)) / max(1, np.sum(recent)))


def repeating_robots(state: SourceArrays, now_ns: int) -> BoolArray:
    """Robots (N,) with a radio whose newest values are more often repeated than new."""
    is_link = state.source >= state.score.size
    repeats = is_link & (state.drift[..., 1] > 0.5) & (now_ns - state.seen_ns < _REPORTED_NS)
    return np.asarray(repeats.any(axis=1))


def excluded_links(state: SourceArrays, now_ns: int) -> list[tuple[int, int]]:
    """The excluded links, as robot and source, among those measured recently."""
    aside = (state.evidence >= EXCLUDED) & (now_ns - state.seen_ns < _REPORTED_NS)
    return [(int(robot), int(state.source[robot, place])) for robot, place in np.argwhere(aside)]


@inlined_njit
def is_kidnapped(state: SourceArrays, robot: int, within_ns: int = RECENT_NS) -> bool:
    """Whether most recent measurements of a robot can only mean that it is at another place."""
    newest_ns, elsewhere, count = NEVER_NS // 2, 0, 0
    for place in range(state.source.shape[1]):
        newest_ns = max(newest_ns, state.seen_ns[robot, place])
    for place in range(state.source.shape[1]):
        recent = 0 <= state.source[robot, place] < state.score.size
        recent = recent and newest_ns - state.seen_ns[robot, place] < within_ns
        if recent and state.evidence[robot, place] < EXCLUDED:
            count += 1
            elsewhere += 1 if state.finding[robot, place] == ELSEWHERE else 0
    return 2 * elsewhere > count


@inlined_njit
def is_contradicted(belief: BeliefArrays, robot: int) -> bool:
    """Whether the newest measurements contradict the pose of a robot; it is not tracked then.

    They do where at least half of its links deny it: links that are excluded or with a suspect source, fixes
    that deviate, radios that have deviated more than once; or where its newest image says that it is
    elsewhere.
    """
    state, newest_ns, denied, count = belief.sources, NEVER_NS // 2, 0, 0
    if state.score[robot] >= SUSPECT or is_kidnapped(state, robot, _ONE_IMAGE_NS):
        return True
    for place in range(state.source.shape[1]):
        newest_ns = max(newest_ns, state.seen_ns[robot, place])
    for place in range(state.source.shape[1]):
        source, since_ns = state.source[robot, place], newest_ns - state.seen_ns[robot, place]
        finding, is_outer = state.finding[robot, place], source >= fixes_of(belief, 0)
        evidence = state.evidence[robot, place]
        repeated = source < state.score.size or evidence > _MAX_LINK_WEIGHT
        denies = evidence >= EXCLUDED or (is_outer and finding >= DEVIATES and repeated)
        denies = denies or is_suspended(belief, source, SUSPECT)
        if source >= 0 and since_ns < (RECENT_NS if denies else _TIED_NS):
            count += 1
            denied += 1 if denies else 0
    return denied > 0 and 2 * denied >= count


@inlined_njit
def confirm(measurements: Measurements, k: int, belief: BeliefArrays, accepted: bool) -> int:
    """Check measurement k against assumed poses; return a robot whose pose is refuted, or -1."""
    observer, target = measurements.observer[k], measurements.target[k]
    known = belief.sources.confirmations
    knows_observer = observer < 0 or known[observer] >= CONFIRMED
    knows_target = target < 0 or known[target] >= CONFIRMED
    if accepted:
        if not (knows_observer or knows_target or has_kernel(measurements, k)):
            knows_observer = knows_target = True  # both starts of robots that only radios tie agree
        if knows_observer and target >= 0:
            known[target] += _news(belief, target, measurements.stamp_ns[k])
        if knows_target and observer >= 0:
            known[observer] += _news(belief, observer, measurements.stamp_ns[k])
        return -1
    if knows_observer and knows_target:
        return -1
    elsewhere: int = target if knows_observer else observer
    return elsewhere


@inlined_njit
def _news(belief: BeliefArrays, robot: int, stamp_ns: int) -> float:
    """The part of one and a half correlation times that has passed since a robot was measured."""
    since_ns = stamp_ns - belief.sources.measured_ns[robot]
    if belief.sources.confirmations[robot] == 0.0:
        return 1.0
    news: float = max(0.0, min(1.0, since_ns / (1.5 * CORRELATION_NS)))
    return news


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

    `position` is the variance of x plus that of y [m^2], `sideways` their covariances with the heading [m
    rad], whose variance is `heading` [rad^2]; `drives`: the robot has odometry.
    """
    share = _SHARE_OF_DRIVER if drives else _SHARE_OF_HEADING
    depends: bool = sideways[0] ** 2 + sideways[1] ** 2 > share * position * heading
    return depends


@inlined_njit
def widen_suspect_covariance(state: SourceArrays, robot: int, covariance: FloatArray) -> None:
    """Widen the covariance (3, 3) of a pose that is little confirmed, or suspect as what it measures is."""
    doubted = state.score[robot] > CONFIRMED or state.confirmations[robot] < WELL_CONFIRMED
    for place in range(state.source.shape[1]):
        source, since_ns = state.source[robot, place], state.measured_ns[robot] - state.seen_ns[robot, place]
        if 0 <= source < state.score.size and since_ns < RECENT_NS:
            doubted = doubted or state.score[source] > 0.5 * SUSPECT
    if doubted:
        for i in range(3):
            covariance[i, i] += _SUSPECT_SIGMA[i] ** 2


@inlined_njit
def count_gated(
    measurements: Measurements, k: int, belief: BeliefArrays, accepted: bool, share: float, limits: LossLimits
) -> tuple[int, int]:
    """Count gated measurements in a row; return a robot that is lost by them, or -1, and why."""
    observer, target, state = measurements.observer[k], measurements.target[k], belief.sources
    lost, why = -1, 0
    for side in (observer, target):
        if side >= 0:
            counts = has_kernel(measurements, k) or _is_elsewhere_by_radios(belief, side)
            state.gated[side] = 0.0 if accepted else state.gated[side] + (share if counts else 0.0)
            if accepted:
                state.measured_ns[side] = max(state.measured_ns[side], measurements.stamp_ns[k])
            if state.gated[side] >= limits.gated_in_a_row:
                lost, why = side, _GATED
    if accepted and (observer < 0 or target < 0):
        fixed = max(observer, target)
        belief.last_fix_ns[fixed] = max(belief.last_fix_ns[fixed], measurements.stamp_ns[k])
    if share > 0.0 and not accepted and is_fix(measurements, k):
        fixes, limit = source_of(measurements, k, belief), limits.max_fault_score
        is_tied = _is_tied(belief, target, measurements.stamp_ns[k])
        if limit <= state.score[fixes] < 1.5 * limit and not is_tied:
            # They locate it again, and are suspect until they agree.
            lost, why, state.score[fixes] = target, _OFF_FIXES, SUSPECT
    return lost, why


@norefcount_njit
def _is_elsewhere_by_radios(belief: BeliefArrays, robot: int) -> bool:
    """Whether radios deny a pose by too long and too short ranges; a wall or bias changes all in one way."""
    state, newest_ns, long, short = belief.sources, NEVER_NS // 2, 0, 0
    for begin in (True, False):
        for row in range(belief.tracked.size):
            for place in range(state.source.shape[1]):
                source = state.source[row, place]
                if source >= state.score.size and robot in (row, source - state.score.size):
                    if begin:
                        newest_ns = max(newest_ns, state.seen_ns[row, place])
                    elif newest_ns - state.seen_ns[row, place] < _REPORTED_NS:
                        bad = state.finding[row, place] >= DEVIATES
                        long += 1 if bad and state.last_look[row, place, RANGE_DEVIATION] > 0.0 else 0
                        short += 1 if bad and state.last_look[row, place, RANGE_DEVIATION] < 0.0 else 0
    return min(long, short) > 0


@inlined_njit
def _is_tied(belief: BeliefArrays, robot: int, now_ns: int) -> bool:
    """Whether something surveyed has agreed with a robot recently; other robots agree with it anywhere."""
    state, tied = belief.sources, False
    for place in range(state.source.shape[1]):
        ties = belief.tracked.size <= state.source[robot, place] < fixes_of(belief, 0)
        recent = now_ns - state.seen_ns[robot, place] < _TIED_NS
        tied = tied or (ties and recent and state.finding[robot, place] == AGREES)
    return tied


_GATED, _OFF_FIXES = int(LossReason.GATED), int(LossReason.OFF_FIXES)
