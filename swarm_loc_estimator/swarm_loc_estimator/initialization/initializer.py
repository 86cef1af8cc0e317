"""Initialization of robots whose start is unknown: sightings tie their odometry tracks to the map.

Each sighting between a robot without a pose and a localized side constrains one point of the robot's track
(the place from which it saw the marker, or its own marker) to one point of the map. Two such points determine
the transform in closed form (a rigid alignment); a sighting with heading determines it alone, or twice where
it has a mirrored solution. The transform on which most constraints agree is refined by least squares. It is
accepted when its covariance is small enough and no other transform explains the constraints about as well.
A whole pose by a mapper locates a robot alone: it is an estimate, which its next poses would not confirm.
Measurements of one degree of freedom are collected apart, see `window.py`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.integrity.divergence import CONFIRMED
from swarm_loc_estimator.filter.measurement_model import (
    NOBODY,
    POLAR,
    MeasurementArray,
    MeasurementColumns,
    locates_alone,
)
from swarm_loc_estimator.filter.prediction import new_scratch, predict
from swarm_loc_estimator.filter.state import InitialPose, SwarmState
from swarm_loc_estimator.initialization.alignment import (
    HEADING_SIGMA,
    MIN_CONSTRAINTS,
    POSITION_SIGMA,
    align,
)
from swarm_loc_estimator.initialization.constraints import (
    NO_CONSTRAINTS,
    THE_MAP,
    OtherSide,
    Waiting,
    refreshed,
    with_constraint,
)
from swarm_loc_estimator.initialization.window import (
    NO_WINDOW,
    WINDOW_DTYPE,
    is_redundant,
    locate,
    with_row,
)
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.calibration_states import CAMERA_SCALE, CAMERA_YAW

_INDEPENDENT_NS = 100_000_000  # Sightings of one marker within this time are redundant
_LONGEST_PAUSE_NS = 300_000_000
_PAUSE_SHARE = 8
"""After a failed attempt the robot collects constraints for an eighth of the time that they span.

