"""Write a simulated exploration by PushBots as a bag, with the floor plan next to it.

    python -m bench pushbot_bag bags/pushbots_two --seed 1 --duration 300 --robots 2 --events 2
    python -m bench pushbot_bag /tmp/hallway --robots 2 --plan office

The bag contains map, and per robot odom, laser, lights, fix, goal, ground_truth, and with --events events.
The same arguments give the same bytes.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.pushbot.exploration import (
    FIRST_SIGMA,
    FOCAL_BASELINE,
    PERIOD_S,
    START_SIGMA,
    Arrival,
    Exploration,
    PushBotNoise,
)
from bench.scenarios.bags import write_swarm_bag
from bench.shared.bags import message_header
from swarm_loc_drivers.pushbot.protocol import SENSOR_PX
from swarm_loc_drivers.sim.pushbot.event_camera import CameraNoise
from swarm_loc_drivers.sim.pushbot.floor_plan import FLOOR_PLANS, FloorPlanError, floor_plan
from swarm_loc_drivers.sim.pushbot.optics import (
    CAMERA_X_M,
    HallSight,
    LaserOptics,
    assembled_robots,
    led_hz,
    lights_of,
)
from swarm_loc_drivers.sim.pushbot.wall_drive import calibrate_lasers
from swarm_loc_estimator import (
    CooperativeMapper,
    Goal,
    LightSightings,
    OccupancyMap,
    Readings,
    fix_covariance,
)
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.bags.writer import Stream
from swarm_loc_estimator.common.command_line import command_parser, exit_with_message, number_in
from swarm_loc_estimator.common.messages.cdr import (
    EVENT_PACKETS,
    LASER,
    LIGHTS,
    OCCUPANCY_GRID,
    ODOMETRY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    encode,
)
from swarm_loc_estimator.common.messages.event_encoding import ENCODING, Events, encode_events
from swarm_loc_estimator.common.messages.poses import (
    encode_fix,
    encode_odometry,
    encode_pose_stamped,
)
from swarm_loc_estimator.swarm.error_models import FixModel, OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, StartSigma, Swarm

EVENT_STEP_US = 5_000  # Time of an event packet, as the driver makes them
BEGIN_NS = 1_700_000_000_000_000_000
_MAP_PERIOD_NS = 30_000_000_000  # Between recorded maps
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
    """Settings of a run."""

    seed: int  # Of all noise
    duration_s: float  # How long [s]
    robots: int  # How many
    plan: str  # The floor plan, see `floor_plan`
    slip: float  # Share of turns that wheels lose
    events_s: float = 0.0  # Events of so long at the begin [s]


def write_pushbot_bag(settings: PushbotBagSettings, folder: Path, comment: str) -> int:
    """Write `map`, and per robot `odom`, `laser`, `lights`, `fix`, `goal`, `events` and `ground_truth`.

    Next to the bag come `swarm.yaml`, `walls.csv`, and `<robot>.yaml` with the calibration of each laser. See
    `write_bag`.

    Raises:
        UserError: The floor plan cannot be used, or the folder is there already or cannot be created.
    """
    plan = floor_plan(settings.plan)
    if len(plan.starts) < settings.robots:
        raise FloorPlanError(f"The floor plan '{settings.plan}' has starts for {len(plan.starts)} robots.")
    # explore with the mapper, and record what robots measure and what the mapper publishes
    mapper = CooperativeMapper()
    exploration = Exploration(plan, mapper, np.random.default_rng(settings.seed))
    robots = range(settings.robots)
    recorded: list[list[Readings]] = [[] for _ in robots]
    sighted: list[list[LightSightings]] = [[] for _ in robots]
    exploration.on_readings = lambda robot, readings: recorded[robot].append(readings)
    exploration.on_lights = lambda robot, sightings: sighted[robot].append(sightings)
    goals: list[list[Goal]] = [[] for _ in robots]
    covariances: list[list[FloatArray]] = [[] for _ in robots]
    maps: dict[int, bytes] = {}

    def record_fix(arrival: Arrival) -> None:
        goal, robot = mapper.goal(arrival.robot), arrival.robot
        if goal is None:
            return
        goals[robot].append(goal)
        covariances[robot].append(fix_covariance(mapper.covariance(robot)))
        stamp_ns = BEGIN_NS + goal.stamp_ns
        if not maps or stamp_ns >= max(maps) + _MAP_PERIOD_NS:
            maps[stamp_ns] = _encode_map(stamp_ns, mapper.occupancy())

    for _ in robots:
        exploration.join(PushBotNoise(slip=settings.slip))
    exploration.run(settings.duration_s, record_fix)
    # write the robots' streams
    described = tuple(_described(robot, exploration) for robot in robots)
    names = [one.name for one in described]
    built = assembled_robots(settings.seed, settings.robots)
    streams: list[Stream] = []
    for robot, name in enumerate(names):
        streams += [_odometry(name, recorded[robot]), _laser(name, recorded[robot], built[robot])]
        streams += _lights(name, sighted[robot])
        streams += [_fixes(name, goals[robot], covariances[robot]), _goals(name, goals[robot])]
        streams.append(_truth(name, exploration.robots[robot].trace))
    streams.append(Stream("map", OCCUPANCY_GRID, np.array(list(maps), dtype=np.int64), list(maps.values())))
    # events of the cameras at the beginning
    if settings.events_s:
        cameras = HallSight(plan.walls, built, CameraNoise(), np.random.default_rng([settings.seed, 2]))
        traces = [exploration.robots[robot].trace for robot in robots]
        streams += _events(names, _poses(traces, settings.events_s), cameras)
    # the bag, and files next to it
    count = write_swarm_bag(streams, Swarm(described), folder, comment)
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
        fix=FixModel(systematic_share=1.0),
        start=tuple(exploration.starts[number].tolist()),
        start_sigma=StartSigma(*(START_SIGMA if number else FIRST_SIGMA).tolist()),
    )


def _fixes(name: str, goals: list[Goal], covariances: list[FloatArray]) -> Stream:
    """The mapper's poses of the robot when it chose goals, as the mapper's node publishes them."""
    stamp_ns = BEGIN_NS + np.array([goal.stamp_ns for goal in goals], dtype=np.int64)
    data = [
        encode_fix("map", at_ns, goal.pose, covariance)
        for at_ns, goal, covariance in zip(stamp_ns.tolist(), goals, covariances, strict=True)
    ]
    return Stream(f"{name}/fix", POSE_WITH_COVARIANCE, stamp_ns, data)


def _goals(name: str, goals: list[Goal]) -> Stream:
    """Where the mapper sends the robot; the heading is that of the way there."""
    stamp_ns = BEGIN_NS + np.array([goal.stamp_ns for goal in goals], dtype=np.int64)
    ways = [goal.position - goal.pose[:2] for goal in goals]
    poses = [
        [*goal.position.tolist(), math.atan2(way[1], way[0])] for goal, way in zip(goals, ways, strict=True)
    ]
    table = np.array(poses).reshape(-1, 3)
    return Stream(f"{name}/goal", POSE_STAMPED, stamp_ns, encode_pose_stamped("map", stamp_ns, table))


def _odometry(name: str, readings: list[Readings]) -> Stream:
    stamp_ns = BEGIN_NS + np.concatenate([one.stamp_ns for one in readings])
    pose = np.concatenate([one.odometry for one in readings])
    twist = np.zeros_like(pose)
    twist[1:] = se2.log(se2.between(pose[:-1], pose[1:])) / PERIOD_S
    data = encode_odometry(f"{name}/odom", f"{name}/base_link", stamp_ns, pose, twist)
    return Stream(f"{name}/odom", ODOMETRY, stamp_ns, data)


def _laser(name: str, readings: list[Readings], built: LaserOptics) -> Stream:
    stamp_ns = BEGIN_NS + np.concatenate([one.stamp_ns for one in readings])
    inverse = np.concatenate([one.inverse for one in readings])
    sigma = readings[0].sigma
    data = []
    for at_ns, value in zip(stamp_ns.tolist(), inverse.tolist(), strict=True):
        seen = value > 0.0
        distance = 1.0 / value if seen else math.nan
        pixel = (sigma * FOCAL_BASELINE) ** 2 if seen else -1.0
        column, row = built.spot(distance - CAMERA_X_M) if seen else (math.nan, math.nan)
        data.append(
            encode(
                {
                    "header": message_header(at_ns, f"{name}/base_link"),
                    "distance": distance,
                    "sigma": sigma * distance**2,
                    "u_px": column,
                    "v_px": row,
                    "covariance": [pixel, 0.0, 0.0, pixel],
                    "events": seen,
                },
                LASER,
            )
        )
    return Stream(f"{name}/laser", LASER, stamp_ns, data)


def _lights(name: str, sightings: list[LightSightings]) -> list[Stream]:
    stamps: list[int] = []
    data: list[bytes] = []
    for part in sightings:
        for at_ns in np.unique(part.stamp_ns).tolist():
            lights = [
                {
                    "frequency": led_hz(int(part.target[k])),
                    "bearing": part.bearing[k],
                    "covariance": np.diag([part.sigma[k] ** 2] * 2),
                    "u_px": math.nan,
                    "v_px": math.nan,
                    "events": 1,
                }
                for k in np.flatnonzero(part.stamp_ns == at_ns)
            ]
            stamps.append(BEGIN_NS + at_ns)
            header = message_header(BEGIN_NS + at_ns, f"{name}/base_link")
            data.append(encode({"header": header, "lights": lights}, LIGHTS))
    return [Stream(f"{name}/lights", LIGHTS, np.array(stamps, dtype=np.int64), data)] if data else []


def _truth(name: str, trace: FloatArray) -> Stream:
    chosen = trace[::_TRUTH_EVERY].copy()
    chosen[:, 2] = se2.wrap_angle(chosen[:, 2])
    stamp_ns = BEGIN_NS + np.round(np.arange(0, len(trace), _TRUTH_EVERY) * PERIOD_S * 1e9).astype(np.int64)
    return Stream(
        f"{name}/ground_truth", POSE_STAMPED, stamp_ns, encode_pose_stamped("map", stamp_ns, chosen)
    )


def _poses(traces: list[FloatArray], duration_s: float) -> FloatArray:
    """Poses (K, N, 3) at every `EVENT_STEP_US` of traces (n, 3), which hold unwrapped headings."""
    at_us: IntArray = np.arange(0, round(1e6 * duration_s) + 1, EVENT_STEP_US)
    period_us = round(1e6 * PERIOD_S)
    columns = [
        [np.interp(at_us, period_us * np.arange(len(trace)), trace[:, k]) for k in range(3)]
        for trace in traces
    ]
    poses: FloatArray = np.array(columns).transpose(2, 0, 1)
    return poses


def _events(names: list[str], poses: FloatArray, cameras: HallSight) -> list[Stream]:
    """Event packets of all robots that pass through true poses (K, N, 3) at every `EVENT_STEP_US`."""
    lights = [lights_of(robot) for robot in range(len(names))]
    streams = []
    for robot, name in enumerate(names):
        stamps: list[int] = []
        data: list[bytes] = []
        for step in range(len(poses) - 1):
            span_us = step * EVENT_STEP_US, (step + 1) * EVENT_STEP_US
            seen = cameras.look(robot, poses[step], poses[step + 1], span_us, lights)
            if len(seen.x):
                x, y = seen.x.astype(np.uint16), seen.y.astype(np.uint16)
                since_ns = 1000 * (seen.time_us - seen.time_us[0])
                stamps.append(BEGIN_NS + 1000 * int(seen.time_us[0]))
                events = Events(x, y, seen.polarity == 0, since_ns)
                data.append(_encode_packet(name, stamps[-1], len(data), events))
        arrival_ns = np.array(stamps, dtype=np.int64) + 1000 * EVENT_STEP_US
        streams.append(Stream(f"{name}/events", EVENT_PACKETS[0], arrival_ns, data))
    return streams


def _encode_packet(name: str, stamp_ns: int, number: int, events: Events) -> bytes:
    message = {
        "header": message_header(stamp_ns, f"{name}/event_camera_optical_frame"),
        "height": SENSOR_PX,
        "width": SENSOR_PX,
        "seq": number,
        "time_base": stamp_ns,
        "encoding": ENCODING,
        "events": encode_events(events),
    }
    return encode(message, EVENT_PACKETS[1])


def _encode_map(stamp_ns: int, occupancy: OccupancyMap) -> bytes:
    """The map as the mapper's node publishes it: -1 unknown, else the probability of an obstacle [%]."""
    cells = np.round(occupancy.percent).astype(np.int8).T
    x, y = map(float, occupancy.corner)
    about = {
        "map_load_time": stamp_ns,
        "resolution": occupancy.cell,
        "width": cells.shape[1],
        "height": cells.shape[0],
        "origin": {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}},
    }
    message = {"header": message_header(stamp_ns, "map"), "info": about, "data": cells}
    return encode(message, OCCUPANCY_GRID)


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _parser().parse_args(arguments)
    words = [f"{name}={value}" for name, value in vars(options).items() if name != "bag"]
    settings = PushbotBagSettings(
        options.seed, options.duration, options.robots, options.plan, options.slip, options.events
    )
    count = write_pushbot_bag(settings, options.bag, f"Simulated: swarm=pushbots, {', '.join(words)}.")
    print(f"{count} messages of {options.robots} robots written to {options.bag}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(__doc__)
    parser.add_argument("bag", type=Path, help="bag folder to create")
    parser.add_argument(
        "--seed", type=number_in(0, 2**31 - 1), default=1, help="the same seed gives the same bag"
    )
    parser.add_argument(
        "--duration", type=number_in(2.0, 3600.0, "s"), default=300.0, help="simulated time [s]"
    )
    parser.add_argument("--robots", type=number_in(1, 5), default=1, help="number of robots")
    parser.add_argument(
        "--plan",
        default="corridor",
        help=f"the hall: {', '.join(FLOOR_PLANS)}, or the path of a floor plan (default: %(default)s)",
    )
    parser.add_argument(
        "--slip", type=number_in(0.0, 0.1), default=0.02, help="share of every turn that is lost by slip"
    )
    parser.add_argument(
        "--events",
        type=number_in(0.0, 60.0, "s"),
        default=0.0,
        help="length of the events at the beginning [s]",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
