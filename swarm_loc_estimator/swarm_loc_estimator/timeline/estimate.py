"""Estimates: poses of all robots at an instant, covariances and transforms to the odom frames.

Reports of detected faults: which robot or landmark contradicts the estimate, by which sensor; lost robots.

Odometry whose pose is constant is noticed by its twist, see `odometry/preintegration.py`; without a twist, as
from shared topics or dead encoders, by the poses of the robot, which move nevertheless.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum, IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.numerics import composed, wrap
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.filter import sources
from swarm_loc_estimator.filter.measurements import LossReason
from swarm_loc_estimator.filter.models import ANY_HEADING
from swarm_loc_estimator.filter.prediction import new_scratch, write_predicted
from swarm_loc_estimator.filter.state import NEVER_NS, BeliefArrays, SwarmState
from swarm_loc_estimator.mapping.messages import DelayBelief
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.track_arrays import TrackArrays, look_up, new_sample
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.calibration_states import moved_place
from swarm_loc_estimator.swarm.swarm import Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.self_calibration import estimated_place
from swarm_loc_estimator.timeline.settings import Settings


class Status(IntEnum):
    """Status of a robot's position; the values of SwarmPose.status."""

    WAITING = 0  # not localized
    TRACKED = 1
    STALE = 2  # localized, but its odometry has timed out
    UNCONFIRMED = 3  # localized, but no later measurement agrees with its pose yet
    CONTRADICTED = 4  # its newest sightings contradict its pose
    UNCERTAIN = 5  # localized, but its position is uncertain beyond lost_sigma, or by an unknown heading


_WAITING, _TRACKED, _STALE = int(Status.WAITING), int(Status.TRACKED), int(Status.STALE)
_UNCONFIRMED, _CONTRADICTED = int(Status.UNCONFIRMED), int(Status.CONTRADICTED)
_UNCERTAIN = int(Status.UNCERTAIN)


class TrackedLimits(NamedTuple):
    """Limits beyond which a localized robot is not reported as tracked."""

    timeout_s: FloatArray  # (N,) age of the newest odometry [s]
    position_sigma: float  # Standard deviation of x and of y [m]
    heading_sigma: float  # Standard deviation of a known heading [rad]

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
    #: (N,) whether the standard deviation of the heading is below `lost_heading_sigma`
    heading_known: BoolArray


def estimate_at(state: SwarmState, tracks: TrackArrays, limits: TrackedLimits, now_ns: int) -> Estimate:
    """Predict the estimate by odometry from the newest measurements to an instant."""
    return _estimate(state.arrays(), tracks, limits, now_ns)


@cached_njit
def _estimate(belief: BeliefArrays, tracks: TrackArrays, limits: TrackedLimits, now_ns: int) -> Estimate:
    robots = belief.tracked.size
    pose, covariance = np.full((2, robots, 3), np.nan), np.full((robots, 3, 3), np.nan)
    status, age_s = np.full(robots, _WAITING, dtype=np.uint8), np.full(robots, -1.0)
    out = Estimate(now_ns, pose[0], covariance, pose[1], status, age_s, np.zeros(robots, dtype=np.bool_))
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
        x, y, theta = composed(t[0], t[1], t[2], track[0], track[1], track[2])
        out.poses[i, 0], out.poses[i, 1], out.poses[i, 2] = x, y, wrap(theta)
        # Covariance of x, y, theta by that of the right-invariant error, of a heading anywhere in a turn at
        # most.
        own, shear = out.covariances[i], (-y, x, 0.0)
        for a in range(3):
            for b in range(3):
                own[a, b] = error[a, b] + shear[a] * error[2, b] + error[a, 2] * shear[b]
                own[a, b] += shear[a] * error[2, 2] * shear[b]
        sources.widen_suspect_covariance(belief.sources, i, own)
        scale = np.sqrt(min(1.0, ANY_HEADING / own[2, 2]))
        for a in range(3):
            own[a, 2] *= scale
            own[2, a] *= scale
        out.heading_known[i] = own[2, 2] <= limits.heading_sigma**2
        drives, silence_s = not tracks.is_stationary[i], sample.silence_s[0]
        out.status[i] = _status(belief, i, silence_s, limits, own, drives)
        cos, sin = np.cos(theta - raw[2]), np.sin(theta - raw[2])
        out.map_to_odom[i, 0] = x - cos * raw[0] + sin * raw[1]
        out.map_to_odom[i, 1] = y - sin * raw[0] - cos * raw[1]
        out.map_to_odom[i, 2] = wrap(theta - raw[2])
    return out


