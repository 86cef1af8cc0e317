"""Sightings and odometry of a recording as a least-squares problem of poses, landmarks and parameters.

A robot's pose is X(t) = T(t) O(t) with the odometry track O, see `odometry/tracks.py`. Where wheels do not
slip, T is constant, so it is estimated at a few instants per second only. A sighting in between uses the
nearest of them; what the wheels may have slipped since then is added to its noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.filter.measurement_model import POLAR, MeasurementArray
from swarm_loc_estimator.odometry.look_up import OdometrySample
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.sensors.camera import SightingConverter
from swarm_loc_estimator.sensors.sensor import chosen
from swarm_loc_estimator.sensors.sighting_kernels import CONTENT_POSE, CONTENT_POSE_TWO
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
    sightings: MeasurementArray
    sides: IntArray  # (m, 2) knots of observer and target; -1: a landmark
    tracks: FloatArray  # (2, m, 3) poses of observer and target on their tracks
    slip: FloatArray  # (2, m, 3, 3) covariance of their slip since the knot, in the frame of the track
    odometry: OdometryTracks  # The tracks
    rare: dict[int, int]  # Number of sightings by id, of markers that were seen too rarely

    @property
    def is_polar(self) -> BoolArray:
        """Whether sightings (m,) are range and bearing."""
        return np.asarray(self.sightings["kind"] == POLAR)


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
    seen = chosen(recording.detections, ~np.isin(recording.detections.detection["id"], list(rare)))
    at_origin = [
        replace(one, x=0.0, y=0.0, yaw=None if one.yaw is None else 0.0) for one in described.landmarks
    ]
    converter = SightingConverter(replace(described, landmarks=tuple(at_origin)))
    sightings = converter.convert(seen.robot, seen.stamp_ns, seen.detection).measurements
    # not directions alone, and not what fixed cameras see
    sightings = sightings[(sightings["kind"] <= POLAR) & (sightings["observer"] >= 0)]
    knots = _knots(tracks, recording)
    robots = np.stack([sightings["observer"], sightings["target"]])
    sides = np.stack([knots.nearest(one, sightings["stamp_ns"]) for one in robots])
    started = np.array([tracks.has_started(np.maximum(one, 0), sightings["stamp_ns"]) for one in robots])
    kept = ((robots < 0) | (started & (sides >= 0))).all(axis=0)
    sightings, robots, sides = sightings[kept], robots[:, kept], sides[:, kept]
    known = {mark.id for mark in swarm.landmarks}
    poses, slip = np.zeros((2, sightings.size, 3)), np.zeros((2, sightings.size, 3, 3))
    for side in range(2):
        moves = sides[side] >= 0
        at = tracks.at(robots[side][moves], sightings["stamp_ns"][moves])
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
