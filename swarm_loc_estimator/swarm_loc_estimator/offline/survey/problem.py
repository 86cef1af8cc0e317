"""Sightings and odometry of a recording as a least-squares problem of poses, landmarks and parameters.

A robot's pose is X(t) = T(t) O(t) with the odometry track O, see `odometry/tracks.py`. Where wheels do not
slip, T is constant, so it is estimated at a few instants per second only. A sighting in between uses the
nearest of them; what the wheels may have slipped since then is added to its noise.

Places to begin with: maps of single robots in the frames of their tracks, joined by what they share.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.filter.measurements import Measurements, select
from swarm_loc_estimator.filter.models import POLAR, is_compiled
from swarm_loc_estimator.odometry.track_arrays import OdometrySample
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.sensors.camera import CONTENT_POSE, CONTENT_POSE_TWO, SightingConverter
from swarm_loc_estimator.swarm.swarm import Landmark, Swarm

STEP_NS = 100_000_000  # Shortest time between two instants at which the transform of a track is estimated
MAX_KNOTS = 12_000
"""Maximum number of these instants, of all robots; those of long recordings are farther apart."""
_WITH_POSE = (CONTENT_POSE, CONTENT_POSE_TWO)
MIN_SIGHTINGS = 5  # Minimum number of sightings of a marker that is to be a landmark


@dataclass(frozen=True)
class Knots:
    """Instants at which transforms of tracks are estimated (k,), by robot and stamp."""

    robot: IntArray  # (k,) index of the robot
    stamp_ns: IntArray  # (k,) the instants
    sample: OdometrySample  # (k,) the tracks there

    def nearest(self, robots: IntArray, stamps_ns: IntArray) -> IntArray:
        """The nearest knots (m,) of robots at instants (m,); -1 for a robot without any, or none (-1)."""
        found = np.full(robots.size, -1)
        for robot in np.unique(robots[robots >= 0]).tolist():
            own = np.flatnonzero(self.robot == robot)
            rows = np.flatnonzero(robots == robot)
            if own.size:
                edges = (self.stamp_ns[own][1:] + self.stamp_ns[own][:-1]) // 2
                found[rows] = own[np.searchsorted(edges, stamps_ns[rows])]
        return found


@dataclass(frozen=True)
class SurveyProblem:
    """What is to be solved."""

    # The description with a landmark for each marker that belongs to nobody, at the origin where its place is
    # not known
    swarm: Swarm
    is_known: BoolArray  # (L,) whether the place of a landmark is described
    knots: Knots  # Instants at which transforms are estimated
    # (m,) measurements of cameras; markers of landmarks are in the landmark's own frame
    sightings: Measurements
    sides: IntArray  # (m, 2) knots of observer and target; -1: a landmark
    tracks: FloatArray  # (2, m, 3) poses of observer and target on their tracks
    slip: FloatArray  # (2, m, 3, 3) covariance of their slip since the knot, in the frame of the track
    odometry: OdometryTracks  # The tracks
    rare: dict[int, int]  # Number of sightings by id, of markers that were seen too rarely

    @property
    def is_polar(self) -> BoolArray:
        """Whether sightings (m,) are range and bearing."""
        return np.asarray(self.sightings.model == POLAR)


def problem_of(recording: Recording, swarm: Swarm) -> SurveyProblem:
    """Set up the problem of a recording.

    Args:
        recording: Odometry and detections of the robots.
        swarm: Their description; landmarks in it are known places.
    """
    described, rare = _with_landmarks(recording, swarm)
    tracks = OdometryTracks(swarm.robots)
    rows, turns = recording.odometry, recording.turn_rates
    tracks.extend_turns(turns.robot, turns.stamp_ns, turns.rate)
    tracks.extend(rows.robot, rows.stamp_ns, rows.pose, rows.twist)
    seen = select(recording.detections, ~np.isin(recording.detections.detection["id"], list(rare)))
    at_origin = [
        replace(one, x=0.0, y=0.0, yaw=None if one.yaw is None else 0.0) for one in described.landmarks
    ]
    converter = SightingConverter(replace(described, landmarks=tuple(at_origin)))
    sightings = converter.convert(seen)
    # not directions alone, and not what fixed cameras see
    sightings = select(sightings, is_compiled(sightings.model) & (sightings.observer >= 0))
    knots = _knots(tracks, recording)
    robots = np.stack([sightings.observer, sightings.target])
    sides = np.stack([knots.nearest(one, sightings.stamp_ns) for one in robots])
    started = np.array([tracks.has_started(np.maximum(one, 0), sightings.stamp_ns) for one in robots])
    kept: BoolArray = np.asarray(((robots < 0) | (started & (sides >= 0))).all(axis=0))
    sightings, robots, sides = select(sightings, kept), robots[:, kept], sides[:, kept]
    known = {mark.id for mark in swarm.landmarks}
    poses, slip = np.zeros((2, sightings.size, 3)), np.zeros((2, sightings.size, 3, 3))
    for side in range(2):
        moves = sides[side] >= 0
        at = tracks.at(robots[side][moves], sightings.stamp_ns[moves])
        poses[side, moves] = at.pose
        since = at.covariance - knots.sample.covariance[sides[side][moves]]
        slip[side, moves] = since * np.sign(np.trace(since, axis1=1, axis2=2))[:, None, None]
    is_known = np.array([mark.id in known for mark in described.landmarks], dtype=bool)
    return SurveyProblem(described, is_known, knots, sightings, sides.T, poses, slip, tracks, rare)


def _with_landmarks(recording: Recording, swarm: Swarm) -> tuple[Swarm, dict[int, int]]:
    """The swarm with a landmark for each marker that belongs to nobody; and those that were seen rarely."""
    detections = recording.detections.detection
    ids, counts = np.unique(detections["id"], return_counts=True)
    unknown = {int(i): int(n) for i, n in zip(ids, counts, strict=True) if int(i) not in swarm.owner_of}
    rare = {marker_id: count for marker_id, count in unknown.items() if count < MIN_SIGHTINGS}
    with_heading = set(np.unique(detections["id"][np.isin(detections["content"], _WITH_POSE)]).tolist())
    new = [
        Landmark(marker_id, yaw=0.0 if marker_id in with_heading else None)
        for marker_id in unknown
        if marker_id not in rare
    ]
    return replace(swarm, landmarks=(*swarm.landmarks, *new)), rare


def _knots(tracks: OdometryTracks, recording: Recording) -> Knots:
    rows, robots, stamps = recording.odometry, [], []
    spans = {}
    for robot in np.unique(rows.robot).tolist():
        own = rows.stamp_ns[rows.robot == robot]
        spans[robot] = (int(own.min()), int(own.max()))
    whole_ns = sum(end - begin for begin, end in spans.values())
    step_ns = max(STEP_NS, whole_ns // MAX_KNOTS)
    for robot, (begin_ns, end_ns) in spans.items():
        at_ns = np.arange(begin_ns, end_ns + step_ns, step_ns)
        robots.append(np.full(at_ns.size, robot))
        stamps.append(np.minimum(at_ns, end_ns))
    robot, stamp_ns = np.concatenate(robots), np.concatenate(stamps)
    return Knots(robot, stamp_ns, tracks.at(robot, stamp_ns))


_AGREES_M = 0.15
"""Landmarks closer than this, or than a tenth of the distance between them, agree on an alignment."""


@dataclass
class Start:
    """Where all begin."""

    transform: FloatArray  # (N, 3) from the common frame to the track of each robot; NaN: not connected
    landmark: FloatArray  # (L, 3) poses; NaN: not connected


def start_of(problem: SurveyProblem) -> Start:
    """Join the maps of all robots that share landmarks or see each other.

    Begins with described landmarks and starts, else with the robot that has seen most landmarks, whose first
    pose is then the origin.
    """
    swarm = problem.swarm
    maps = [_map_of(problem, robot) for robot in range(len(swarm.robots))]
    start = Start(np.full((len(swarm.robots), 3), np.nan), np.full((len(swarm.landmarks), 3), np.nan))
    for index in np.flatnonzero(problem.is_known).tolist():
        mark = swarm.landmarks[index]
        start.landmark[index] = (mark.x, mark.y, mark.yaw or 0.0)
    for index, robot in enumerate(swarm.robots):
        if robot.start is not None and (problem.knots.robot == index).any():
            _place(problem, start, maps, index, _at_first(problem, index, np.array(robot.start)))
    if np.isnan(start.transform).all() and not problem.is_known.any():
        seen = [int(np.isfinite(one).all(axis=1).sum()) for one in maps]
        root = int(np.argmax(seen))
        _place(problem, start, maps, root, _at_first(problem, root, np.zeros(3)))
    while True:
        waiting = np.flatnonzero(np.isnan(start.transform[:, 0])).tolist()
        found = [(robot, *_alignment(problem, start, maps, robot)) for robot in waiting]
        found = [one for one in found if one[2] > 0.0]
        if not found:
            return start
        robot, transform, _ = max(found, key=lambda one: one[2])
        _place(problem, start, maps, robot, transform)


def _at_first(problem: SurveyProblem, robot: int, pose: FloatArray) -> FloatArray:
    """The transform of a robot's track with a pose (3,) at its first knot."""
    first = int(np.flatnonzero(problem.knots.robot == robot)[0])
    return se2.compose(pose, se2.inverse(problem.knots.sample.pose[first]))


