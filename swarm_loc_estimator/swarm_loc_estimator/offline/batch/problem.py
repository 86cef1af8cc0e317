"""What a batch solves: the instants at which it estimates poses, sightings, and their derivatives.

A robot's pose is X(t) = T(t) O(t) with the odometry track O, see `odometry/tracks.py`. Where wheels do not
slip, T is constant, so it is estimated only at a few instants per second, the knots. A sighting in between
uses the nearest of them; what the wheels may have slipped since then is added to its noise.

Derivatives by parameters of the description are differences of the product's own models, from readings to
tracks and measurements, so that whatever a description states can be estimated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.filter.measurements import NO_MEASUREMENTS, Measurements, concatenate, select
from swarm_loc_estimator.filter.models import MODELS, POLAR, RANGE, angles, is_compiled
from swarm_loc_estimator.odometry.track_arrays import OdometrySample
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.sensors.camera import CONTENT_POSE, CONTENT_POSE_TWO
from swarm_loc_estimator.sensors.fix import NO_FIXES
from swarm_loc_estimator.sensors.inputs import Batch, InputConverter
from swarm_loc_estimator.swarm.calibration_states import (
    CAMERA_YAW,
    CONTRADICTED_SURVEY_SIGMA,
    TURN_BIAS,
    ParameterTable,
)
from swarm_loc_estimator.swarm.error_models import ImuModel, OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Landmark, Robot, Swarm, UwbDevice
from swarm_loc_estimator.timeline.settings import Settings

_SECTIONS = {
    "odometry": OdometryModel,
    "imu": ImuModel,
    "camera": CameraMount,
    "sensor": SensorModel,
    "uwb": UwbDevice,
}


class Parameter(NamedTuple):
    """A number of a robot's description."""

    section: str  # Of the description
    name: str  # In this section
    sigma: float  # Standard deviation of the prior

    @property
    def moves(self) -> bool:
        """Whether it changes the motion, not what the camera measures."""
        return self.section in {"odometry", "imu"}

    def of(self, robot: Robot) -> float:
        """The number of a robot; NaN: it has no such section."""
        return float(getattr(getattr(robot, self.section), self.name, np.nan))


def _each(section: str, **sigma: float) -> tuple[Parameter, ...]:
    """Parameters of a section by name, with their prior standard deviations."""
    return tuple(Parameter(section, name, value) for name, value in sigma.items())


SURVEY = (
    *_each("odometry", turn_bias=0.01, distance_scale=0.03, turn_scale=0.05),
    *_each("imu", turn_bias=0.01, turn_scale=0.05),
    *_each("camera", yaw=0.05),
    *_each("sensor", distance_scale=0.02, range_offset=0.1),
)
"""What a survey corrects."""
_MOTION = (
    *_each("odometry", turn_bias=0.02, distance_scale=0.1, turn_scale=0.1, delay_s=0.1),
    *_each("imu", turn_bias=0.01, turn_scale=0.05),
)
_BODY = _each("odometry", course_offset=0.05, axle_offset=0.05)
_MOUNT = (*_each("camera", x=0.03, y=0.02), *_each("sensor", time_offset_s=0.03))
_POLAR = (
    *_each("sensor", range_log_scale=0.1, range_skew=0.05, range_curve=0.5, range_offset=0.1),
    *_each("sensor", robot_range_offset=0.05, bearing_offset=0.1, bearing_scale=0.1, bearing_curve=0.1),
)
_POSES = (*_each("camera", yaw=0.1), *_each("sensor", distance_scale=0.05))
_RADIO = _each("uwb", range_bias=0.2, range_scale=0.02)


def calibrated_parameters(*, polar: bool, poses: bool, ranges: bool, truth: bool) -> tuple[Parameter, ...]:
    """What a calibration estimates of robots that see markers as ranges and bearings or poses, or anchors.

    Where base_link is on a robot only ground truth tells; without it, it is where odometry has it.
    """
    seen = (*(_POLAR if polar else ()), *(_POSES if poses else ()), *(_RADIO if ranges else ()))
    return (*_MOTION, *(_BODY if truth else ()), *_MOUNT, *seen)


def values_of(swarm: Swarm, parameters: Sequence[Parameter]) -> FloatArray:
    """The numbers (N, p) of all robots; NaN: it has no such section."""
    return np.array([[one.of(robot) for one in parameters] for robot in swarm.robots])