@inlined_njit
def _status(
    belief: BeliefArrays,
    robot: int,
    silence_s: float,
    limits: TrackedLimits,
    covariance: FloatArray,
    drives: bool,
) -> int:
    """Status of a localized robot with the reported covariance (3, 3); whether it has odometry."""
    if silence_s > limits.timeout_s[robot]:
        return _STALE
    if belief.sources.confirmations[robot] <= sources.CONFIRMED:
        return _UNCONFIRMED
    if sources.is_contradicted(belief, robot):
        return _CONTRADICTED
    xx, yy, tt = covariance[0, 0], covariance[1, 1], covariance[2, 2]
    sideways = (covariance[0, 2], covariance[1, 2])
    turns = tt > limits.heading_sigma**2 and sources.depends_on_heading(xx + yy, sideways, tt, drives)
    return _UNCERTAIN if turns or max(xx, yy) > limits.position_sigma**2 else _TRACKED


_MOVES = 3  # Number of moves that prove motion; one or two may correct a wrong start or calibration
_MOVE_M, _MOVE_SIGMAS = 0.05, 3.0
"""Minimum displacement of a move: a length, and a multiple of the standard deviation of both ends."""
_MEMORY_NS = 30_000_000_000  # Time within which these moves happen, and for which they are remembered
_LONG_AGO_NS = np.iinfo(np.int64).min // 2

LOSS_CAUSES = {
    LossReason.UNCERTAIN: "its position's standard deviation exceeded {0.lost_sigma:g} m (lost_sigma), or"
    " stemmed from a heading beyond {0.lost_heading_sigma:g} rad (lost_heading_sigma)",
    LossReason.REFUTED: f"a measurement contradicted its pose before {sources.CONFIRMED:g} had confirmed it",
    LossReason.GATED: "{0.lost_after} measurements in a row were gated",
    LossReason.OFF_FIXES: "several absolute fixes in a row were gated",
    LossReason.KIDNAPPED: "its measurements can only mean that it is elsewhere",
    LossReason.OFF_MAP: "its scans contradict the map",
    LossReason.NOT_IN_IMAGE: "aerial images do not show it where it should be",
    LossReason.COMMAND: "a command removed it",
    LossReason.FRAME: "its local frame ended",
}
"""Why robots are lost, in words; with fields of the settings."""


class LossReport(NamedTuple):
    """LossReason of a robot."""

    robot: int  # Its index
    why: LossReason  # Reason
    stamp_ns: int  # Stamp of the measurement or command that showed it
    cause: str  # The reason in words, with the settings

    def text(self, now_ns: int) -> str:
        """Message for users at an instant, one sentence."""
        return f"lost {max(0, now_ns - self.stamp_ns) * 1e-9:.1f} s ago: {self.cause}"


def last_loss(state: SwarmState, robot: int, settings: Settings) -> LossReport | None:
    """The last loss of a robot, located again or not; None without one."""
    why = int(state.lost_why[robot])
    if not why:
        return None
    cause = LOSS_CAUSES[LossReason(why)].format(settings)
    return LossReport(robot, LossReason(why), int(state.lost_ns[robot]), cause)


class ConstantOdometry:
    """Moves of estimated poses of robots whose odometry has never changed."""

    def __init__(self, robots: int) -> None:
        self._from = np.full((robots, 2), np.nan)
        self._from_variance = np.zeros(robots)
        self._moves_ns = np.full((robots, _MOVES), _LONG_AGO_NS)

    def forget(self, robot: int) -> None:
        """Forget the moves of a robot whose pose was set."""
        self._from[robot] = np.nan
        self._moves_ns[robot] = _LONG_AGO_NS

    def add(self, constant: BoolArray, estimate: Estimate) -> None:
        """Take note of poses; `constant` (N,) tells whose odometry has never changed."""
        variance = 0.5 * np.trace(estimate.covariances[:, :2, :2], axis1=1, axis2=2)
        position = np.where(constant[:, None], estimate.poses[:, :2], np.nan)
        reach = np.maximum(_MOVE_M, _MOVE_SIGMAS * np.sqrt(variance + self._from_variance))
        moved = np.hypot(*(position - self._from).T) > reach  # False for NaN
        self._moves_ns[moved] = np.roll(self._moves_ns[moved], 1, axis=1)
        self._moves_ns[moved, 0] = estimate.stamp_ns
        self._moves_ns[~constant] = _LONG_AGO_NS  # such as a robot that was carried before it drove
        changed = moved | np.isnan(self._from[:, 0]) | np.isnan(position[:, 0])
        self._from[changed], self._from_variance[changed] = position[changed], variance[changed]

    def contradicted(self, now_ns: int) -> BoolArray:
        """Whether measurements contradict the constant odometry of each robot (N,)."""
        return np.asarray(now_ns - self._moves_ns[:, -1] < _MEMORY_NS)


