"""Write a simulated exploration by PushBots as a bag, with the floor plan beside it."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from swarm_loc_drivers.sim.pushbot.exploration import FIRST_SIGMA, START_SIGMA, Exploration
from swarm_loc_drivers.sim.pushbot.floor_plan import floor_plan
from swarm_loc_drivers.sim.pushbot.kinematics import FOCAL_BASELINE, PERIOD_S, PushBotNoise
from swarm_loc_drivers.sim.recording.bag import Stream, write_streams
from swarm_loc_estimator.core.description.swarm import Robot, StartSigma, Swarm
from swarm_loc_estimator.core.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.core.mapping.readings import LightSightings, Readings
from swarm_loc_estimator.io.maps.laser_messages import LASER, LIGHTS
from swarm_loc_estimator.io.messages.encoders import UNKNOWN_COVARIANCE, encode_odometry, encode_pose_stamped
from swarm_loc_estimator.io.messages.typestore import (
    MESSAGE_PACKAGE,
    ODOMETRY,
    POSE_STAMPED,
    encode,
    typestore,
)
from swarm_loc_estimator.numerics import se2
from swarm_loc_estimator.numerics.arrays import FloatArray

BEGIN_NS = 1_700_000_000_000_000_000
FIRST_LED_HZ, LED_STEP_HZ = 1000.0, 50.0
"""Frequencies of the robots' LEDs, each its own."""
_TRUTH_EVERY = 5
_CENTRE_PX = 63.5


@dataclass(frozen=True)
class PushbotBagSettings:
    """What is simulated.

    Attributes:
        seed: Of all noise.
        duration_s: How long [s].
        robots: How many.
        plan: Name of the floor plan.
        slip: Share of turns that wheels lose.
    """

    seed: int
    duration_s: float
    robots: int
    plan: str
    slip: float


def write_pushbot_bag(settings: PushbotBagSettings, folder: Path, comment: str) -> int:
    """Write `<robot>/odom`, `laser`, `lights` and `ground_truth`, `swarm.yaml` and `walls.csv`.

    Args:
        settings: What is simulated.
        folder: The bag, created; must not exist.
        comment: First lines of `swarm.yaml`, where the run comes from.

    Returns:
        Number of messages.

    Raises:
        BagError: The folder is there already, or cannot be created.
    """
    plan = floor_plan(settings.plan)
    rng = np.random.default_rng(settings.seed)
    exploration = Exploration(plan, CooperativeMapper(), rng)
    recorded: dict[int, list[tuple[Readings, LightSightings | None]]] = defaultdict(list)
    exploration.on_readings = lambda robot, readings, lights: recorded[robot].append((readings, lights))
    for _ in range(settings.robots):
        exploration.join(PushBotNoise(slip=settings.slip))
    exploration.run(settings.duration_s)
    robots = tuple(
        Robot(
            f"pushbot{number + 1}",
            camera=None,
            start=tuple(exploration.starts[number].tolist()),
            start_sigma=StartSigma(*(START_SIGMA if number else FIRST_SIGMA).tolist()),
        )
        for number in range(settings.robots)
    )
    streams: list[Stream] = []
    for number, robot in enumerate(robots):
        readings = [one for one, _ in recorded[number]]
        streams += [_odometry(robot.name, readings), _laser(robot.name, readings)]
        streams += _lights(robot.name, [lights for _, lights in recorded[number] if lights is not None])
        streams.append(_truth(robot.name, exploration.robots[number].trace))
    count = write_streams(streams, Swarm(robots), folder, comment)
    np.savetxt(folder / "walls.csv", plan.walls, fmt="%.4f", delimiter=",", header="x0,y0,x1,y1 [m]")
    return count


def _odometry(name: str, readings: list[Readings]) -> Stream:
    stamp_ns = BEGIN_NS + np.concatenate([one.stamp_ns for one in readings])
    pose = np.concatenate([one.odometry for one in readings])
    twist = np.zeros_like(pose)
    twist[1:] = se2.log(se2.between(pose[:-1], pose[1:])) / PERIOD_S
    frames = (f"{name}/odom", f"{name}/base_link")
    data = encode_odometry(*frames, stamp_ns, pose, twist, UNKNOWN_COVARIANCE, UNKNOWN_COVARIANCE)
    return Stream(f"{name}/odom", ODOMETRY, stamp_ns, data)


def _laser(name: str, readings: list[Readings]) -> Stream:
    stamp_ns = BEGIN_NS + np.concatenate([one.stamp_ns for one in readings])
    inverse = np.concatenate([one.inverse for one in readings])
    sigma = readings[0].sigma
    message = typestore().types[LASER]
    data = []
    for at_ns, value in zip(stamp_ns.tolist(), inverse.tolist(), strict=True):
        seen = value > 0.0
        distance = 1.0 / value if seen else math.nan
        pixel = (sigma * FOCAL_BASELINE) ** 2 if seen else -1.0
        row = _CENTRE_PX + FOCAL_BASELINE * value if seen else math.nan
        data.append(
            encode(
                message(
                    header=_header(at_ns, f"{name}/base_link"),
                    distance=distance,
                    sigma=sigma * distance**2,
                    u_px=_CENTRE_PX if seen else math.nan,
                    v_px=row,
                    covariance=np.array([pixel, 0.0, 0.0, pixel]),
                    events=int(seen),
                ),
                LASER,
            )
        )
    return Stream(f"{name}/laser", LASER, stamp_ns, data)


def _lights(name: str, sightings: list[LightSightings]) -> list[Stream]:
    light, array = (typestore().types[one] for one in (f"{MESSAGE_PACKAGE}/msg/LightBearing", LIGHTS))
    stamps: list[int] = []
    data: list[bytes] = []
    for part in sightings:
        for at_ns in np.unique(part.stamp_ns).tolist():
            lights = [
                light(
                    frequency=FIRST_LED_HZ + LED_STEP_HZ * int(part.target[k]),
                    bearing=float(part.bearing[k]),
                    elevation=0.0,
                    covariance=np.diag([float(part.sigma[k]) ** 2] * 2).ravel(),
                    u_px=math.nan,
                    v_px=math.nan,
                    events=1,
                )
                for k in np.flatnonzero(part.stamp_ns == at_ns)
            ]
            stamps.append(BEGIN_NS + at_ns)
            header = _header(BEGIN_NS + at_ns, f"{name}/base_link")
            data.append(encode(array(header=header, lights=lights), LIGHTS))
    return [Stream(f"{name}/lights", LIGHTS, np.array(stamps, dtype=np.int64), data)] if data else []


def _truth(name: str, trace: FloatArray) -> Stream:
    chosen = trace[::_TRUTH_EVERY].copy()
    chosen[:, 2] = se2.wrap_angle(chosen[:, 2])
    stamp_ns = BEGIN_NS + np.round(np.arange(0, len(trace), _TRUTH_EVERY) * PERIOD_S * 1e9).astype(np.int64)
    return Stream(
        f"{name}/ground_truth", POSE_STAMPED, stamp_ns, encode_pose_stamped("map", stamp_ns, chosen)
    )


def _header(at_ns: int, frame: str) -> Any:
    types = typestore().types
    stamp = types["builtin_interfaces/msg/Time"](sec=at_ns // 1_000_000_000, nanosec=at_ns % 1_000_000_000)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)