def corrections(before: Swarm, found: Swarm, parameters: Sequence[Parameter]) -> list[str]:
    """A sentence for each robot of which some parameters were corrected."""
    lines = []
    for old, new in zip(before.robots, found.robots, strict=True):
        pairs = [(f"{one.section}.{one.name}", one.of(old), one.of(new)) for one in parameters]
        said = [f"{key} {a:.4f} -> {b:.4f}" for key, a, b in pairs if abs(b - a) > 0.0]
        if said:
            lines.append(f"Corrected for {new.name}: {', '.join(said)}.")
    return lines


_PLACE = ("x", "y", "yaw", "range_bias")  # What tells where a body is


def moved(before: Swarm, found: Swarm) -> list[str]:
    """A sentence for each described body that was found elsewhere."""
    lines = []
    for old, new in zip(before.surveyed, found.surveyed, strict=True):
        pairs = ((key, getattr(old, key, None), getattr(new, key, None)) for key in _PLACE)
        said = [
            f"{key} {a:.4f} -> {b:.4f}" for key, a, b in pairs if a is not None and b is not None and a != b
        ]
        if said:
            lines.append(f"Placed {new.title}: {', '.join(said)}.")
    return lines


def all_changed(swarm: Swarm, parameters: Sequence[Parameter], change: FloatArray) -> Swarm:
    """The swarm with parameters of its robots changed by (N, p), within the ranges of a description."""
    robots = [_changed(robot, parameters, row) for robot, row in zip(swarm.robots, change, strict=True)]
    return replace(swarm, robots=tuple(robots))


def opened(mark: Landmark) -> Landmark:
    """A landmark that may be as far from its described place as the filter takes contradicted ones to be."""
    position_sigma, yaw_sigma = CONTRADICTED_SURVEY_SIGMA
    if mark.is_estimated:
        return mark
    return replace(mark, position_sigma=position_sigma, yaw_sigma=yaw_sigma)


def _changed(robot: Robot, parameters: Sequence[Parameter], change: FloatArray) -> Robot:
    new: dict[str, dict[str, float]] = {}
    for one, step in zip(parameters, change.tolist(), strict=True):
        if step and getattr(robot, one.section) is not None:
            spec = number_specs(_SECTIONS[one.section])[one.name]
            new.setdefault(one.section, {})[one.name] = min(max(one.of(robot) + step, spec.low), spec.high)
    return replace(robot, **{name: replace(getattr(robot, name), **values) for name, values in new.items()})


STEP_NS = 100_000_000  # Shortest time between two instants at which the transform of a track is estimated
MAX_KNOTS = 12_000  # Maximum number of these instants, of all robots; those of long bags are farther apart
_MOMENT_NS = 1_000_000  # Time over which a speed is measured
_WITH_POSE = (CONTENT_POSE, CONTENT_POSE_TWO)
MIN_SIGHTINGS = 5  # Minimum number of sightings of a marker that is to be a landmark


@dataclass(frozen=True)
class Knots:
    """Instants at which transforms of tracks are estimated (k,), by robot and stamp."""

    robot: IntArray  # (k,) index of the robot
    stamp_ns: IntArray  # (k,) the instants
    sample: OdometrySample  # (k,) the tracks there
    step_ns: int  # Time between them

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


class TruePoses(NamedTuple):
    """True poses (t,), at most one near a knot."""

    knot: IntArray  # (t,) nearest knot
    track: FloatArray  # (t, 3) poses on the tracks at their stamps
    pose: FloatArray  # (t, 3) in `map`


class Drift(NamedTuple):
    """Errors of a robot that change slowly (Gauss-Markov): of its turn rate [rad/s], of its camera's yaw."""

    sigma: FloatArray  # (N, 2) standard deviations
    time_s: FloatArray  # (N, 2) time constants
    turn: FloatArray  # (k, 3) right-invariant errors of tracks at knots by an error of the turn rate


class Derivatives(NamedTuple):
    """Derivatives by the p parameters of the robot, or of the observer."""

    knots: FloatArray  # (k, 3, p) right-invariant errors of tracks at knots
    value: FloatArray  # (m, 3, p) values of sightings
    # (m, p) growth of a corrected distance with the measured one; noise grows as much
    growth: FloatArray
    # (2, m, 3, p) right-invariant errors of the poses on tracks of observer and target, by mount and exposure
    tracks: FloatArray


