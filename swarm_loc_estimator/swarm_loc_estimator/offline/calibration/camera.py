"""Errors of the sightings of cameras where the poses of robots are known, as described and as calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.filter.measurements import Measurements, select
from swarm_loc_estimator.filter.models import POLAR, predict_any
from swarm_loc_estimator.offline.batch.problem import BatchProblem, innovation
from swarm_loc_estimator.offline.calibration.motion import DENSE_GAP_NS
from swarm_loc_estimator.swarm.swarm import Robot

MIN_SIGHTINGS = 100  # Sightings needed to calibrate a camera


@dataclass(frozen=True)
class CameraFit:
    """Calibration of one robot's camera."""

    robot: Robot  # Calibrated
    sightings: Measurements  # (m,) all of which the truth is known, calibrated
    # (m, 3) measured minus true: range [m] and bearing [rad], or forward, left [m], heading [rad]
    before: FloatArray
    after: FloatArray  # (m, 3) the same errors, calibrated

    @property
    def polar(self) -> BoolArray:
        """Whether sightings (m,) are ranges and bearings."""
        return np.asarray(self.sightings.model == POLAR)

    @property
    def is_enough(self) -> bool:
        """Whether the sightings are enough to calibrate the camera."""
        return self.sightings.size >= MIN_SIGHTINGS


def camera_fits(
    before: BatchProblem, after: BatchProblem, paths: Mapping[str, Trajectory]
) -> list[CameraFit]:
    """The errors of each robot with a camera, by the paths of the robots in `map`."""
    _, old, new = np.intersect1d(before.source, after.source, return_indices=True)
    described, calibrated = errors_of(before, paths)[old], errors_of(after, paths)[new]
    sightings = select(after.sightings, new)
    known = np.isfinite(described[:, 0]) & np.isfinite(calibrated[:, 0])
    fits = []
    for index, robot in enumerate(after.swarm.robots):
        rows = known & after.is_seen[new] & (sightings.observer == index)
        if robot.camera is not None:
            fits.append(CameraFit(robot, select(sightings, rows), described[rows], calibrated[rows]))
    return fits


def errors_of(problem: BatchProblem, paths: Mapping[str, Trajectory]) -> FloatArray:
    """Measured minus true (m, 3) of all measurements; NaN where a pose is not known."""
    sightings = problem.sightings
    marks = [(mark.x, mark.y, mark.yaw or 0.0) for mark in problem.swarm.landmarks]
    marks += [(0.0, 0.0, 0.0)] * len(problem.swarm.anchors)  # neither shifted nor biased
    places = np.where(problem.is_known[:, None], np.array(marks).reshape(-1, 3), np.nan)
    sides = np.full((2, sightings.size, 3), np.nan)
    sides[1, sightings.landmark >= 0] = places[sightings.landmark[sightings.landmark >= 0]]
    for index, robot in enumerate(problem.swarm.robots):
        if robot.name in paths:
            for side, who in enumerate((sightings.observer, sightings.target)):
                rows = np.flatnonzero(who == index)
                pose, known = interpolate(paths[robot.name], sightings.stamp_ns[rows], DENSE_GAP_NS)
                sides[side, rows[known]] = pose[known]
    value = predict_any(sightings, sides[0], sides[1], np.zeros((sightings.size, 3)))[0]
    return innovation(sightings, sightings.value, value)
