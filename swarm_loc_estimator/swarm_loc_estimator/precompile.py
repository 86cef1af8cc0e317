"""Compile the estimator before data comes; messages would be lost meanwhile. No ROS here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from swarm_loc_estimator.common.jit import note_precompiled
from swarm_loc_estimator.common.messages.detections import (
    DETECTION_DTYPE,
    encode_brightness,
    encode_detections,
)
from swarm_loc_estimator.common.messages.message_batch import MessageBatch, SerializedMessage
from swarm_loc_estimator.common.messages.poses import encode_fix, encode_odometry
from swarm_loc_estimator.filter.correlated_noise import PAIR_ROWS, record_pair
from swarm_loc_estimator.filter.integrity.fault_detection import is_kidnapped
from swarm_loc_estimator.filter.measurement_model import MEASUREMENT_DTYPE, MeasurementColumns
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.sensors.camera import CONTENT_POSE_TWO, CONTENT_POSITION
from swarm_loc_estimator.sensors.ingest import Ingest
from swarm_loc_estimator.swarm.board_file import load_ir_platform
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.ir_board import IrMethod, RobotIr
from swarm_loc_estimator.swarm.swarm import Face, Landmark, OdometryModel, Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Settings

_SECOND = 1_000_000_000
_FIRST_LANDMARK = 10
_LANDMARKS = 30  # three robots see more than are fused one by one where many may be fused together
_DROPLET = load_ir_platform("droplet")
_LIGHT = expected_brightness(_DROPLET, (0.1, 0.3, 1.0))[0]
_FACING = (0.0, 1.0, 0.0, 0.0)  # x y z w: a marker that looks at the camera
_AWAY = (0.0, 0.7, 0.0, 0.7)


def precompile() -> None:
    """Run small estimators through all that they do: three minutes unless `is_precompiled`, then a second.

    Infrared comes last: another process may have done `precompile_infrared` by then.
    """
    for infrared in (False, True):
        for fusion_period_s in (0.0, 0.1):
            _run(Settings(fusion_period_s=fusion_period_s), infrared=infrared)
        _run(Settings(sparse_from=2), infrared=infrared)
    note_precompiled(precompile)


def precompile_infrared() -> None:
    """Solve an exchange: that takes a third of the time to compile, and can be done in a process beside."""
    MaximumLikelihood(_DROPLET).solve(_LIGHT[None])


def _run(settings: Settings, *, infrared: bool) -> None:
    robots = [Robot(name, faces=(Face("front", k, yaw=0.0),)) for k, name in enumerate("ab")]
    calibrated = OdometryModel(distance_scale_sigma=0.01)
    robots.append(Robot("c", odometry=calibrated, faces=(Face("front", 2, yaw=0.0),), start=(0.0, 0.0, 0.0)))
    if infrared:
        robots = [replace(robot, ir=_board(k)) for k, robot in enumerate(robots)]
    places = range(_LANDMARKS)
    marks = tuple(Landmark(_FIRST_LANDMARK + k, x=1.0, y=0.2 * k, yaw=3.1) for k in places)
    swarm = Swarm(tuple(robots), marks)
    estimator, ingest = Estimator(swarm, settings), Ingest(swarm)
    for step in range(8):
        now_ns = 10 * _SECOND + step * _SECOND // 4
        backlog = []
        for robot in robots:
            x, yaw = 0.01 * step, 0.001 * step
            backlog.append((ingest.handle_of[f"{robot.name}/odom"], _odometry(now_ns, x, yaw), now_ns))
            seen = encode_detections("", now_ns - _SECOND // 8, _sight(robots.index(robot)))
            backlog.append((ingest.handle_of[f"{robot.name}/detections"], seen, now_ns))
        # one measurement alone is compiled apart: its columns are contiguous
        one = encode_detections("", now_ns - _SECOND // 16, _sight(0)[:1])
        backlog.append((ingest.handle_of["a/detections"], one, now_ns))
        fix = encode_fix("map", now_ns, (0.0, 0.0, 0.0), np.eye(3))
        backlog.append((ingest.handle_of["a/fix"], fix, now_ns))
        # the powers of an exchange in different steps
        for number, robot in enumerate(robots[:2] if infrared else ()):
            for power, stamp_ns in enumerate((now_ns, now_ns - _SECOND // 4)):
                light = encode_brightness("", stamp_ns, (1 + number, 3), _LIGHT[power], power)
                backlog.append((ingest.handle_of[f"{robot.name}/brightness"], light, now_ns))
        # what came late is taken in by code of its own
        late_ns = now_ns - _SECOND // 8
        backlog.append((ingest.handle_of["a/odom"], _odometry(late_ns, 0.01 * step, 0.001 * step), now_ns))
        for messages in ingest.read(MessageBatch.of([SerializedMessage(*one) for one in backlog])):
            estimator.receive(messages)
        estimator.tick(now_ns)
        estimator.contradictions(now_ns)
    _call_rare(swarm)


def _call_rare(swarm: Swarm) -> None:
    """What is called once something contradicts, or once many infrared exchanges are fused together."""
    state = SwarmState(ParameterTable.of(swarm.robots, swarm.landmarks), pairs=2)
    is_kidnapped(state.integrity, 0)
    columns = MeasurementColumns.of(np.zeros(2, MEASUREMENT_DTYPE))
    record_pair(columns, 0, state.arrays(), np.zeros((PAIR_ROWS, 3)))


def _board(number: int) -> RobotIr:
    """One that reads by likelihood, the next by the closed form."""
    return RobotIr(1 + number, _DROPLET, "droplet", list(IrMethod)[number % 2])


def _odometry(stamp_ns: int, x: float, yaw: float) -> bytes:
    """One message."""
    pose, unknown = np.array([[x, 0.0, yaw]]), np.zeros((6, 6))
    return encode_odometry("", "", np.array([stamp_ns]), pose, np.zeros((1, 3)), unknown, unknown)[0]


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