@dataclass(frozen=True)
class BatchProblem:
    """What is to be solved."""

    # The description with a landmark for each marker that belongs to nobody, at the origin where its place is
    # not known
    swarm: Swarm
    is_known: BoolArray  # (S,) whether a place of `Swarm.surveyed` is described
    knots: Knots  # Instants at which transforms are estimated
    true: TruePoses  # By ground truth
    # (m,) measurements; markers of landmarks are in the landmark's own frame
    sightings: Measurements
    source: IntArray  # (m,) their indices among all
    sides: IntArray  # (m, 2) knots of observer and target; -1: no robot
    tracks: FloatArray  # (2, m, 3) poses of observer and target on their tracks
    slip: FloatArray  # (2, m, 3, 3) covariance of their slip since the knot, in the frame of the track
    odometry: OdometryTracks  # The tracks
    rare: dict[int, int]  # Number of sightings by id, of markers that were seen too rarely
    parameters: tuple[Parameter, ...]  # Of robots, that are estimated
    by_parameter: Derivatives
    drift: Drift | None = None  # None: there is none

    @property
    def is_polar(self) -> BoolArray:
        """Whether sightings (m,) are range and bearing."""
        return np.asarray(self.sightings.model == POLAR)

    @property
    def is_by_robot(self) -> BoolArray:
        """Whether measurements (m,) are those of a robot."""
        return np.asarray(self.sightings.observer >= 0)

    @property
    def is_seen(self) -> BoolArray:
        """Whether measurements (m,) are sightings of places by a camera."""
        return is_compiled(self.sightings.model)

    def poses(
        self, rows: IntArray, knot: FloatArray, place: FloatArray, track: FloatArray
    ) -> list[FloatArray]:
        """Poses (2, r, 3) of observers and targets of some measurements (r,), of nobody the origin.

        Args:
            rows: (r,) which.
            knot: (k, 3) transforms of tracks at knots.
            place: (S, 3) poses or corrections of what was surveyed.
            track: (2, r, 3) poses on tracks.
        """
        fixed, found = np.vstack([place, np.zeros(3)]), []
        bodies = self.sightings.mount[rows], self.sightings.landmark[rows]
        for side, body, on_track in zip(self.sides[rows].T, bodies, track, strict=True):
            moving = se2.compose(knot[side], on_track)
            found.append(np.where((side >= 0)[:, None], moving, fixed[body]))  # -1, nobody, is the last row
        return found


def problem_of(
    recording: Recording,
    swarm: Swarm,
    parameters: tuple[Parameter, ...] = (),
    truth: Mapping[str, Trajectory] | None = None,
    *,
    fixed: bool = False,
    is_described: bool = False,
) -> BatchProblem:
    """Set up the problem of a recording; landmarks in the description, and poses of `truth`, are known.

    Measurements are sightings by cameras of robots, of markers that belong to nobody, too, and if `fixed`
    those by described cameras and the ranges to described anchors. Where all `is_described`, they are those
    of all sensors, and such markers are not used.
    """
    # knots, and measurements by robots whose tracks are known then
    described, rare, seen = swarm, dict[int, int](), recording
    if not is_described:
        described, rare = _with_landmarks(recording, swarm)
        if not fixed:
            described = replace(described, anchors=(), cameras=())
        rows = recording.detections
        wanted = ~np.isin(rows.detection["id"], list(rare)) & (rows.robot < len(described.sources))
        seen = replace(recording, detections=select(rows, wanted), fixes=NO_FIXES)
    tracks, sightings = _tracks(recording, swarm), _measured(seen, described)
    knots = _knots(tracks, recording, swarm, sightings, is_described)
    robots = np.stack([sightings.observer, sightings.target])
    sides = np.stack([knots.nearest(one, sightings.stamp_ns) for one in robots])
    started = np.array([tracks.has_started(np.maximum(one, 0), sightings.stamp_ns) for one in robots])
    near = np.abs(sightings.stamp_ns - knots.stamp_ns[sides]) <= 2 * knots.step_ns
    kept: BoolArray = np.asarray(((robots < 0) | (started & (sides >= 0) & near)).all(axis=0))
    if not is_described:  # not directions alone, nor what two radios of robots measure, of which both may err
        to_anchor = (sightings.model == RANGE) & (sightings.target < 0)
        kept &= is_compiled(sightings.model) | to_anchor
    sightings, sides = select(sightings, kept), sides[:, kept]
    # where these robots are on their tracks, and the slip since the knot, with the motion by errors of stamps
    poses, slip = _on_tracks(tracks, sightings, sightings.stamp_ns), np.zeros((2, sightings.size, 3, 3))
    later = _on_tracks(tracks, sightings, sightings.stamp_ns + _MOMENT_NS)
    rate = se2.log(se2.compose(later, se2.inverse(poses))) / (1e-9 * _MOMENT_NS)
    for side, robot in enumerate((sightings.observer, sightings.target)):
        moves = sides[side] >= 0
        at = tracks.at(robot[moves], sightings.stamp_ns[moves])
        since = at.covariance - knots.sample.covariance[sides[side][moves]]
        slip[side, moves] = since * np.sign(np.trace(since, axis1=1, axis2=2))[:, None, None]
        slip[side] += np.einsum("k,ki,kj->kij", sightings.stamp_variance, rate[side], rate[side])
    known = {mark.id for mark in swarm.landmarks}
    places = described.surveyed
    problem = BatchProblem(
        described,
        np.array([not isinstance(one, Landmark) or one.id in known for one in places], dtype=bool),
        knots,
        _true(truth or {}, swarm, knots, tracks),
        sightings,
        np.flatnonzero(kept),
        sides.T,
        poses,
        slip,
        tracks,
        rare,
        parameters,
        Derivatives(
            np.zeros((knots.robot.size, 3, len(parameters))),
            np.zeros((sightings.size, 3, len(parameters))),
            np.zeros((sightings.size, len(parameters))),
            np.zeros((2, sightings.size, 3, len(parameters))),
        ),
    )
    if is_described:
        problem = replace(problem, drift=_drift(swarm, knots))
    for index in range(len(parameters)):
        _differentiate(problem, recording, seen, kept, index)
    return problem


