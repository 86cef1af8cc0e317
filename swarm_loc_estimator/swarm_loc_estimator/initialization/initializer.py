"""Initialization of robots whose start is unknown: sightings tie their odometry tracks to the map.

Each sighting between a robot without a pose and a localized side constrains one point of the robot's track
(the place from which it saw the marker, or its own marker) to one point of the map. Two such points determine
the transform in closed form (a rigid alignment); a sighting with heading determines it alone, or twice where
it has a mirrored solution. The transform on which most constraints agree is refined by least squares. It is
accepted when its covariance is small enough and no other transform explains the constraints about as well.
A whole pose by a mapper locates a robot alone: it is an estimate, which its next poses would not confirm.
Measurements of one component are collected apart, see `window.py`. Robots with a described start begin there.

Robots that only see each other can be located relative to one of them. It becomes the origin when nobody has
a start and nothing absolute has been measured for a while: no landmark, no fix, no aerial image. Others are
initialized by sightings, as with a map; parts of the swarm that have not met yet wait. Absolute measurements
are collected as for a robot without a pose. When they determine the pose of a robot in `map`, all poses move
there with it, as one rigid body.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.filter.measurements import NOBODY, LossReason, Measurements, select
from swarm_loc_estimator.filter.models import MODELS, locates_alone
from swarm_loc_estimator.filter.prediction import new_scratch, predict
from swarm_loc_estimator.filter.sources import CONFIRMED, WELL_CONFIRMED
from swarm_loc_estimator.filter.state import IN_MAP, InitialPose, Meetings, Starts, SwarmState
from swarm_loc_estimator.initialization.alignment import (
    HEADING_SIGMA,
    MIN_CONSTRAINTS,
    POSITION_SIGMA,
    align,
    constraints_of,
)
from swarm_loc_estimator.initialization.window import NO_WINDOW, Window, is_redundant, locate, with_row
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.swarm import Swarm

_MAX_SIGHTINGS, _MAX_PARTIAL = 20, 48  # Maximum number of kept measurements of a robot, by kind
_LONGEST_PAUSE_NS = 300_000_000
_PAUSE_SHARE = 8
"""After a failed attempt the robot collects constraints for an eighth of the time that they span.