Counted in stamps, so that attempts do not depend on the order of arrival.
"""
_SHORTEST_WINDOW_PAUSE_NS, _WINDOW_PAUSE_SHARE = 500_000_000, 4
"""The same for windows of measurements of one degree of freedom, whose attempts take longer."""


Keep = Callable[[SwarmState, MeasurementArray], bool]
"""Keeps a measurement (1,); returns whether it helps to locate a robot."""
Located = Callable[[SwarmState, int, InitialPose, Preintegrated, int], None]
"""Called with a robot, the pose of its track, the instant, and how many measurements confirm the pose."""


class Initializer:
    """Collects constraints and initializes robots.

    Args:
        tracks: The robots' odometry.
        window_s: Age up to which a constraint is used.
        heading_sigma: Largest standard deviation of the heading of a robot that is initialized [rad].
    """

    def __init__(self, tracks: OdometryTracks, window_s: float, heading_sigma: float = HEADING_SIGMA) -> None:
        self._heading_sigma = heading_sigma
        self._tracks = tracks
        self._window_ns = int(window_s * 1e9)

    def note(self, state: SwarmState, one: MeasurementArray) -> bool:
        """Keep a measurement (1,) that ties a waiting robot to something located; enough of them locate it.

        Returns:
            Whether the measurement does so.
        """
        observer, target, now_ns = int(one["observer"][0]), int(one["target"][0]), int(one["stamp_ns"][0])
        knows_observer, knows_target = state.is_known(observer), state.is_known(target)
        robot, other = (target, observer) if knows_observer else (observer, target)
        if knows_observer == knows_target or not self._tracks.has_started(robot, now_ns):
            return False
        return self.constrain(state, robot, other, one, SwarmState.initialize)

    def constrain(
        self, state: SwarmState, robot: int, other: int, one: MeasurementArray, located: Located
    ) -> bool:
        """Keep a measurement (1,) between a robot with odometry and a located side.

        Args:
            state: Keeps it.
            robot: The robot.
            other: The located side: a robot, or NOBODY for `map`.
            one: The measurement.
            located: Called when the measurements determine the pose of the robot.

        Returns:
            True.
        """
        observer, now_ns = int(one["observer"][0]), int(one["stamp_ns"][0])
        track = self._tracks.at(np.array([robot]), one["stamp_ns"])
        at = Preintegrated(now_ns, track.covariance[0], track.jacobian[0])
        if locates_alone(MeasurementColumns.of(one), 0) and self._is_sure(one["covariance"][0]):
            located(state, robot, _fixed(one, track.pose[0]), at, CONFIRMED)
            return True
        if one["kind"][0] > POLAR:
            return self._note_partial(state, one, robot, other, at, located)
        old = state.constraints.get(robot, NO_CONSTRAINTS)
        same = old[(old["marker_id"] == one["marker_id"][0]) & (old["other"] == other)]
        if same.size and abs(now_ns - int(same["stamp_ns"][-1])) < _INDEPENDENT_NS:
            return True
        camera = np.zeros(2) if observer == NOBODY else state.parameter[observer, [CAMERA_YAW, CAMERA_SCALE]]
        waiting, seen = Waiting(robot, track.pose[0], at.covariance), self._located(state, other, one)
        constraints = with_constraint(old, one, camera, waiting, seen, self._window_ns)
        state.constraints[robot] = constraints
        few = constraints.size < MIN_CONSTRAINTS or constraints["stamp_ns"][0] == now_ns
        if few or now_ns < state.next_attempt_ns[robot]:
            return True
        initial = align(refreshed(constraints, state.arrays()), at.covariance, self._heading_sigma)
        if initial is not None:
            located(state, robot, initial, at, CONFIRMED)
        else:
            waited_ns = now_ns - int(constraints["stamp_ns"][0])
            state.next_attempt_ns[robot] = now_ns + min(_LONGEST_PAUSE_NS, waited_ns // _PAUSE_SHARE)
        return True

    def _note_partial(
        self,
        state: SwarmState,
        one: MeasurementArray,
        robot: int,
        other: int,
        at: Preintegrated,
        located: Located,
    ) -> bool:
        """Keep a measurement (1,) of one degree of freedom, see `window.py`."""
        row = np.zeros(1, dtype=WINDOW_DTYPE)
        row["measurement"], row["noise"] = one, at.covariance
        row["track"] = self._tracks.at(np.array([robot]), one["stamp_ns"]).pose
        if other != NOBODY:
            sample = self._tracks.at(np.array([other]), one["stamp_ns"])
            row["other_track"], row["other_noise"] = sample.pose, sample.covariance
        old = state.windows.get(robot, NO_WINDOW)
        if is_redundant(old, row):
            return True
        window = state.windows[robot] = with_row(old, row, self._window_ns)
        if at.stamp_ns < state.next_window_ns[robot]:
            return True
        first_ns = int(window["measurement"]["stamp_ns"][0])
        state.next_window_ns[robot] = at.stamp_ns + max(
            _SHORTEST_WINDOW_PAUSE_NS, (at.stamp_ns - first_ns) // _WINDOW_PAUSE_SHARE
        )
        initial = locate(state, robot, window, at.covariance, self._heading_sigma)
        if initial is not None:
            located(state, robot, initial, at, 0)
        return True

    def _is_sure(self, covariance: FloatArray) -> bool:
        """Whether a pose with a covariance (3, 3) may initialize a robot."""
        x, y, heading = np.sqrt(np.diag(covariance)).tolist()
        return bool(max(x, y) < POSITION_SIGMA and heading < self._heading_sigma)

    def _located(self, state: SwarmState, other: int, one: MeasurementArray) -> OtherSide:
        """The side of a measurement (1,) that is located, brought up to its stamp."""
        landmark = int(one["landmark"][0]) - 1
        if landmark >= 0:
            moved = state.landmark[landmark].copy()
            return OtherSide(NOBODY, landmark, moved, moved, np.zeros((3, 3)))
        if other == NOBODY:
            return THE_MAP
        sample = self._tracks.at(np.array([other]), one["stamp_ns"])
        at = Preintegrated(int(one["stamp_ns"][0]), sample.covariance[0], sample.jacobian[0])
        # so that how it erred until now is shared by all that are located by it
        predict(state.arrays(), other, at, new_scratch())
        transform = state.transform[other].copy()
        return OtherSide(other, -1, se2.compose(transform, sample.pose[0]), transform, at.covariance)


def _fixed(one: MeasurementArray, on_track: FloatArray) -> InitialPose:
    """The initial pose of a robot at a pose (3,) on its track by an absolute measurement (1,) of its pose."""
    sensor, value = one["sensor"][0], one["value"][0]
    pose = se2.compose(se2.compose(sensor, value), se2.inverse(one["marker"][0]))
    carry = se2.adjoint(sensor)  # from errors seen by the sensor to errors in map
    covariance = carry @ se2.error_covariance(value, one["covariance"][0]) @ carry.T
    return InitialPose(se2.compose(pose, se2.inverse(on_track)), covariance)
