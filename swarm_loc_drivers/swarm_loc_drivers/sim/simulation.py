"""The whole graph of simulated robots as data: world, drivers, steering, sensing nodes, estimator.

`ROBOT_TYPES` has one entry per kind of robot. `ros2 launch swarm_loc_drivers simulation.launch.py` and the
`simulate` command start the same list of nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from swarm_loc_drivers.sim.droplet.world import check_droplets
from swarm_loc_drivers.sim.epuck.world import check_swarm
from swarm_loc_drivers.sim.pushbot.floor_plan import FLOOR_PLANS, floor_plan
from swarm_loc_drivers.sim.pushbot.optics import MAX_ROBOTS, laser_hz, led_hz
from swarm_loc_drivers.sim.pushbot.wall_drive import calibrate_lasers
from swarm_loc_drivers.sim.render.scene import TOP_HEIGHT, TOP_RADIUS
from swarm_loc_drivers.sim.room.sensors import sensors_of
from swarm_loc_drivers.sim.room.world import (
    ROOM_WORLDS,
    RoomWorld,
    draw_missing_map,
    room_of,
    room_starts,
)
from swarm_loc_drivers.sim.scenarios.droplets import starts as droplet_starts
from swarm_loc_drivers.sim.scenarios.eight import ARENA, eight_floor, eight_starts, rounded
from swarm_loc_drivers.sim.worlds import WorldError
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.launch import NodeSpec, ParameterValue, check_parameter_file
from swarm_loc_estimator.common.parameters import ParameterError, flag, number, text
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_vision.aerial.ground_control import save_ground

Parameters = dict[str, ParameterValue]

_ESTIMATOR, _VISION, _DRIVERS = "swarm_loc_estimator", "swarm_loc_vision", "swarm_loc_drivers"
_TIME: Parameters = {"use_sim_time": True}
_HALL = "corridor"  # Of PushBots
_ANSWER_WITHIN_S = 0.15  # Images of real robots take so long to become detections, too
_AERIAL_RATE_HZ = 3.0
_AERIAL_CAMERA: Parameters = {
    "robot_height": TOP_HEIGHT,
    "robot_diameter": 2.0 * TOP_RADIUS,
    "x_min": -0.5 * ARENA[0],
    "x_max": 0.5 * ARENA[0],
    "y_min": -0.5 * ARENA[1],
    "y_max": 0.5 * ARENA[1],
}
"""The robots and the arena as the aerial camera's node knows them."""


@dataclass(frozen=True)
class SimulationOptions:
    """Options of a simulation."""

    swarm_file: str = field(metadata={"doc": "the swarm description"})
    world: str = text("", "error model of robots and sensors (default: w2 for e-pucks, d1 for Droplets)")
    seed: int = number(1, "1", 0, 2**31 - 1, "random seed of these errors")
    speed: float = number(0.06, "m/s", 0.001, 0.12, "speed of e-pucks along the eight")
    rate: float = number(
        1.0, "1", 0.01, 100.0, "simulated seconds per second, as far as the machine keeps up"
    )
    plan: str = text(
        "",
        f"the walls: {', '.join(FLOOR_PLANS)}, or the path of a floor plan (default: corridor for PushBots,"
        " else the map of the description)",
    )
    aerial: bool = flag(False, "locate e-pucks only by an overhead camera, which cannot tell them apart")
    parameter_file: str | None = text(None, "ROS parameter file for all nodes")


@dataclass(frozen=True)
class RobotType:
    """How one kind of robot is simulated."""

    name: str  # The type of the robots in a swarm description
    # Options, swarm -> poses (N, 3) of those that the description gives no start
    starts: Callable[[SimulationOptions, Swarm], FloatArray]
    check: Callable[[Swarm], None]  # Raises a `UserError` for a swarm that its world cannot hold
    # Options, swarm, folder for serial ports and files, file of the swarm with all starts -> nodes in the
    # order in which they start
    nodes: Callable[[SimulationOptions, Swarm, str, str], list[NodeSpec]]
    worlds: tuple[str, ...] = ()  # Its error models, the default one first
    # Whether marker detectors run, whose compiled code is to be prepared once for all
    has_markers: bool = False


