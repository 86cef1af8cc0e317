"""Locating a robot from nothing: sightings that tie its odometry track to the map.

Each sighting between a waiting robot and something located says that one point of the robot's track (the
place where it saw the marker, or its own marker) lies at one point of the map. Two such points give the
transform in closed form (a rigid alignment); a sighting with heading gives it alone, with a mirrored
solution it gives two. The transform on which most clues agree is refined by least squares and accepted when
it is sure, and when no other one explains the clues about as well.
"""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.core import se2
from swarm_loc_estimator.core.clues import NO_CLUES, THE_MAP, OtherSide, refreshed, with_clue
from swarm_loc_estimator.core.locate import LEAST_CLUES, locate
from swarm_loc_estimator.core.measurements import NOBODY, MeasurementArray
from swarm_loc_estimator.core.motion import NOISE
from swarm_loc_estimator.core.odometry import OdometryTracks
from swarm_loc_estimator.core.parameters import CAMERA_SCALE, CAMERA_YAW
from swarm_loc_estimator.core.prediction import advance
from swarm_loc_estimator.core.state import SwarmState

_LONGEST_PAUSE_NS = 300_000_000
_PAUSE_SHARE = 8
"""After a vain attempt the robot collects more clues, for an eighth of the time that its clues span.

Counted in stamps, so that attempts do not depend on the order of arrival.
"""


class ClueBook:
    """Collects clues and lets robots enter.

    Args:
        tracks: The robots' odometry.
        window_s: Age up to which a clue is used.
    """

    def __init__(self, tracks: OdometryTracks, window_s: float) -> None:
        self._tracks = tracks
        self._window_ns = int(window_s * 1e9)

    def note(self, state: SwarmState, one: MeasurementArray) -> bool:
        """Keep a measurement (1,) that ties a waiting robot to something located; enough of them locate it.

        Returns:
            Whether the measurement does so.
        """
        observer, target, now_ns = int(one["observer"][0]), int(one["target"][0]), int(one["stamp_ns"][0])
        knows_observer, knows_target = (side == NOBODY or state.tracked[side] for side in (observer, target))
        robot, other = (target, observer) if knows_observer else (observer, target)
        if knows_observer == knows_target or not self._tracks.begun(robot, now_ns):
            return False
        track = self._tracks.at(np.array([robot]), one["stamp_ns"])
        pose, gathered = track.pose[0], track.gathered[0]
        camera = np.zeros(2) if observer == NOBODY else state.parameter[observer, [CAMERA_YAW, CAMERA_SCALE]]
        old = state.clues.get(robot, NO_CLUES)
        seen = self._located(state, other, one)
        clues = with_clue(old, one, camera, robot, pose, gathered[NOISE], seen, self._window_ns)
        state.clues[robot] = clues
        few = clues.size < LEAST_CLUES or clues["stamp_ns"][0] == now_ns
        if few or now_ns < state.next_attempt_ns[robot]:
            return True
        fix = locate(refreshed(clues, state.arrays()), gathered[NOISE])
        if fix is not None:
            state.enter(robot, fix.transform, fix.covariance, gathered, now_ns, fix.columns, fix.shares)
        else:
            waited_ns = now_ns - int(clues["stamp_ns"][0])
            state.next_attempt_ns[robot] = now_ns + min(_LONGEST_PAUSE_NS, waited_ns // _PAUSE_SHARE)
        return True

    def _located(self, state: SwarmState, other: int, one: MeasurementArray) -> OtherSide:
        """The side of a measurement (1,) that is located, brought up to its stamp."""
        landmark = int(one["landmark"][0]) - 1
        if landmark >= 0:
            moved = state.landmark[landmark].copy()
            return OtherSide(NOBODY, state.landmark_column(landmark), moved, moved, np.zeros((3, 3)))
        if other == NOBODY:
            return THE_MAP
        sample = self._tracks.at(np.array([other]), one["stamp_ns"])
        gathered = sample.gathered[0]
        # so that how it erred until now is shared by all that are located by it
        advance(state.arrays(), other, gathered, int(one["stamp_ns"][0]))
        transform = state.transform[other].copy()
        return OtherSide(other, 3 * other, se2.compose(transform, sample.pose[0]), transform, gathered[NOISE])
