"""A frame without a map: that of the best connected robot, until something absolute is measured.

Robots that only see each other can be located relative to one of them. It becomes the origin when nobody has
a start and nothing absolute has been measured for a while: no landmark, no fix, no aerial image. Others are
initialized by sightings, as with a map; parts of the swarm that have not met yet wait. Absolute measurements
are collected as for a robot without a pose. When they determine the pose of a robot in `map`, all poses move
there with it, as one rigid body.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray
from swarm_loc_estimator.filter.integrity.divergence import CONFIRMED, WELL_CONFIRMED
from swarm_loc_estimator.filter.measurement_model import NOBODY, Command, MeasurementArray
from swarm_loc_estimator.filter.prediction import new_scratch, predict
from swarm_loc_estimator.filter.state import IN_MAP, InitialPose, Meetings, SwarmState
from swarm_loc_estimator.initialization.initializer import Initializer
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.swarm import Swarm

_ORIGIN_SIGMA = 1e-4
"""Standard deviation of the pose of the origin [m, rad]; not zero, so that its covariance is invertible."""


def is_absolute(measurements: MeasurementArray) -> BoolArray:
    """Whether measurements (m,) tie a robot to `map`: fixes, landmarks, and poses set by a user."""
    command, landmark = measurements["command"], measurements["landmark"] > 0
    alone = (measurements["observer"] == NOBODY) | (measurements["target"] == NOBODY)
    return np.asarray((alone | landmark) & (command != Command.FORGET))


class LocalFrame:
    """Begins a local frame, and moves its robots to `map`.

    Args:
        swarm: Robots; where one has a start, there is never a local frame.
        tracks: Odometry of the robots.
        initializer: Locates robots in `map`.
        after_s: Time of sightings between robots after which a local frame begins [s]; 0: never.
    """

    def __init__(
        self, swarm: Swarm, tracks: OdometryTracks, initializer: Initializer, after_s: float
    ) -> None:
        self._is_wanted = after_s > 0.0 and all(robot.start is None for robot in swarm.robots)
        self._after_ns = round(after_s * 1e9)
        self._tracks, self._initializer = tracks, initializer

    def parts(self, state: SwarmState, measurements: MeasurementArray) -> Iterator[tuple[slice, bool]]:
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
                    self.leave(state)
            else:
                end = begin + self._first_local(state, measurements[begin:], absolute[begin:])
                if end > begin:
                    yield slice(begin, end), False
                if end < measurements.size and not state.tracked.any():
                    self._begin(state, int(measurements["stamp_ns"][end]))
            begin = end

    def _may_begin(self, state: SwarmState) -> bool:
        return self._is_wanted and not state.tracked.any()

    def _first_local(self, state: SwarmState, measurements: MeasurementArray, absolute: BoolArray) -> int:
        """Index of the first measurement (of m) that a local frame may use; m if none.

        Notes which robots have met.
        """
        if not self._may_begin(state):
            return measurements.size
        for k, one in enumerate(measurements):
            stamp_ns = int(one["stamp_ns"])
            if absolute[k]:
                state.meetings = Meetings()
                continue
            pair = (int(one["observer"]), int(one["target"]))
            if one["command"] != Command.NONE or not self._tracks.has_started(np.array(pair), stamp_ns).all():
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

    def collect(self, state: SwarmState, one: MeasurementArray) -> bool:
        """Keep an absolute measurement (1,) of a swarm in a local frame; enough of them move it to `map`.

        Returns:
            Whether the measurement does so.
        """
        sides = int(one["observer"][0]), int(one["target"][0])
        robot = max(sides)
        if not self._tracks.has_started(robot, int(one["stamp_ns"][0])):
            return False
        return self._initializer.constrain(state, robot, NOBODY, one, self.move_to_map)

    def move_to_map(
        self,
        state: SwarmState,
        robot: int,
        initial: InitialPose,
        at: Preintegrated,
        confirmations: int = CONFIRMED,
    ) -> None:
        """Move all robots to `map` with a robot whose pose there is known.

        Where it is not among the located ones, or the filter is sparse, the others are deinitialized.
        """
        state.origin, state.frame_moves = IN_MAP, state.frame_moves + 1
        if state.tracked[robot] and state.filter.is_dense:
            predict(state.arrays(), robot, at, new_scratch())
            state.move(robot, initial)
        else:
            self.leave(state)
            state.initialize(robot, initial, at, confirmations)

    @staticmethod
    def leave(state: SwarmState) -> None:
        """Deinitialize all robots of a local frame."""
        state.origin = IN_MAP
        for other in np.flatnonzero(state.tracked).tolist():
            state.deinitialize(other)
        state.constraints.clear()
        state.windows.clear()