def robot_type_of(swarm: Swarm) -> RobotType:
    """The kind of a swarm's robots; those of any other type are e-pucks, or in a room if none has a camera.

    Raises WorldError if the robots are of several kinds.
    """
    kinds = {robot.name: ROBOT_TYPES.get(robot.type, EPUCK) for robot in swarm.robots}
    first = next((kind for kind in kinds.values() if kind is not EPUCK), EPUCK)
    for robot, kind in kinds.items():
        if kind is not first:
            raise WorldError(
                f"robot '{robot}' is no {first.name}, and others are: one world has one kind of robots."
            )
    return first if first is not EPUCK or any(robot.camera for robot in swarm.robots) else ROOM


def simulated_swarm(options: SimulationOptions) -> Swarm:
    """The swarm of a simulation, checked before any process starts.

    Raises UserError if a file cannot be used, or the swarm cannot be simulated.
    """
    floor_plan(options.plan or _HALL)
    check_parameter_file(options.parameter_file)
    swarm = load_swarm(Path(options.swarm_file))
    kind = robot_type_of(swarm)
    if options.world and kind.worlds and options.world not in kind.worlds:
        raise ParameterError(f"argument world = '{options.world}' must be one of {', '.join(kind.worlds)}.")
    if options.aerial and kind is ROOM:
        raise ParameterError("argument aerial = true must be false for robots without cameras.")
    kind.check(placed(options, swarm))
    return swarm


def graph_of(options: SimulationOptions, swarm: Swarm, links: str) -> list[NodeSpec]:
    """The nodes that simulate a swarm, as `simulated_swarm` has it, of whichever kind its robots are.

    `links` is an existing folder for serial ports and files of the simulation.
    """
    kind = robot_type_of(swarm)
    chosen = replace(options, world=options.world or next(iter(kind.worlds), ""))
    whole, file = placed(options, swarm), Path(options.swarm_file)
    if whole is not swarm:
        file = Path(links) / "placed.yaml"
        save_swarm(whole, file)
    return kind.nodes(chosen, swarm, links, str(file))


def seen_from_above(swarm: Swarm) -> Swarm:
    """The estimator's description of a swarm that an overhead camera alone locates: odometry, no starts."""
    robots = (replace(robot, start=None, camera=None, faces=()) for robot in swarm.robots)
    return Swarm(tuple(robots))


def placed(options: SimulationOptions, swarm: Swarm) -> Swarm:
    """The swarm with a start for each robot; who has none stands where its world puts it, off the others.

    Raises UserError if the world has no place for this number of robots.
    """
    described = [robot.start for robot in swarm.robots if robot.start is not None]
    if len(described) == len(swarm.robots):
        return swarm
    starts = robot_type_of(swarm).starts(options, swarm)
    taken = np.array(described).reshape(-1, 3)[:, :2]
    away = np.linalg.norm(starts[:, None, :2] - taken, axis=-1).min(axis=1, initial=np.inf)
    free = iter(starts[np.sort(np.argsort(-away, kind="stable")[: len(starts) - len(described)])])
    robots = (
        robot if robot.start is not None else replace(robot, start=rounded(next(free)))
        for robot in swarm.robots
    )
    return replace(swarm, robots=tuple(robots))


def _world(swarm_file: str, options: SimulationOptions, links: str, **own: ParameterValue) -> Parameters:
    """Parameters of a world's node."""
    shared: Parameters = {"swarm_file": swarm_file, "seed": options.seed, "rate": options.rate}
    return {**shared, "link_folder": links, **own}


def _epuck_starts(_: SimulationOptions, swarm: Swarm) -> FloatArray:
    """Places of an odd number of robots: of an even number, opposite ones would meet at the crossing."""
    robots = len(swarm.robots)
    return eight_starts(robots + 1 - robots % 2)[:robots]


