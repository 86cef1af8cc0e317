"""Identification of anonymous detections in aerial images, by the robots' poses or by their motion.

The timeline processes each image as a whole, at its stamp, and again when older data arrive. So identities
do not depend on the order of arrival.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_estimator.filter.measurements import LossReason, Measurements, select
from swarm_loc_estimator.filter.models import CARTESIAN, gate_threshold
from swarm_loc_estimator.filter.sources import CONFIRMED, RELIEF, is_contradicted
from swarm_loc_estimator.filter.state import InitialPose, SwarmState
from swarm_loc_estimator.identification.chain import ChainModel, Chains, Identity, Scale
from swarm_loc_estimator.identification.memory import Identities, IdentityMemory, Outcome
from swarm_loc_estimator.identification.picture import (
    AMBIGUOUS,
    UNSEEN,
    Assignment,
    Picture,
    TrackPoint,
    assign,
    gathered_between,
    log_ratios,
)
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimate import TrackedLimits, estimate_at
from swarm_loc_estimator.timeline.settings import Settings

_MAX_FREE = 200  # Maximum number of unassigned detections among which robots are searched
_MOVED = 6.0  # Minimum motion of a robot to be searched, in standard deviations; half of it for a turn
_MAX_DRIFT_M, _MAX_DRIFT_RAD = 0.3, 0.5
"""Maximum drift of a robot's track between two images; beyond it the search restarts."""
_DOUBT_SHARE = 0.1  # Factor on the allowed error probability for a robot that is localized at another place
_MAX_FAULT_SCORE = 9.0  # Maximum fault score from missed detections of a robot that may have left the view
_HEADING_SIGMA = 0.2  # Maximum standard deviation of the heading of an identified robot [rad]


