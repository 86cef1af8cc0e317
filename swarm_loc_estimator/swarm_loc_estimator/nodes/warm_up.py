"""Have the estimator's inner loops compiled before data comes; messages would be lost meanwhile."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.core.estimator import SwarmEstimator
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.sightings import CONTENT_POSE_TWO, CONTENT_POSITION
from swarm_loc_estimator.core.swarm import Face, Landmark, Robot, Swarm
from swarm_loc_estimator.io.cdr import DETECTION_DTYPE

_SECOND = 1_000_000_000
_FIRST_LANDMARK = 10
_LANDMARKS = 30  # three robots see more than are fused one by one where many may be fused together
_FACING = (0.0, 1.0, 0.0, 0.0)  # x y z w: a marker that looks at the camera
_AWAY = (0.0, 0.7, 0.0, 0.7)


def warm_up() -> None:
    """Run small estimators through all that they do: a minute the first time on a machine, then a second."""
    for fusion_period_s in (0.0, 0.1):
        _run(EstimatorSettings(fusion_period_s=fusion_period_s))


def _run(settings: EstimatorSettings) -> None:
    robots = [Robot(name, faces=(Face("front", k, yaw=0.0),)) for k, name in enumerate("ab")]
    robots.append(Robot("c", faces=(Face("front", 2, yaw=0.0),), start=(0.0, 0.0, 0.0)))
    places = range(_LANDMARKS)
    marks = tuple(Landmark(_FIRST_LANDMARK + k, x=1.0, y=0.2 * k, yaw=3.1) for k in places)
    estimator = SwarmEstimator(Swarm(tuple(robots), marks), settings)
    for step in range(8):
        now_ns = 10 * _SECOND + step * _SECOND // 4
        for robot in range(len(robots)):
            estimator.add_odometry(robot, now_ns, (0.01 * step, 0.0, 0.001 * step), now_ns)
            estimator.add_detections(robot, now_ns - _SECOND // 8, _sight(robot), now_ns)
        # one measurement alone is compiled apart: its columns are contiguous
        estimator.add_detections(0, now_ns - _SECOND // 16, _sight(0)[:1], now_ns)
        estimator.tick(now_ns)


def _sight(observer: int) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    """Detections (d,) of landmarks and a robot: of two solutions, also the wrong one first; one position."""
    detections = np.zeros(_LANDMARKS + 1, DETECTION_DTYPE)
    detections["id"][:_LANDMARKS] = _FIRST_LANDMARK + np.arange(_LANDMARKS)
    detections["id"][_LANDMARKS] = (observer + 1) % 3
    detections["content"] = CONTENT_POSE_TWO
    detections["content"][0] = CONTENT_POSITION
    detections["position"][:, 0] = -0.2 * np.arange(_LANDMARKS + 1)
    detections["position"][:, 2] = 1.0
    detections["orientation"], detections["alternative_orientation"] = _FACING, _AWAY
    detections["orientation"][1], detections["alternative_orientation"][1] = _AWAY, _FACING
    detections["covariance"][:, 0, 0] = -1.0
    return detections
