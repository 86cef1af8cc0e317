"""Compile the estimator before data comes; messages would be lost meanwhile. No ROS here."""

from __future__ import annotations

from concurrent.futures import wait
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import is_precompiled, note_precompiled
from swarm_loc_estimator.common.messages.detections import (
    DETECTION_DTYPE,
    encode_brightness,
    encode_detections,
)
from swarm_loc_estimator.common.messages.poses import encode_fix, encode_odometry
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.common.processes import process_beside, uninterrupted
from swarm_loc_estimator.filter.measurements import NO_MEASUREMENTS
from swarm_loc_estimator.filter.sources import is_kidnapped
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.camera import CONTENT_POSE_TWO, CONTENT_POSITION
from swarm_loc_estimator.sensors.inputs import Ingest
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.ir_board import RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.swarm import Face, Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.fusion import Fusion
from swarm_loc_estimator.timeline.settings import Policy, Settings

_SECOND = 1_000_000_000
_FIRST_LANDMARK = 10
_LANDMARKS = 30  # three robots see more than are fused one by one where many may be fused together
_FACING = (0.0, 1.0, 0.0, 0.0)  # x y z w: a marker that looks at the camera
_AWAY = (0.0, 0.7, 0.0, 0.7)


Size = Literal["small", "large", "sparse"]

_SETTINGS: dict[Size, tuple[Settings, ...]] = {
    "small": (Settings(),),
    "large": (Settings(), Settings(fusion_period_s=0.1, policy=Policy(large_from=2))),
    "sparse": (Settings(sparse_from=2),),
}


def size_of(swarm: Swarm, settings: Settings) -> Size:
    """The size of a swarm, by which its measurements are fused; ranges are, as in large ones."""
    if settings.resolved_for(swarm).is_sparse(swarm):
        return "sparse"
    has_radios = any(robot.uwb is not None for robot in swarm.robots)
    return "large" if has_radios or len(swarm.robots) >= settings.policy.large_from else "small"


def precompile(size: Size, infrared: bool) -> None:
    """Run small estimators through all that a swarm of some size does, and with infrared light as well.

    It takes a second once compiled.
    """
    compiled = partial(precompile, size, infrared)
    if not is_precompiled(compiled):
        with process_beside() as beside:
            with uninterrupted():
                updates = beside.submit(_compile_updates)
            _run(Settings(), infrared=False, fused=False)
            if infrared:
                precompile_infrared()
            wait([updates])  # if it failed, this process compiles what is missing
    for settings in _SETTINGS[size]:
        _run(settings, infrared=infrared)
    note_precompiled(compiled)


def _compile_updates() -> None:
    """Fuse no measurements: the sequential update takes as long to compile as all that comes before it."""
    swarm = _swarm(infrared=False)
    fusion = Fusion(swarm, Settings().resolved_for(swarm), OdometryTracks(swarm.robots), {})
    fusion.step(fusion.new_state(), NO_MEASUREMENTS, [], np.zeros(0, np.uint8), np.zeros(0))


def precompile_infrared() -> None:
    """Solve an exchange: that takes a third of the time to compile, and can be done in a process beside."""
    MaximumLikelihood(load_ir_platform("droplet")).solve(_light()[None])
    note_precompiled(precompile_infrared)


def _swarm(*, infrared: bool) -> Swarm:
    """Three robots, one with calibrated odometry and a start, and landmarks."""
    robots = [Robot(name, faces=(Face("front", k, yaw=0.0),)) for k, name in enumerate("ab")]
    calibrated = OdometryModel(distance_scale_sigma=0.01)
    robots.append(Robot("c", odometry=calibrated, faces=(Face("front", 2, yaw=0.0),), start=(0.0, 0.0, 0.0)))
    if infrared:
        droplet = load_ir_platform("droplet")
        robots = [replace(robot, ir=RobotIr(1 + k, droplet, "droplet")) for k, robot in enumerate(robots)]
    places = range(_LANDMARKS)
    marks = tuple(Landmark(_FIRST_LANDMARK + k, x=1.0, y=0.2 * k, yaw=3.1) for k in places)
    return Swarm(tuple(robots), marks)


def _run(settings: Settings, *, infrared: bool, fused: bool = True) -> None:
    """Run an estimator for two seconds; if not `fused`, measurements are converted only."""
    swarm = _swarm(infrared=infrared)
    estimator, ingest = Estimator(swarm, settings), Ingest(swarm)
    light = _light() if infrared else np.zeros((0, 6, 6))
    for step in range(8):
        now_ns = 10 * _SECOND + step * _SECOND // 4
        moved, seen = list[tuple[str, bytes]](), list[tuple[str, bytes]]()
        for index, robot in enumerate(swarm.robots):
            moved.append((f"{robot.name}/odom", _odometry(now_ns, 0.01 * step, 0.001 * step)))
            sight = encode_detections("", now_ns - _SECOND // 8, _sight(index))
            seen.append((f"{robot.name}/detections", sight))
        # what came late is taken in by code of its own
        moved.append(("a/odom", _odometry(now_ns - _SECOND // 8, 0.01 * step, 0.001 * step)))
        # one measurement alone is compiled apart: its columns are contiguous
        seen.append(("a/detections", encode_detections("", now_ns - _SECOND // 16, _sight(0)[:1])))
        seen.append(("a/fix", encode_fix("map", now_ns, (0.0, 0.0, 0.0), np.eye(3))))
        # the powers of an exchange in different steps
        for power, matrix in enumerate(light):
            stamp_ns = now_ns - power * _SECOND // 4
            seen += [
                (f"{robot.name}/brightness", encode_brightness("", stamp_ns, (1 + k, 3), matrix, power))
                for k, robot in enumerate(swarm.robots[:2])
            ]
        for backlog, is_taken in ((moved + seen, True),) if fused else ((moved, True), (seen, False)):
            messages = [SerializedMessage(ingest.handle_of[topic], data, now_ns) for topic, data in backlog]
            for batch in ingest.read(MessageBatch.of(messages)):
                if is_taken:
                    estimator.receive(batch)
                else:
                    estimator.convert(batch)
        estimator.tick(now_ns)
        estimator.contradictions(now_ns)
    # what is called once something contradicts
    state = SwarmState(ParameterTable.of(swarm.robots, swarm.surveyed), pairs=2)
    is_kidnapped(state.sources, 0)


def _light() -> FloatArray:
    """Brightness matrices (2, 6, 6) of an exchange at both powers."""
    light: FloatArray = expected_brightness(load_ir_platform("droplet"), (0.1, 0.3, 1.0))[0]
    return light


def _odometry(stamp_ns: int, x: float, yaw: float) -> bytes:
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