class Contradicted(Enum):
    """Contradicted property of a robot or landmark."""

    ODOMETRY = "odometry"
    RESET = "odometry reset"
    CONSTANT = "constant odometry"
    UNMOVED = "constant odometry of a moving robot"
    GYROSCOPE = "turns of a gyroscope"
    POSE = "pose"
    SIGHTINGS = "sightings"
    DESCRIPTION = "description"
    SUSPENDED = "suspended source"
    REPEATED = "repeated values"
    LATE = "stamps of scans"
    BACKWARDS = "order of beams"


GYROSCOPE_OF = "gyroscope of "  # Before the name of its robot


class Contradiction(NamedTuple):
    """A fault of a robot or landmark."""

    about: str  # Name of the robot, or what it is, such as "landmark 7" or "gyroscope of epuck1"
    kind: Contradicted  # Contradicted property
    text: str  # Message for users, one sentence


def contradictions(
    swarm: Swarm,
    state: SwarmState,
    tracks: OdometryTracks,
    unmoved: BoolArray,
    max_fault_score: float,
    now_ns: int,
) -> list[Contradiction]:
    """All faults detected at an instant; `unmoved` (N,) move although their odometry has never changed."""
    names = [robot.name for robot in swarm.robots] + [body.title for body in swarm.surveyed]
    robots, belief, maps = len(swarm.robots), state.arrays(), swarm.map is not None
    names += [f"{'lidar' if maps and one.lidar.is_used else 'fixes'} of {one.name}" for one in swarm.robots]
    names += [f"marker of {one.name}" for one in swarm.robots]
    conflicting = tracks.had_faults(now_ns, 2)
    reset = tracks.had_faults(now_ns, 1) & ~conflicting
    denied = [
        is_tracked and sources.is_contradicted(belief, robot)
        for robot, is_tracked in enumerate(state.tracked)
    ]
    # Turns of gyroscopes may still turn out uncertain, which would explain what was found since then.
    is_new = state.contradicted_ns > now_ns - tracks.unsettled_ns
    contradicted = np.flatnonzero((state.contradicted_ns > NEVER_NS) & ~is_new).tolist()
    aside = [(robot, source % len(names)) for robot, source in sources.excluded_links(state.sources, now_ns)]
    outside = range(len(names) - 2 * robots - len(swarm.cameras), len(names))  # cameras, fixes and markers
    suspended = np.flatnonzero(state.sources.score[robots:] >= max_fault_score + 1.0) + robots
    found: list[tuple[Contradicted, ArrayLike]] = [
        (Contradicted.ODOMETRY, conflicting),
        (Contradicted.RESET, reset),
        (Contradicted.CONSTANT, tracks.integrates_twist()),
        (Contradicted.UNMOVED, unmoved),
        (Contradicted.GYROSCOPE, tracks.contradicts_gyroscope()),
        (Contradicted.POSE, denied),
        (Contradicted.REPEATED, sources.repeating_robots(state.sources, now_ns)),
    ]
    return [
        *(
            _of_robot(names[robot], kind)
            for kind, robots in found
            for robot in np.flatnonzero(robots).tolist()
        ),
        *(
            _sightings(*(names[i] for i in ((source, robot) if source in outside else (robot, source))))
            for robot, source in aside
        ),
        *(_suspended(names[source]) for source in suspended.tolist()),
        *(
            one
            for k, number in sorted(state.delays)
            for one in _lidar(swarm.robots[k], number, state.delays[k, number])
        ),
        *(
            one
            for source in contradicted
            if (one := _description(names[source], swarm, source, state)) is not None
        ),
    ]


