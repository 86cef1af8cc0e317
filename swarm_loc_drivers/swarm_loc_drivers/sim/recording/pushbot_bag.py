"""Write a simulated exploration by PushBots as a bag, with the floor plan beside it."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swarm_loc_drivers.sim.pushbot.exploration import FIRST_SIGMA, START_SIGMA, Arrival, Exploration
from swarm_loc_drivers.sim.pushbot.floor_plan import floor_plan
from swarm_loc_drivers.sim.pushbot.kinematics import FOCAL_BASELINE, PERIOD_S, PushBotNoise
from swarm_loc_drivers.sim.pushbot.optics import CAMERA_X_M, LaserOptics, assembled_robots, led_hz
from swarm_loc_drivers.sim.pushbot.wall_drive import calibrate_lasers
from swarm_loc_drivers.sim.recording.bag import Stream, write_streams
from swarm_loc_drivers.sim.recording.pushbot_events import event_streams, header_at, poses_between, sight_of
from swarm_loc_drivers.sim.recording.pushbot_maps import MapNotes, goal_stream
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.encoders import (
    UNKNOWN_COVARIANCE,
    encode_fix,
    encode_odometry,
    encode_pose_stamped,
)
from swarm_loc_estimator.common.messages.typestore import (
    MESSAGE_PACKAGE,
    ODOMETRY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    encode,
    typestore,
)
from swarm_loc_estimator.mapping.exploration.goal import Goal
from swarm_loc_estimator.mapping.fix_covariance import FixCovariances
from swarm_loc_estimator.mapping.laser_messages import LASER, LIGHTS
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.readings import LightSightings, Readings
from swarm_loc_estimator.swarm.swarm import OdometryModel, Robot, StartSigma, Swarm

BEGIN_NS = 1_700_000_000_000_000_000
_TRUTH_EVERY = 5
_ODOMETRY = OdometryModel(
    wheel_separation=0.085,
    wheel_noise=1e-6,
    distance_noise=3e-4,
    turn_noise=2e-5,
    turn_scale=0.98,
    turn_scale_sigma=0.015,
)
"""Paths to 1.8 % of a hop, turns to .64 deg a turn, and slip of two percent, more or less."""


@dataclass(frozen=True)
class PushbotBagSettings:
    """What is simulated.

    Attributes:
        seed: Of all noise.
        duration_s: How long [s].
        robots: How many.
        plan: Name of the floor plan.
        slip: Share of turns that wheels lose.
        events_s: Events of so long at the begin [s].
    """

    seed: int
    duration_s: float
    robots: int
    plan: str
    slip: float
    events_s: float = 0.0


def write_pushbot_bag(settings: PushbotBagSettings, folder: Path, comment: str) -> int:
    """Write `map`, and per robot `odom`, `laser`, `lights`, `fix`, `goal`, `events` and `ground_truth`.

    Beside the bag come `swarm.yaml`, `walls.csv`, and `<robot>.yaml` with the calibration of each laser.

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
    mapper = CooperativeMapper()
    exploration = Exploration(plan, mapper, np.random.default_rng(settings.seed))
    recorded: dict[int, list[tuple[Readings, LightSightings | None]]] = defaultdict(list)
    exploration.on_readings = lambda robot, readings, lights: recorded[robot].append((readings, lights))
    fixes: dict[int, list[Goal]] = defaultdict(list)
    maps = MapNotes(BEGIN_NS)
    covariances: dict[int, list[FloatArray]] = defaultdict(list)
    told = [FixCovariances(_ODOMETRY) for _ in range(settings.robots)]

    def note_fix(arrival: Arrival) -> None:
        goal = mapper.goal(arrival.robot)
        if goal is not None:
            fixes[arrival.robot].append(goal)
            maps.note(goal.stamp_ns, mapper.occupancy())
            covariance = told[arrival.robot].told(goal, mapper.covariance(arrival.robot))
            covariances[arrival.robot].append(covariance)

    for _ in range(settings.robots):
        exploration.join(PushBotNoise(slip=settings.slip))
    exploration.run(settings.duration_s, note_fix)
    robots = tuple(_described(number, exploration) for number in range(settings.robots))
    built = assembled_robots(settings.seed, settings.robots)
    streams: list[Stream] = []
    for number, robot in enumerate(robots):
        readings = [one for one, _ in recorded[number]]
        streams += [_odometry(robot.name, readings), _laser(robot.name, readings, built[number])]
        streams += _lights(robot.name, [lights for _, lights in recorded[number] if lights is not None])
        streams.append(_fixes(robot.name, fixes[number], covariances[number]))
        streams.append(goal_stream(robot.name, BEGIN_NS, fixes[number]))
        streams.append(_truth(robot.name, exploration.robots[number].trace))
    streams.append(maps.stream())
    names = [robot.name for robot in robots]
    streams += _events(names, exploration, settings)
    count = write_streams(streams, Swarm(robots), folder, comment)
    np.savetxt(folder / "walls.csv", plan.walls, fmt="%.4f", delimiter=",", header="x0,y0,x1,y1 [m]")
    calibrate_lasers(names, settings.seed, folder)
    return count