def _epuck_nodes(options: SimulationOptions, swarm: Swarm, links: str, whole: str) -> list[NodeSpec]:
    file = options.parameter_file
    described: Parameters = {"swarm_file": options.swarm_file}
    world = _world(whole, options, links, world=options.world, answer_within=_ANSWER_WITHIN_S)
    steering: Parameters = {
        **described,
        "speed": options.speed,
        "wait_for_poses": True,
        "aerial": options.aerial,
    }
    estimator, cameras = described, []
    if options.aerial:
        estimator, ground = _aerial_files(options, Path(links))
        world |= {**ground, "aerial_rate": _AERIAL_RATE_HZ}
        seeing: Parameters = {**ground, **_AERIAL_CAMERA, **_reliable("aerial"), **_TIME}
        cameras = [NodeSpec(_VISION, "aerial_camera_node", "aerial_camera", "aerial", seeing, file)]
    nodes = [
        NodeSpec(_ESTIMATOR, "estimator_node", "estimator", "", {**estimator, **_TIME}, file),
        NodeSpec(_DRIVERS, "epuck_world_node", "epuck_world", "", world, file),
        NodeSpec(_DRIVERS, "eight_steering_node", "eight_steering", "", {**steering, **_TIME}, file),
        *cameras,
    ]
    for robot in (one.name for one in swarm.robots):
        driver: Parameters = {"address": f"{links}/{robot}", **_TIME}
        nodes.append(NodeSpec(_DRIVERS, "epuck_driver_node", "epuck_driver", robot, driver, file))
        if not options.aerial:
            camera: Parameters = {**described, "robot": robot, **_reliable(robot), **_TIME}
            nodes.append(NodeSpec(_VISION, "marker_detector_node", "marker_detector", robot, camera, file))
    return nodes


def _reliable(space: str) -> Parameters:
    """Parameters that keep images and calibrations reliable on a busy machine."""
    return {
        f"qos_overrides./{space}/{topic}.subscription.reliability": "reliable"
        for topic in ("image_raw", "camera_info")
    }


def _aerial_files(options: SimulationOptions, folder: Path) -> tuple[Parameters, Parameters]:
    """Write what an overhead camera needs; parameters that name the swarm description and the floor."""
    swarm_file, floor_file = folder / "seen_from_above.yaml", folder / "control_points.yaml"
    save_swarm(seen_from_above(load_swarm(Path(options.swarm_file))), swarm_file)
    save_ground(eight_floor(), floor_file)
    return {"swarm_file": str(swarm_file)}, {"control_points_file": str(floor_file)}


def _droplet_starts(options: SimulationOptions, swarm: Swarm) -> FloatArray:
    return droplet_starts(options.seed, len(swarm.robots))


def _droplet_nodes(options: SimulationOptions, swarm: Swarm, links: str, whole: str) -> list[NodeSpec]:
    """Half of the Droplets wander; a tracker sees the first and the last one."""
    described: Parameters = {"swarm_file": options.swarm_file}
    tracked = list(dict.fromkeys((swarm.robots[0].name, swarm.robots[-1].name)))
    world = _world(whole, options, links, world=options.world, fixed=tracked)
    steering: Parameters = {"swarm_file": whole, "seed": options.seed, **_TIME}
    fleet: Parameters = {**described, "link_folder": links, **_TIME}
    file = options.parameter_file
    return [
        NodeSpec(_ESTIMATOR, "estimator_node", "estimator", "", {**described, **_TIME}, file),
        NodeSpec(_DRIVERS, "droplet_world_node", "droplet_world", "", world, file),
        NodeSpec(_DRIVERS, "droplet_steering_node", "droplet_steering", "", steering, file),
        NodeSpec(_DRIVERS, "droplet_fleet_node", "droplet_fleet", "", fleet, file),
    ]


def _pushbot_starts(options: SimulationOptions, swarm: Swarm) -> FloatArray:
    robots = len(swarm.robots)
    plan = floor_plan(options.plan or _HALL)
    starts = plan.starts
    if len(starts) < robots:
        raise WorldError(f"the floor plan '{plan.name}' has starts for {len(starts)} robots, not {robots}.")
    return np.column_stack([starts[:robots], np.zeros(robots)])