_TEXTS = {
    Contradicted.ODOMETRY: "the odometry of {0} jumps back and forth: it may have two sources",
    Contradicted.RESET: "the odometry of {0} jumped or was reset: its motion at that moment is unknown",
    Contradicted.CONSTANT: "the odometry of {0} has a constant pose or heading but a twist: integrating the"
    " twist",
    Contradicted.UNMOVED: "the odometry of {0} has a constant pose and no twist, although {0} moves",
    Contradicted.GYROSCOPE: "the gyroscope of {0} does not turn with its wheels; using the turns of the"
    " wheels: check its axes (imu.roll, imu.pitch) and its driver",
    Contradicted.POSE: "the newest measurements contradict the pose of {0}",
    Contradicted.REPEATED: "the radio of {0} repeats its values: they count once; publish each range once,"
    " with its stamp",
}
_PART = {
    Contradicted.GYROSCOPE: GYROSCOPE_OF,
    Contradicted.REPEATED: "radio of ",
}


def _of_robot(name: str, kind: Contradicted) -> Contradiction:
    return Contradiction(_PART.get(kind, "") + name, kind, _TEXTS[kind].format(name))


def _lidar(robot: Robot, number: int, delay: DelayBelief) -> Iterator[Contradiction]:
    """Faults of a lidar of a robot, by its number."""
    topic = [*robot.lidar.all][number]
    name = f"lidar {topic} of {robot.name}" if number else f"lidar of {robot.name}"
    if delay.is_excluded:
        mount = f"lidar.others.{topic}" if number else "lidar"
        text = f"not using the {name} until it agrees with its other lidars again: check {mount}"
        yield Contradiction(name, Contradicted.SUSPENDED, f"{text} (x, y, yaw, roll) and its driver")
        return
    if delay.is_refuted:
        yield Contradiction(name, Contradicted.LATE, delay.sentence(robot, number))
    if delay.is_backwards:
        text = f"the {name} measures its beams in the other order than its time_increment says: using them so"
        remedy = "let its driver publish a negative one, or reverse the ranges"
        yield Contradiction(name, Contradicted.BACKWARDS, f"{text}; {remedy}")


def _sightings(observer: str, source: str) -> Contradiction:
    text = f"excluding {observer}'s measurements of {source}: inconsistent with all others"
    return Contradiction(observer, Contradicted.SIGHTINGS, text)


_CHECKS = {
    "": "its place (x, y, yaw), its topic and its clock",
    "fixes": "whose body it is, the place of its frame and the clock",
    "lidar": "its mount (lidar.yaw) and the map",
    "marker": "the yaw of the face of {}",
}
"""What to check of a source that is not used."""


def _suspended(name: str) -> Contradiction:
    what, _, robot = name.partition(" of ")
    check = _CHECKS[what if robot else ""].format(robot)
    text = f"not using {name} until it agrees with the rest again: check {check}"
    return Contradiction(name, Contradicted.SUSPENDED, text)


def _description(name: str, swarm: Swarm, source: int, state: SwarmState) -> Contradiction | None:
    """Fault of a robot or body whose parameters are re-estimated; None for a body that is where it should be.

    What a body contradicted was the fault of another source, if its place has turned out right.
    """
    number = source - len(swarm.robots)
    if number < 0:
        text = f"{name} contradicts its calibration; re-estimating its camera and odometry parameters"
        return Contradiction(name, Contradicted.DESCRIPTION, text)
    body = swarm.surveyed[number]
    place, covariance = estimated_place(body, number, state)
    off = place - moved_place(body, np.zeros(3))
    off[2] = 0.0 if isinstance(body, Landmark) and body.yaw is None else wrap_angle(off[2])
    if not np.any(np.abs(off) > _ELSEWHERE_SIGMAS * np.sqrt(np.diag(covariance))):
        return None
    moved = float(np.hypot(*off[:2]))
    text = f"{name} is about {moved:.2f} m from its surveyed place; re-estimating its place"
    return Contradiction(name, Contradicted.DESCRIPTION, text)


_ELSEWHERE_SIGMAS = 2.0  # Standard deviations by which a body is elsewhere