_NO_DRIFT = 1e-6  # Standard deviation of what does not change


def _drift(swarm: Swarm, knots: Knots) -> Drift | None:
    table = ParameterTable.of(swarm.robots)
    varies = (table.column >= 0) & np.isfinite(table.time_s)
    if not varies.any():
        return None
    some = [TURN_BIAS, CAMERA_YAW]
    sigma = np.where(varies, table.sigma, _NO_DRIFT)[:, some]
    return Drift(sigma, np.where(varies, table.time_s, 1.0)[:, some], knots.sample.jacobian[:, :, TURN_BIAS])


_STEP = 0.01  # Step of a difference, in standard deviations of the prior


def _differentiate(
    problem: BatchProblem, recording: Recording, seen: Recording, kept: BoolArray, index: int
) -> None:
    """Write the derivatives by one parameter."""
    parameter, by = problem.parameters[index], problem.by_parameter
    step = _STEP * parameter.sigma
    other = all_changed(problem.swarm, (parameter,), np.full((len(problem.swarm.robots), 1), step))
    if parameter.moves:
        sample = problem.knots.sample.pose
        moved = _tracks(recording, other).at(problem.knots.robot, problem.knots.stamp_ns).pose
        by.knots[:, :, index] = se2.log(se2.compose(moved, se2.inverse(sample))) / step
        return
    before, after = problem.sightings, select(_measured(seen, other), kept)
    change = after.value - before.value
    change[:, 2] = se2.wrap_angle(change[:, 2])
    by.value[:, :, index] = change / step
    # how the change differs farther along the ray: of the range, or of forward and left
    detection = seen.detections.detection.copy()
    detection["position"] *= 1.0 + _STEP
    far = replace(seen, detections=seen.detections._replace(detection=detection))
    now = select(_measured(far, problem.swarm), kept).value
    farther = select(_measured(far, other), kept).value - now
    ray = (now - before.value)[:, :2] * np.where(problem.is_polar[:, None], [1.0, 0.0], 1.0)
    along = np.sum((farther - change)[:, :2] * ray, axis=1) / np.maximum(np.sum(ray**2, axis=1), 1e-10)
    by.growth[:, index] = along / step
    # another mount or exposure is that of an observer, or a target, that is elsewhere on its track
    later = _on_tracks(problem.odometry, before, after.stamp_ns)
    later[0] = se2.compose(later[0], se2.compose(after.sensor, se2.inverse(before.sensor)))
    by.tracks[:, :, :, index] = se2.log(se2.compose(later, se2.inverse(problem.tracks))) / step


def _tracks(recording: Recording, swarm: Swarm) -> OdometryTracks:
    tracks = OdometryTracks(swarm.robots)
    rows, turns = recording.odometry, recording.turn_rates
    tracks.extend_turns(turns.robot, turns.stamp_ns, turns.rate)
    tracks.extend(rows.robot, rows.stamp_ns, rows.pose, rows.twist)
    return tracks


