"""Have the estimator's inner loops compiled before data comes; messages would be lost meanwhile."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.core.estimator import SwarmEstimator
from swarm_loc_estimator.core.sightings import CONTENT_POSE_TWO, CONTENT_POSITION
from swarm_loc_estimator.core.swarm import Face, Landmark, Robot, Swarm
from swarm_loc_estimator.io.cdr import DETECTION_DTYPE

_SECOND = 1_000_000_000


def warm_up() -> None:
    """Run a small estimator through all that it does: a minute the first time on a machine, then a second."""
    first = Robot("a", faces=(Face("front", 1, yaw=0.0),), start=(0.0, 0.0, 0.0))
    second = Robot("b", faces=(Face("front", 2, yaw=0.0),))
    estimator = SwarmEstimator(Swarm((first, second), (Landmark(3, x=1.0, yaw=3.0),)))
    detections = np.zeros(3, DETECTION_DTYPE)
    detections["id"] = [2, 3, 3]
    detections["content"] = [CONTENT_POSE_TWO, CONTENT_POSE_TWO, CONTENT_POSITION]
    detections["position"] = [0.0, 0.0, 1.0]
    detections["orientation"] = detections["alternative_orientation"] = [0.0, 1.0, 0.0, 0.1]
    detections["covariance"][:, 0, 0] = -1.0
    for step in range(4):
        now_ns = (10 + step) * _SECOND
        for robot in range(2):
            estimator.add_odometry(robot, now_ns, (0.01 * step, 0.0, 0.0), now_ns)
        estimator.add_detections(0, now_ns - _SECOND // 2, detections, now_ns)
        estimator.tick(now_ns)
