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
    """State of one robot."""

    prior: FloatArray  # (3,) start pose
    prior_sigma: FloatArray  # (3,) standard deviations of the start pose
    motion: MotionTracker = field(default_factory=MotionTracker)  # Detects stops
    stop: ScanStop | None = None  # The current stop
    node: int | None = None  # Its newest stop in the graph
    is_known: bool = False  # Whether `stop` is in the graph, as `node`
    passes: bool = False  # Whether the next stop replaces `node` because the graph is full
    # (3,) pose by odometry at departure from `node`
    left: FloatArray = field(default_factory=lambda: np.zeros(3))
    last: FloatArray | None = None  # (3,) newest pose by odometry
    path: float = 0.0  # Length driven since the departure [m]
    target: FloatArray | None = None  # (2,) final target position [m]
    goal: Goal | None = None  # Its next stop
    located: Located | None = None  # Where its newest scan says that it was
    home: FloatArray | None = None  # (2,) old stop to which it returns to reduce its position uncertainty [m]