class PictureFusion:
    """Identifies robots in aerial images, by their odometry and a model of the images."""

    def __init__(self, swarm: Swarm, settings: Settings, tracks: OdometryTracks) -> None:
        self._tracks = tracks
        self._settings = settings
        self._gate = float(gate_threshold(settings.aerial_gate_probability))
        self._moves = np.array([not robot.stands for robot in swarm.robots], dtype=bool)
        self._limits = TrackedLimits.of(swarm, settings)
        self._miss = min(3.0, -math.log1p(-settings.aerial_detection_probability))
        self._model = ChainModel(
            detection_probability=settings.aerial_detection_probability,
            scale=Scale(1.0, settings.aerial_scale_sigma),
            scale_drift=settings.aerial_scale_drift,
        )

    def assigned(self, state: SwarmState, image: Measurements) -> Assignment:
        """Assign the detections (n,) of an image to localized robots; indices are of all robots (N,)."""
        stamp_ns = int(image.stamp_ns[0])
        picture = picture_of(image)
        estimate = estimate_at(state, self._tracks.arrays, self._limits, stamp_ns)
        robots = np.flatnonzero(state.tracked)
        poses, covariances = estimate.poses[robots], estimate.covariances[robots]
        _memory(state).see(picture.pose[:, :2], stamp_ns)
        ratios = log_ratios(poses, covariances, picture, _log_density(picture), self._gate)
        found = assign(ratios, self._settings.aerial_detection_probability, self._settings.aerial_probability)
        sigma = np.sqrt(np.maximum(covariances[:, 0, 0], covariances[:, 1, 1]))
        unseen, in_view = found.place == UNSEEN, _memory(state).is_in_view(poses[:, :2], 3.0 * sigma)
        newest = _memory(state).newest
        before_ns = newest.stamp_ns if newest is not None else stamp_ns
        unseen &= state.last_fix_ns[robots] <= before_ns  # no other fix since the previous image
        score, known = state.sources.score, state.sources.confirmations >= CONFIRMED
        for robot in robots[unseen & in_view].tolist():  # it is not where it is estimated
            score[robot] += self._miss
            if not known[robot] or score[robot] >= self._settings.max_fault_score:
                state.deinitialize(robot, LossReason.NOT_IN_IMAGE, stamp_ns)
        strangers = int(np.sum(found.robot == UNSEEN)) - int(np.sum(~state.tracked & self._moves))
        for robot in robots[unseen & ~in_view].tolist() if strangers > 0 else ():
            # the robot may have left the view, or be one of the unassigned detections
            score[robot] += min(self._miss, _MAX_FAULT_SCORE - score[robot])
        place = np.full(state.tracked.size, UNSEEN)
        probability = np.zeros(state.tracked.size)
        place[robots], probability[robots] = found.place, found.probability
        known = found.robot >= 0
        robot = np.where(known, robots[np.where(known, found.robot, 0)] if robots.size else 0, found.robot)
        number = np.where(place >= 0, image.reading[np.maximum(place, 0)], -1)  # in the message
        _memory(state).newest = Identities(stamp_ns, number, probability)
        return Assignment(place, robot, probability)

    def identify(self, state: SwarmState, image: Measurements, assignment: Assignment) -> bool:
        """Search an image (n,) for robots that are not located or not assigned; return if there are any."""
        images, stamp_ns = _memory(state), int(image.stamp_ns[0])
        looking = self._moves & (~state.tracked | (assignment.place == UNSEEN))
        for robot in [robot for robot in images.chains if not looking[robot]]:
            if assignment.place[robot] != AMBIGUOUS:
                del images.chains[robot]
        free = np.flatnonzero(assignment.robot < 0)
        claims: dict[int, Identity] = {}
        for robot in np.flatnonzero(looking).tolist():
            outcome, claim = self._look(state, robot, select(image, free))
            if claim is not None:
                claims[robot] = claim
            else:
                images.outcomes[outcome] += 1
        taken = Counter(claim.place for claim in claims.values())
        for robot, claim in claims.items():
            agreed = taken[claim.place] == 1
            images.outcomes[Outcome.ANSWERED if agreed else Outcome.CONFLICT] += 1
            if agreed:
                self._initialize(state, robot, stamp_ns, claim)
        self._tell(state, select(image, free), looking, claims, taken)
        return bool(looking.any())

    def _look(self, state: SwarmState, robot: int, image: Measurements) -> tuple[Outcome, Identity | None]:
        """Search one robot among unassigned detections (n,)."""
        stamp_ns = int(image.stamp_ns[0]) if image.size else 0
        if not image.size:
            return Outcome.UNDECIDED, None
        if image.size > _MAX_FREE:
            return Outcome.CROWDED, None
        if not self._tracks.has_started(robot, stamp_ns):
            return Outcome.NO_ODOMETRY, None
        sample = self._tracks.at(np.array([robot]), np.array([stamp_ns]))
        if sample.silence_s[0] > self._limits.timeout_s[robot]:
            _memory(state).chains.pop(robot, None)
            return Outcome.NO_ODOMETRY, None
        point, picture = TrackPoint(sample.pose[0], sample.covariance[0]), picture_of(image)
        chains = _memory(state).chains.get(robot)
        drift = np.zeros(3)  # variances that the track has gathered since the last image
        if chains is not None and chains.point is not None:
            drift = np.diag(gathered_between(chains.point, point))
        has_drifted = max(drift[0], drift[1]) > _MAX_DRIFT_M**2 or drift[2] > _MAX_DRIFT_RAD**2
        if chains is None or chains.point is None or has_drifted:
            chains = Chains(self._model)
        elif not _has_moved(chains.point, point, picture):
            return Outcome.NOT_MOVED, None
        _memory(state).chains[robot] = chains = chains.advanced(picture, point, stamp_ns)
        answer = chains.answer() if chains.images > 1 else None
        believed = bool(state.tracked[robot]) and not is_contradicted(state.arrays(), robot)
        sure = answer is not None and self._is_sure(answer, is_believed=believed)
        return Outcome.UNDECIDED, answer if sure else None

    def _is_sure(self, answer: Identity, *, is_believed: bool) -> bool:
        """Whether the probability and the heading of an identity are good enough to use it."""
        x, y, heading = np.sqrt(np.diag(answer.covariance)).tolist()
        settings = self._settings
        doubt = (1.0 - settings.aerial_probability) * (_DOUBT_SHARE if is_believed else 1.0)
        certain = 1.0 - answer.probability <= doubt
        return certain and max(x, y) < settings.lost_sigma and heading < _HEADING_SIGMA

    def _initialize(self, state: SwarmState, robot: int, stamp_ns: int, claim: Identity) -> None:
        """Initialize a robot at its identified pose; later images have to confirm it."""
        track = self._tracks.at(np.array([robot]), np.array([stamp_ns]))
        at = Preintegrated(stamp_ns, track.covariance[0], track.jacobian[0])
        transform = se2.compose(claim.pose, se2.inverse(track.pose[0]))
        initial = InitialPose(transform, se2.error_covariance(claim.pose, claim.covariance))
        state.initialize(robot, initial, at)
        state.last_fix_ns[robot] = stamp_ns
        _memory(state).chains.pop(robot, None)

    def _tell(
        self,
        state: SwarmState,
        image: Measurements,
        looking: BoolArray,
        claims: dict[int, Identity],
        taken: Counter[int],
    ) -> None:
        """Record the results of the search among detections (n,)."""
        newest = _memory(state).newest
        if newest is None or not looking.any():
            return
        place, probability = newest.place.copy(), newest.probability.copy()
        for robot in np.flatnonzero(looking).tolist():
            claim = claims.get(robot)
            if claim is not None and taken[claim.place] == 1:
                place[robot], probability[robot] = int(image.reading[claim.place]), claim.probability
            else:
                chains = _memory(state).chains.get(robot)
                place[robot] = -1
                best = chains.probabilities.max(initial=0.0) if chains is not None else 0.0
                probability[robot] = min(float(best), self._settings.aerial_probability)
        _memory(state).newest = newest._replace(place=place, probability=probability)