def _pushbot_nodes(options: SimulationOptions, swarm: Swarm, links: str, whole: str) -> list[NodeSpec]:
    """Writes the laser calibrations of the trackers, too. A mapper of several robots must know the starts."""
    robots = [robot.name for robot in swarm.robots]
    calibrate_lasers(robots, options.seed, Path(links))
    described: Parameters = {"swarm_file": whole}
    leds = [f"{robot}={led_hz(index)}" for index, robot in enumerate(robots)] if len(robots) > 1 else []
    mapper: Parameters = {**described, **({"led_frequencies": leds} if leds else {}), **_TIME}
    world = _world(whole, options, links, plan=options.plan or _HALL)
    exploration: Parameters = {**described, "wait_for_poses": True, **_TIME}
    file = options.parameter_file
    nodes = [
        NodeSpec(_ESTIMATOR, "estimator_node", "estimator", "", {**described, **_TIME}, file),
        NodeSpec(_ESTIMATOR, "mapper_node", "mapper", "", mapper, file),
        NodeSpec(_DRIVERS, "pushbot_world_node", "pushbot_world", "", world, file),
        NodeSpec(_DRIVERS, "exploration_node", "exploration", "", exploration, file),
    ]
    for index, robot in enumerate(robots):
        laser: Parameters = {"laser_frequency": laser_hz(index), **_TIME}
        driver: Parameters = {"address": f"{links}/{robot}", "led_frequency": led_hz(index), **laser}
        others = [str(led_hz(other)) for other in range(len(robots)) if other != index]
        tracker: Parameters = {"calibration": f"{links}/{robot}.yaml", **laser}
        tracker |= {"light_frequencies": others} if others else {}
        nodes += [
            NodeSpec(_DRIVERS, "pushbot_driver_node", "pushbot_driver", robot, driver, file),
            NodeSpec(_VISION, "event_tracker_node", "event_tracker", robot, tracker, file),
        ]
    return nodes


def _check_pushbots(swarm: Swarm) -> None:
    """Make sure that all robots have lights of their own; raises WorldError if there are too many robots."""
    if len(swarm.robots) > MAX_ROBOTS:
        raise WorldError(
            f"{len(swarm.robots)} robots are more than the {MAX_ROBOTS} whose lights trackers can tell"
            " from each other."
        )


def _room_starts(options: SimulationOptions, swarm: Swarm) -> FloatArray:
    return room_starts(swarm, room_of(swarm, options.plan), options.seed)


def _check_room(swarm: Swarm) -> None:
    """Check that all sensors can be simulated; raises a UserError otherwise."""
    sensors_of(RoomWorld(swarm, room_of(swarm, ""), 1, 0.0))


def _room_nodes(options: SimulationOptions, swarm: Swarm, links: str, whole: str) -> list[NodeSpec]:
    """Draws the map that the description names, if it is missing."""
    draw_missing_map(swarm, room_of(swarm, options.plan))
    described: Parameters = {"swarm_file": options.swarm_file, **_TIME}
    world, file = (
        _world(whole, options, links, world=options.world, plan=options.plan),
        options.parameter_file,
    )
    nodes = [
        NodeSpec(_ESTIMATOR, "estimator_node", "estimator", "", described, file),
        NodeSpec(_DRIVERS, "room_world_node", "room_world", "", world, file),
    ]
    if swarm.localizer is not None:
        nodes.append(NodeSpec(_ESTIMATOR, "localizer_bridge", "localizer_bridge", "", described, file))
    return nodes


ROOM = RobotType("room", _room_starts, _check_room, _room_nodes, tuple(ROOM_WORLDS))
EPUCK = RobotType("epuck", _epuck_starts, check_swarm, _epuck_nodes, ("w2", "w0", "w2fast"), has_markers=True)
ROBOT_TYPES = {
    one.name: one
    for one in (
        EPUCK,
        RobotType("droplet", _droplet_starts, check_droplets, _droplet_nodes, ("d1", "d0")),
        RobotType("pushbot", _pushbot_starts, _check_pushbots, _pushbot_nodes),
    )
}
"""The kinds of robots that can be simulated, by the type in a swarm description."""
WORLD_NAMES = [world for kind in ROBOT_TYPES.values() for world in kind.worlds]  # those of rooms among them
