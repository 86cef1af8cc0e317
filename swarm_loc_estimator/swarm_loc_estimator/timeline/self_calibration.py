"""Export of self-calibration results as a swarm description."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.swarm.calibration_states import (
    CAMERA_OFFSET,
    CAMERA_SCALE,
    CAMERA_YAW,
    DISTANCE_SCALE,
    RADIO_BIAS,
    TURN_BIAS,
    TURN_SCALE,
    ParameterTable,
    found_at,
    moved_place,
    shared_error,
)
from swarm_loc_estimator.swarm.swarm import NO_MAP_ERROR, Anchor, MapError, Robot, Surveyed, Swarm


def learns(swarm: Swarm) -> bool:
    """Whether any parameter or place is described with a standard deviation."""
    lasting = np.delete(ParameterTable.of(swarm.robots).column, TURN_BIAS, axis=1)
    return bool((lasting >= 0).any()) or any(mark.is_estimated for mark in swarm.surveyed)


def learned(swarm: Swarm, state: SwarmState) -> Swarm:
    """Swarm with all estimated parameters and their standard deviations.

    The bias of the turn rate is omitted, because it changes. What places share of their errors is apart.
    """
    error, shared = _shared(swarm, state)
    surveyed: list[Any] = [
        one if state.landmark_column(k) < 0 else found_at(one, *estimated_place(one, k, state), shared[k])
        for k, one in enumerate(swarm.surveyed)
    ]
    marks, anchors = len(swarm.landmarks), len(swarm.landmarks) + len(swarm.anchors)
    return replace(
        swarm,
        robots=tuple(
            _robot(robot, index, state) if state.tracked[index] else robot
            for index, robot in enumerate(swarm.robots)
        ),
        landmarks=tuple(surveyed[:marks]),
        cameras=tuple(surveyed[anchors:]),
        anchors=tuple(surveyed[marks:anchors]),
        map_error=error,
    )


def estimated_place(body: Surveyed, number: int, state: SwarmState) -> tuple[FloatArray, FloatArray]:
    """Where a body is (3,) that is estimated, see `moved_place`, and the covariance (3, 3)."""
    place, covariance = moved_place(body, state.landmark[number]), state.landmark_covariance(number)
    return place, covariance if isinstance(body, Anchor) else se2.pose_covariance(place, covariance)


def swapped_signs(swarm: Swarm) -> list[str]:
    """One sentence for each robot with a negative estimated scale of distance or turn."""
    return [
        f"{robot.name}: its odometry reports the {what} with the wrong sign ({key} is {scale:.3f});"
        f" negate the {what} in its driver."
        for robot in swarm.robots
        for what, key in (("path", "distance_scale"), ("turn", "turn_scale"))
        if (scale := getattr(robot.odometry, key)) < 0.0
    ]


def _robot(robot: Robot, index: int, state: SwarmState) -> Robot:
    """Robot with its estimated parameters."""
    value, sigma = state.parameter[index].tolist(), state.parameter_sigma(index).tolist()
    odometry, camera, sensor, radio = robot.odometry, robot.camera, robot.sensor, robot.uwb
    path, turn, seen = (1.0 + value[which] for which in (DISTANCE_SCALE, TURN_SCALE, CAMERA_SCALE))
    turns = robot.turn_sensor
    turning = {
        "turn_scale": turn * turns.turn_scale,
        "turn_scale_sigma": min(1.0, sigma[TURN_SCALE] / abs(turn)),
    }
    return replace(
        robot,
        odometry=replace(
            odometry,
            distance_scale=path * odometry.distance_scale,
            distance_scale_sigma=min(1.0, sigma[DISTANCE_SCALE] / abs(path)),
            **({} if robot.imu.is_used else turning),
        ),
        imu=replace(robot.imu, **(turning if robot.imu.is_used else {})),
        camera=camera
        and replace(
            camera, yaw=float(se2.wrap_angle(camera.yaw + value[CAMERA_YAW])), yaw_sigma=sigma[CAMERA_YAW]
        ),
        sensor=replace(
            sensor,
            distance_scale=seen * sensor.distance_scale,
            distance_scale_sigma=min(1.0, sigma[CAMERA_SCALE] / abs(seen)),
            range_offset=(sensor.range_offset - value[CAMERA_OFFSET]) / seen,
            range_offset_sigma=sigma[CAMERA_OFFSET] / abs(seen),
        ),
        uwb=radio
        and replace(
            radio,
            range_bias=radio.range_bias + radio.range_scale * value[RADIO_BIAS],
            range_bias_sigma=radio.range_scale * sigma[RADIO_BIAS],
        ),
    )


def _shared(swarm: Swarm, state: SwarmState) -> tuple[MapError, FloatArray]:
    """The error that places share, and errors (S, 3, 4) of these by it; a sparse filter does not know it."""
    shared = np.zeros((len(swarm.surveyed), 3, 4))
    free_places = [
        state.landmark_column(k) >= 0 and one.position_sigma > 0.0 for k, one in enumerate(swarm.surveyed)
    ]
    is_free = np.array(free_places, dtype=bool)
    is_shift = np.array([isinstance(one, Anchor) for one in swarm.surveyed], dtype=bool)
    free, anchors = np.flatnonzero(is_free & ~is_shift), np.flatnonzero(is_free & is_shift)
    place = np.array([(swarm.surveyed[k].x, swarm.surveyed[k].y) for k in free]).reshape(-1, 2)
    if free.size < 2 or not np.ptp(place, axis=0).any() or not state.filter.is_dense:
        return NO_MAP_ERROR, shared
    place = se2.transform_points(state.landmark[free], place)
    columns = [state.landmark_column(k) + np.arange(3) for k in (*free.tolist(), *anchors.tolist())]
    error, places, others = shared_error(place, state.filter.block(np.concatenate(columns)))
    shared[free], shared[anchors] = places, others.reshape(-1, 3, 4)
    return error, shared
