"""Initialization of robots at the start poses of the swarm description."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.filter.measurement_model import MeasurementArray
from swarm_loc_estimator.filter.state import Starts, SwarmState
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.swarm import Swarm


class ConfiguredStarts:
    """Initializes robots at their configured starts.

    Args:
        swarm: Robots with their starts.
        tracks: Odometry of the robots.
    """

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

    def initialize_measured(self, state: SwarmState, measurements: MeasurementArray) -> bool:
        """Initialize pending robots of measurements (m,) at their starts; return whether there were any.

        Not earlier: when the first odometry of a robot arrives late, only its measurements are fused again.
        """
        initialized = False
        for side in ("observer", "target"):
            new = np.append(state.start_pending, False)[measurements[side]]  # NOBODY (-1) is the last element
            robots, stamps_ns = measurements[side][new], measurements["stamp_ns"][new]
            ready = self._may_start(state, robots, stamps_ns)
            chosen_robots, first = np.unique(robots[ready], return_index=True)
            if chosen_robots.size:
                self._initialize(state, chosen_robots, stamps_ns[ready][first])
                initialized = True
        return initialized