def _described(number: int, exploration: Exploration) -> Robot:
    """A robot as the swarm description has it."""
    return Robot(
        f"pushbot{number + 1}",
        type="pushbot",
        odometry=_ODOMETRY,
        camera=None,
        start=tuple(exploration.starts[number].tolist()),
        start_sigma=StartSigma(*(START_SIGMA if number else FIRST_SIGMA).tolist()),
    )


def _events(names: list[str], exploration: Exploration, settings: PushbotBagSettings) -> list[Stream]:
    """What the cameras see at the begin."""
    if not settings.events_s:
        return []
    traces = [exploration.robots[number].trace for number in range(settings.robots)]
    poses = poses_between(traces, round(1e6 * PERIOD_S), round(1e6 * settings.events_s))
    sight = sight_of(exploration.plan.walls, settings.seed, settings.robots)
    return event_streams(names, poses, BEGIN_NS, sight)


def _fixes(name: str, goals: list[Goal], covariances: list[FloatArray]) -> Stream:
    """Where the mapper had the robot when it decided on its goals, as the mapper's node publishes it."""
    stamp_ns = BEGIN_NS + np.array([goal.stamp_ns for goal in goals], dtype=np.int64)
    data = [
        encode_fix("map", at_ns, goal.pose, covariance)
        for at_ns, goal, covariance in zip(stamp_ns.tolist(), goals, covariances, strict=True)
    ]
    return Stream(f"{name}/fix", POSE_WITH_COVARIANCE, stamp_ns, data)


def _odometry(name: str, readings: list[Readings]) -> Stream:
    stamp_ns = BEGIN_NS + np.concatenate([one.stamp_ns for one in readings])
    pose = np.concatenate([one.odometry for one in readings])
    twist = np.zeros_like(pose)
    twist[1:] = se2.log(se2.between(pose[:-1], pose[1:])) / PERIOD_S
    frames = (f"{name}/odom", f"{name}/base_link")
    data = encode_odometry(*frames, stamp_ns, pose, twist, UNKNOWN_COVARIANCE, UNKNOWN_COVARIANCE)
    return Stream(f"{name}/odom", ODOMETRY, stamp_ns, data)


def _laser(name: str, readings: list[Readings], built: LaserOptics) -> Stream:
    stamp_ns = BEGIN_NS + np.concatenate([one.stamp_ns for one in readings])
    inverse = np.concatenate([one.inverse for one in readings])
    sigma = readings[0].sigma
    message = typestore().types[LASER]
    data = []
    for at_ns, value in zip(stamp_ns.tolist(), inverse.tolist(), strict=True):
        seen = value > 0.0
        distance = 1.0 / value if seen else math.nan
        pixel = (sigma * FOCAL_BASELINE) ** 2 if seen else -1.0
        column, row = built.spot(distance - CAMERA_X_M) if seen else (math.nan, math.nan)
        data.append(
            encode(
                message(
                    header=header_at(at_ns, f"{name}/base_link"),
                    distance=distance,
                    sigma=sigma * distance**2,
                    u_px=column,
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
                    frequency=led_hz(int(part.target[k])),
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
            header = header_at(BEGIN_NS + at_ns, f"{name}/base_link")
            data.append(encode(array(header=header, lights=lights), LIGHTS))
    return [Stream(f"{name}/lights", LIGHTS, np.array(stamps, dtype=np.int64), data)] if data else []


def _truth(name: str, trace: FloatArray) -> Stream:
    chosen = trace[::_TRUTH_EVERY].copy()
    chosen[:, 2] = se2.wrap_angle(chosen[:, 2])
    stamp_ns = BEGIN_NS + np.round(np.arange(0, len(trace), _TRUTH_EVERY) * PERIOD_S * 1e9).astype(np.int64)
    return Stream(
        f"{name}/ground_truth", POSE_STAMPED, stamp_ns, encode_pose_stamped("map", stamp_ns, chosen)
    )