Counted in stamps, so that attempts do not depend on the order of arrival.
"""
_SHORTEST_WINDOW_PAUSE_NS, _WINDOW_PAUSE_SHARE = 500_000_000, 4
"""The same for windows of measurements of one degree of freedom, whose attempts take longer."""


Keep = Callable[[SwarmState, Measurements], bool]
"""Keeps a row of measurements; returns whether it helps to locate a robot."""
Located = Callable[[SwarmState, int, InitialPose, Preintegrated, float], None]
"""Called with a robot, the pose of its track, the instant, and how many measurements confirm the pose."""


class Initializer:
    """Collects constraints of robots, which are used up to an age of `window_s`, and initializes these.

    `heading_sigma` is the largest standard deviation of the heading of a robot that is initialized [rad]; one
    without odometry may have any, because its heading carries it nowhere.
    """

    def __init__(self, tracks: OdometryTracks, window_s: float, heading_sigma: float = HEADING_SIGMA) -> None:
        self._heading_sigma = np.where(tracks.arrays.is_stationary, np.inf, heading_sigma)
        self._tracks = tracks
        self._window_ns = int(window_s * 1e9)

    def note(self, state: SwarmState, one: Measurements) -> bool:
        """Keep a measurement if it ties a waiting robot to something located; enough of them locate it."""
        observer, target, now_ns = int(one.observer), int(one.target), int(one.stamp_ns)
        knows_observer, knows_target = state.is_known(observer), state.is_known(target)
        robot, other = (target, observer) if knows_observer else (observer, target)
        if knows_observer == knows_target or not self._tracks.has_started(robot, now_ns):
            return False
        return self.constrain(state, robot, other, one, SwarmState.initialize)

    def constrain(
        self, state: SwarmState, robot: int, other: int, one: Measurements, located: Located
    ) -> bool:
        """Keep a measurement between a robot with odometry and a located side: a robot, or NOBODY for `map`.

        `located` is called when the measurements determine the pose of the robot. Returns True.
        """
        now_ns = int(one.stamp_ns)
        track = self._tracks.at(np.array([robot]), np.array([now_ns]))
        at = Preintegrated(now_ns, track.covariance[0], track.jacobian[0])
        x, y, heading = np.sqrt(np.diag(one.covariance)).tolist()
        is_sure = max(x, y) < POSITION_SIGMA and heading < self._heading_sigma[robot]
        if is_sure and locates_alone(one.columns(), 0):
            located(state, robot, _fixed(one, track.pose[0]), at, CONFIRMED + 1.0)
            return True
        # keep it with the tracks of both sides
        is_partial = MODELS[int(one.model)].initializes != "alone"
        other_track, other_noise = np.zeros((1, 3)), np.zeros((1, 3, 3))
        if other != NOBODY:
            sample = self._tracks.at(np.array([other]), np.array([now_ns]))
            other_track, other_noise = sample.pose, sample.covariance
        row = Window(one.columns(), track.pose, track.covariance, other_track, other_noise)
        old = state.windows.get((robot, is_partial), NO_WINDOW)
        if is_redundant(old, row):
            return True
        if other != NOBODY and not is_partial:
            # so that how it erred until now is shared by all that are located by it
            reached = Preintegrated(now_ns, sample.covariance[0], sample.jacobian[0])
            predict(state.arrays(), other, reached, new_scratch())
        most = _MAX_PARTIAL if is_partial else _MAX_SIGHTINGS
        window = state.windows[robot, is_partial] = with_row(old, row, self._window_ns, most)
        # try, though not at every measurement
        waited_ns = now_ns - int(window.measured.stamp_ns[0])
        is_early = not is_partial and (window.size < MIN_CONSTRAINTS or not waited_ns)
        if is_early or now_ns < state.next_attempt_ns[robot, int(is_partial)]:
            return True
        largest = self._heading_sigma[robot]
        if is_partial:
            pause_ns = max(_SHORTEST_WINDOW_PAUSE_NS, waited_ns // _WINDOW_PAUSE_SHARE)
            initial = locate(state, robot, window, at.covariance, largest)
        else:
            pause_ns = min(_LONGEST_PAUSE_NS, waited_ns // _PAUSE_SHARE)
            initial = align(constraints_of(window, robot, state.arrays()), at.covariance, largest)
        if initial is not None:
            located(state, robot, initial, at, 0.0 if is_partial else CONFIRMED)
        else:
            state.next_attempt_ns[robot, int(is_partial)] = now_ns + pause_ns
        return True


def _fixed(one: Measurements, on_track: FloatArray) -> InitialPose:
    """The initial pose of a robot at a pose (3,) on its track by an absolute measurement of its pose."""
    pose = se2.compose(se2.compose(one.sensor, one.value), se2.inverse(one.marker))
    carry = se2.adjoint(one.sensor)  # from errors seen by the sensor to errors in map
    covariance = carry @ se2.error_covariance(one.value, one.covariance) @ carry.T
    return InitialPose(se2.compose(pose, se2.inverse(on_track)), covariance)


class ConfiguredStarts:
    """Initializes robots, by their odometry, at their configured starts."""

    def __init__(self, swarm: Swarm, tracks: OdometryTracks) -> None:
        self._tracks = tracks
        self._has_start = np.array([r.start is not None for r in swarm.robots], dtype=bool)
        self._start: FloatArray = np.array([r.start or (0.0, 0.0, 0.0) for r in swarm.robots]).reshape(-1, 3)
        sigma = [(r.start_sigma.x, r.start_sigma.y, r.start_sigma.theta) for r in swarm.robots]
        self._start_variance: FloatArray = np.square(sigma).reshape(-1, 3)

    def with_starts(self, state: SwarmState, stamp_ns: int) -> SwarmState:
        """State in which robots without any measurement are initialized at their starts.

        Robots that are random walks are excluded, because the start of their motion is unknown.
        """
        robots = np.flatnonzero(state.start_pending)
        ready = robots[~self._tracks.is_random_walk(robots) & self._may_start(state, robots, stamp_ns)]
        if ready.size:
            state = state.copy()
            self._initialize(state, ready, np.full(ready.size, stamp_ns))
        return state

    def initialize_pending(self, state: SwarmState, stamp_ns: int) -> None:
        """Initialize all pending robots with odometry before an instant."""
        robots = np.flatnonzero(state.start_pending)
        ready = robots[self._may_start(state, robots, stamp_ns)]
        if ready.size:
            self._initialize(state, ready, np.full(ready.size, stamp_ns))

    def _may_start(self, state: SwarmState, robots: IntArray, stamps_ns: IntArray | int) -> BoolArray:
        """Whether robots (k,) are pending and have odometry before instants (k,)."""
        pending: BoolArray = state.start_pending[robots] & self._has_start[robots]
        return pending & self._tracks.has_started(robots, stamps_ns)

    def _initialize(self, state: SwarmState, robots: IntArray, stamps_ns: IntArray) -> None:
        """Initialize robots (k,) at the start of their tracks, random walks at `stamps_ns`."""
        tracks, start, walks = self._tracks.arrays, self._start[robots], self._tracks.is_random_walk(robots)
        transform = se2.compose(start, se2.inverse(tracks.begin_pose[robots]))
        error = se2.error_covariance(start, self._start_variance[robots][:, :, None] * np.eye(3))
        begun_ns = np.where(walks, stamps_ns, tracks.begin_ns[robots])
        covariance, jacobian = self._tracks.at(robots, stamps_ns)[2:4]
        covariance[~walks], jacobian[~walks] = 0.0, 0.0  # nothing is preintegrated at the start of a track
        state.start(robots, Starts(transform, error, begun_ns, covariance, jacobian))

    def initialize_measured(self, state: SwarmState, measurements: Measurements) -> bool:
        """Initialize pending robots of measurements (m,) at their starts; return whether there were any.

        Not earlier: when the first odometry of a robot arrives late, only its measurements are fused again.
        """
        initialized = False
        for side in ("observer", "target"):
            # NOBODY (-1) is the last element
            new = np.append(state.start_pending, False)[getattr(measurements, side)]
            robots, stamps_ns = getattr(measurements, side)[new], measurements.stamp_ns[new]
            ready = self._may_start(state, robots, stamps_ns)
            chosen_robots, first = np.unique(robots[ready], return_index=True)
            if chosen_robots.size:
                self._initialize(state, chosen_robots, stamps_ns[ready][first])
                initialized = True
        return initialized


_ORIGIN_SIGMA = 1e-4
"""Standard deviation of the pose of the origin [m, rad]; not zero, so that its covariance is invertible."""


def is_absolute(measurements: Measurements) -> BoolArray:
    """Whether measurements (m,) tie a robot to `map`: fixes and landmarks."""
    alone = (measurements.observer == NOBODY) | (measurements.target == NOBODY)
    return np.asarray(alone | (measurements.landmark != NOBODY))


class LocalFrame:
    """Begins a local frame, unless a robot has a start, and moves its robots to `map`.

    `initializer` locates robots there. The frame begins `after_s` after first sightings between robots [s];
    0: never.
    """

    def __init__(
        self, swarm: Swarm, tracks: OdometryTracks, initializer: Initializer, after_s: float
    ) -> None:
        self._is_wanted = after_s > 0.0 and all(robot.start is None for robot in swarm.robots)
        self._after_ns = round(after_s * 1e9)
        self._tracks, self._initializer = tracks, initializer

    def parts(self, state: SwarmState, measurements: Measurements) -> Iterator[tuple[slice, bool]]:
        """Split measurements (m,) by what may be done with them, as the state changes in between.

        Yields:
            Parts in order, and whether a part is one absolute measurement of a swarm in a local frame. All
            others are to be fused in the frame of the poses.
        """
        if state.origin == IN_MAP and not self._may_begin(state):
            yield slice(None), False
            return
        begin, absolute = 0, is_absolute(measurements)
        while begin < measurements.size:
            end = measurements.size
            if state.origin != IN_MAP:
                other = np.flatnonzero(absolute[begin:])
                end = begin + 1 if absolute[begin] else begin + int(other[0]) if other.size else end
                yield slice(begin, end), bool(absolute[begin])
                if not state.tracked.any():
                    self.leave(state, int(measurements.stamp_ns[end - 1]))
            else:
                rest = select(measurements, slice(begin, None))
                end = begin + self._first_local(state, rest, absolute[begin:])
                if end > begin:
                    yield slice(begin, end), False
                if end < measurements.size and not state.tracked.any():
                    self._begin(state, int(measurements.stamp_ns[end]))
            begin = end

    def _may_begin(self, state: SwarmState) -> bool:
        return self._is_wanted and not state.tracked.any()

    def _first_local(self, state: SwarmState, measurements: Measurements, absolute: BoolArray) -> int:
        """Note which robots have met; index of the first measurement (of m) for a local frame, m if none."""
        if not self._may_begin(state):
            return measurements.size
        for k, stamp_ns in enumerate(measurements.stamp_ns.tolist()):
            if absolute[k]:
                state.meetings = Meetings()
                continue
            pair = (int(measurements.observer[k]), int(measurements.target[k]))
            if not self._tracks.has_started(np.array(pair), stamp_ns).all():
                continue
            first_ns = state.meetings.first_ns if state.meetings.pairs else stamp_ns
            if pair not in state.meetings.pairs:
                state.meetings = Meetings(first_ns, state.meetings.pairs | {pair})
            if stamp_ns - first_ns >= self._after_ns:
                return k
        return measurements.size

    def _begin(self, state: SwarmState, stamp_ns: int) -> None:
        """Initialize the best connected robot at the origin."""
        partners = {frozenset(pair) for pair in state.meetings.pairs}
        count = Counter(robot for pair in sorted(map(sorted, partners)) for robot in pair)
        robot = max(sorted(count), key=lambda one: count[one])
        track = self._tracks.at(np.array([robot]), np.array([stamp_ns]))
        initial = InitialPose(se2.inverse(track.pose[0]), _ORIGIN_SIGMA**2 * np.eye(3))
        at = Preintegrated(stamp_ns, track.covariance[0], track.jacobian[0])
        state.initialize(robot, initial, at, WELL_CONFIRMED)
        state.origin, state.meetings = robot, Meetings()

    def collect(self, state: SwarmState, one: Measurements) -> bool:
        """Keep an absolute measurement of a swarm in a local frame, if it is one; enough move it to `map`."""
        robot = int(max(one.observer, one.target))
        if not self._tracks.has_started(robot, int(one.stamp_ns)):
            return False
        return self._initializer.constrain(state, robot, NOBODY, one, self.move_to_map)

    def move_to_map(
        self,
        state: SwarmState,
        robot: int,
        initial: InitialPose,
        at: Preintegrated,
        confirmed: float = CONFIRMED,
    ) -> None:
        """Move all robots to `map` with a robot whose pose there is known.

        Where it is not among the located ones, or the filter is sparse, the others are deinitialized.
        """
        state.origin, state.frame_moves = IN_MAP, state.frame_moves + 1
        if state.tracked[robot] and state.filter.is_dense:
            predict(state.arrays(), robot, at, new_scratch())
            state.move(robot, initial)
        else:
            self.leave(state, at.stamp_ns)
            state.initialize(robot, initial, at, confirmed)

    @staticmethod
    def leave(state: SwarmState, stamp_ns: int) -> None:
        """Deinitialize all robots of a local frame."""
        state.origin = IN_MAP
        for other in np.flatnonzero(state.tracked).tolist():
            state.deinitialize(other, LossReason.FRAME, stamp_ns)
        state.windows.clear()