def _measured(recording: Recording, swarm: Swarm) -> Measurements:
    """Measurements (m,) of a recording; markers of landmarks are in the landmark's own frame."""
    at_origin = [replace(one, x=0.0, y=0.0, yaw=None if one.yaw is None else 0.0) for one in swarm.landmarks]
    converter = InputConverter(replace(swarm, landmarks=tuple(at_origin)), Settings())
    found = converter.convert(
        Batch.of(
            *recording.range_ns,
            detections=recording.detections,
            fixes=recording.fixes,
            ranges=recording.ranges,
        )
    )
    every: Measurements = concatenate([NO_MEASUREMENTS, *found.rows.values()])
    return select(
        every, np.array([MODELS[one].predict is not None for one in every.model.tolist()], dtype=bool)
    )


def _true(truth: Mapping[str, Trajectory], swarm: Swarm, knots: Knots, tracks: OdometryTracks) -> TruePoses:
    found, track, pose = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))], [np.zeros((0, 3))]
    for index, robot in enumerate(swarm.robots):
        if robot.name not in truth or not (knots.robot == index).any():
            continue
        stamps = truth[robot.name].stamp_ns
        who = np.full(stamps.size, index)
        nearest, rows = np.unique(knots.nearest(who, stamps), return_index=True)
        rows = rows[np.abs(stamps[rows] - knots.stamp_ns[nearest]) <= knots.step_ns]
        found.append(knots.nearest(who[rows], stamps[rows]))
        track.append(tracks.at(who[rows], stamps[rows]).pose)
        pose.append(truth[robot.name].pose[rows])
    return TruePoses(np.concatenate(found), np.concatenate(track), np.concatenate(pose))


def _on_tracks(tracks: OdometryTracks, sightings: Measurements, stamps_ns: IntArray) -> FloatArray:
    """Poses (2, m, 3) of observers and targets on their tracks at instants (m,)."""
    poses = np.zeros((2, sightings.size, 3))
    for side, robot in enumerate((sightings.observer, sightings.target)):
        poses[side, robot >= 0] = tracks.at(robot[robot >= 0], stamps_ns[robot >= 0]).pose
    return poses


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


def _knots(
    tracks: OdometryTracks, recording: Recording, swarm: Swarm, measured: Measurements, standing: bool
) -> Knots:
    """Instants of all robots with odometry, and of `standing` ones that need none and were measured."""
    rows, robots, stamps = recording.odometry, [], []
    spans = {}
    for robot in np.unique(rows.robot).tolist():
        own = rows.stamp_ns[rows.robot == robot]
        spans[robot] = (int(own.min()), int(own.max()))
    for robot in np.flatnonzero([one.stands and standing for one in swarm.robots]).tolist():
        own = measured.stamp_ns[(measured.observer == robot) | (measured.target == robot)]
        if robot not in spans and own.size:
            spans[robot] = (int(own.min()), int(own.max()))
    whole_ns = sum(end - begin for begin, end in spans.values())
    step_ns = max(STEP_NS, whole_ns // MAX_KNOTS)
    for robot, (begin_ns, end_ns) in spans.items():
        # at common times, so that poses of robots that see each other are near in the matrix
        between = np.arange(begin_ns // step_ns + 1, -(-end_ns // step_ns)) * step_ns
        at_ns = np.unique(np.concatenate([[begin_ns], between, [end_ns]]))
        robots.append(np.full(at_ns.size, robot))
        stamps.append(at_ns)
    robot, stamp_ns = np.concatenate(robots), np.concatenate(stamps)
    knots = Knots(robot, stamp_ns, tracks.at(robot, stamp_ns), step_ns)
    # none where the motion is unknown and nothing was measured
    silent = np.zeros(robot.size, dtype=bool)
    for index in spans:
        own, driven = robot == index, np.sort(rows.stamp_ns[rows.robot == index])
        after = np.searchsorted(driven, stamp_ns[own]).clip(1, max(1, driven.size - 1))
        pause_ns = driven[after] - driven[after - 1] if driven.size > 1 else np.zeros(1)
        silent[own] = pause_ns > 1e9 * swarm.robots[index].odometry.timeout_s
    near = np.concatenate(
        [knots.nearest(one, measured.stamp_ns) for one in (measured.observer, measured.target)]
    )
    silent[near[near >= 0]] = False
    return Knots(robot[~silent], stamp_ns[~silent], select(knots.sample, ~silent), step_ns)


def innovation(some: Measurements, measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Measured values (m, 3) minus predicted ones, angles wrapped, zero for a heading without measurement."""
    found = measured - predicted
    found = np.where(angles(some.model), se2.wrap_angle(found), found)
    found[is_compiled(some.model) & ~some.has_heading.astype(bool), 2] = 0.0
    return found