def _map_of(problem: SurveyProblem, robot: int) -> FloatArray:
    """Poses (L, 3) of the landmarks that a robot has seen, in the frame of its track; NaN: not seen."""
    sightings, places = problem.sightings, np.full((len(problem.swarm.landmarks), 3), np.nan)
    rows = np.flatnonzero((sightings.observer == robot) & (sightings.landmark >= 0))
    seen = _seen_at(problem, rows, problem.tracks[0, rows])
    for index in np.unique(sightings.landmark[rows]).tolist():
        own = seen[sightings.landmark[rows] == index]
        x, y = np.median(own[:, :2], axis=0)
        heading = own[np.isfinite(own[:, 2]), 2]
        places[index] = (x, y, _median_angle(heading) if heading.size else 0.0)
    return places


def _seen_at(problem: SurveyProblem, rows: IntArray, observer: FloatArray) -> FloatArray:
    """Poses (k, 3) of the markers of sightings by robots at poses (k, 3); heading NaN: not seen."""
    some, is_polar = select(problem.sightings, rows), problem.is_polar[rows]
    value = some.value.copy()
    distance, bearing = value[is_polar, 0].copy(), value[is_polar, 1].copy()
    value[is_polar, 0], value[is_polar, 1] = distance * np.cos(bearing), distance * np.sin(bearing)
    seen = se2.compose(se2.compose(observer, some.sensor), value)
    seen[some.has_heading == 0, 2] = np.nan
    return seen