def _memory(state: SwarmState) -> IdentityMemory:
    """The state's memory of aerial images, which begins with the first."""
    if state.images is None:
        state.images = IdentityMemory()
    return state.images


def relieve_seen(state: SwarmState, robots: IntArray) -> None:
    """Reduce the fault scores of robots (k,) that were detected at their estimated positions."""
    score = state.sources.score
    score[robots] = np.maximum(0.0, score[robots] - 4.0 * RELIEF)


def picture_of(image: Measurements) -> Picture:
    """Poses and covariances of the detections (n,) of an image."""
    return Picture(image.value, image.covariance, image.has_heading)


def as_fixes(image: Measurements, robots: IntArray) -> Measurements:
    """Convert identified detections (k,) to absolute fixes of robots (k,)."""
    none = np.zeros(image.size, dtype=np.int64)
    return image._replace(model=none + CARTESIAN, target=robots, reading=none)


def _log_density(picture: Picture) -> float:
    """Logarithm of the density of detections in their bounding box [1/m^2]."""
    extent = np.ptp(picture.pose[:, :2], axis=0)
    sigma = math.sqrt(float(picture.variance.max()))
    return math.log(len(picture.pose) / float(np.prod(np.maximum(extent, 100.0 * sigma))))


def _has_moved(before: TrackPoint, now: TrackPoint, picture: Picture) -> bool:
    """Whether a robot has moved, or turned if headings are measured, significantly."""
    gathered = gathered_between(before, now)
    variance = 2.0 * float(picture.variance.min()) + max(gathered[0, 0], gathered[1, 1])
    if np.hypot(*(now.pose[:2] - before.pose[:2])) ** 2 > _MOVED**2 * variance:
        return True
    if not picture.has_heading.any():
        return False
    variance = 2.0 * float(picture.covariance[picture.has_heading, 2, 2].min()) + gathered[2, 2]
    return bool((now.pose[2] - before.pose[2]) ** 2 > (0.5 * _MOVED) ** 2 * variance)
