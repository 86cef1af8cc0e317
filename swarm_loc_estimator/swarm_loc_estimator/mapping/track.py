"""What the mapper knows of one robot on its way."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.mapping.exploration import Goal
from swarm_loc_estimator.mapping.stops import MotionTracker, ScanStop


class Located(NamedTuple):
    """Where a robot was: its pose (3,) in map at a time."""

    stamp_ns: int
    pose: FloatArray


@dataclass
class Track:
    """State of one robot.

    Attributes:
        prior: (3,) start pose.
        prior_sigma: (3,) standard deviations of the start pose.
        motion: Detects stops.
        stop: The current stop.
        node: Its newest stop in the graph.
        is_known: Whether `stop` is in the graph, as `node`.
        passes: Whether the next stop replaces `node` because the graph is full.
        left: (3,) pose by odometry at departure from `node`.
        last: (3,) newest pose by odometry.
        path: Length driven since the departure [m].
        target: (2,) final target position [m].
        goal: Its next stop.
        located: Where its newest scan says that it was.
        home: (2,) old stop to which it returns to reduce its position uncertainty [m].
    """

    prior: FloatArray
    prior_sigma: FloatArray
    motion: MotionTracker = field(default_factory=MotionTracker)
    stop: ScanStop | None = None
    node: int | None = None
    is_known: bool = False
    passes: bool = False
    left: FloatArray = field(default_factory=lambda: np.zeros(3))
    last: FloatArray | None = None
    path: float = 0.0
    target: FloatArray | None = None
    goal: Goal | None = None
    located: Located | None = None
    home: FloatArray | None = None