def _median_angle(angles: FloatArray) -> float:
    """The angle whose distance to all others is least in sum."""
    some = angles[:: max(1, angles.size // 200)]
    return float(some[np.argmin(np.abs(se2.wrap_angle(some[:, None] - angles)).sum(axis=1))])


def _place(
    problem: SurveyProblem, start: Start, maps: list[FloatArray], robot: int, transform: FloatArray
) -> None:
    """Place a robot's track, and the landmarks that nobody has placed before."""
    start.transform[robot] = transform
    new = np.isnan(start.landmark[:, 0]) & np.isfinite(maps[robot][:, 0]) & ~problem.is_known
    start.landmark[new] = se2.compose(transform, maps[robot][new])


def _alignment(
    problem: SurveyProblem, start: Start, maps: list[FloatArray], robot: int
) -> tuple[FloatArray, float]:
    """The transform of a robot's track on which most landmarks and robots agree, and how many do so."""
    own = maps[robot]
    both = np.flatnonzero(np.isfinite(own[:, 0]) & np.isfinite(start.landmark[:, 0]))
    candidates = [
        se2.rigid_fit(own[[i, j], :2], start.landmark[[i, j], :2])
        for i in both.tolist()
        for j in both.tolist()
        if i < j
    ]
    by_robots = _by_robots(problem, start, robot)
    candidates += by_robots[:: max(1, len(by_robots) // 50)]
    best, most = np.zeros(3), 0.0
    for candidate in candidates:
        moved = se2.transform_points(candidate, own[both, :2])
        size = 0.1 * np.linalg.norm(np.ptp(start.landmark[both, :2], axis=0)) if both.size else 0.0
        off = np.linalg.norm(moved - start.landmark[both, :2], axis=1)
        votes = float(np.sum(off < max(_AGREES_M, size))) - 1.0
        if len(by_robots):
            others = np.array(by_robots)
            near = np.linalg.norm(others[:, :2] - candidate[:2], axis=1) < 3.0 * _AGREES_M
            near &= np.abs(se2.wrap_angle(others[:, 2] - candidate[2])) < 0.5
            votes += 2.0 * float(near.mean())
        if votes > most:
            best, most = candidate, votes
    return best, most


def _by_robots(problem: SurveyProblem, start: Start, robot: int) -> list[FloatArray]:
    """Transforms of a robot's track by sightings with heading, between it and placed robots."""
    sightings = problem.sightings
    placed = np.isfinite(start.transform[:, 0])
    seen_by = np.flatnonzero((sightings.target == robot) & placed[sightings.observer] & sightings.has_heading)
    observers = se2.compose(start.transform[sightings.observer[seen_by]], problem.tracks[0, seen_by])
    markers = _seen_at(problem, seen_by, observers)
    bodies = se2.compose(markers, se2.inverse(sightings.marker[seen_by]))
    found = [*se2.compose(bodies, se2.inverse(problem.tracks[1, seen_by]))]
    sees = np.flatnonzero(
        (sightings.observer == robot)
        & (sightings.target >= 0)
        & placed[np.maximum(sightings.target, 0)]
        & sightings.has_heading
    )
    if sees.size:
        targets = se2.compose(start.transform[sightings.target[sees]], problem.tracks[1, sees])
        markers = se2.compose(targets, sightings.marker[sees])
        relative = _seen_at(problem, sees, problem.tracks[0, sees])
        found += [*se2.compose(markers, se2.inverse(relative))]
    return found
