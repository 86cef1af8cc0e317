"""The whole graph of simulated robots as data: of e-pucks world, drivers, steering, detectors, estimator.

`ros2 launch swarm_loc_drivers simulation.launch.py` and the `simulate` command start the same list.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from swarm_loc_drivers.sim.epuck.world import check_swarm
from swarm_loc_drivers.sim.pushbot.floor_plan import FLOOR_PLANS
from swarm_loc_drivers.sim.pushbot.wall_drive import calibrate_lasers
from swarm_loc_drivers.sim.pushbot_simulation import has_pushbots, pushbot_nodes
from swarm_loc_drivers.sim.render.scene import TOP_HEIGHT, TOP_RADIUS
from swarm_loc_drivers.sim.scenarios.eight import ARENA
from swarm_loc_drivers.sim.scenarios.eight_images import eight_floor
from swarm_loc_drivers.sim.worlds import WORLDS
from swarm_loc_estimator.common.launching.graph import NodeSpec, ParameterValue
from swarm_loc_estimator.common.launching.options import check_parameter_file
from swarm_loc_estimator.common.number_spec import number
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.swarm.swarm_writer import save_swarm
from swarm_loc_vision.aerial.ground_file import save_ground

Parameters = dict[str, ParameterValue]

_ANSWER_WITHIN_S = 0.15
"""Images of real robots take so long to become detections, too."""
_AERIAL_RATE_HZ = 3.0
_AERIAL_CAMERA: Parameters = {
    "robot_height": TOP_HEIGHT,
    "robot_diameter": 2.0 * TOP_RADIUS,
    "x_min": -0.5 * ARENA[0],
    "x_max": 0.5 * ARENA[0],
    "y_min": -0.5 * ARENA[1],
    "y_max": 0.5 * ARENA[1],
}
"""What the node is told of the robots and of the arena."""


@dataclass(frozen=True)
class SimulationOptions:
    """What a user chooses about a simulation.

    Attributes:
        swarm_file: Path of the swarm description.
        world: Which errors robots and cameras have.
        seed: Fixes them.
        speed: Along the eight [m/s].
        rate: Simulated seconds per second, as far as the machine keeps up.
        plan: The hall, of PushBots.
        aerial: Whether a camera above, which cannot tell the robots apart, is all that locates them.
        parameter_file: Path of a ROS parameter file for all nodes, None for none.
    """

    swarm_file: str
    world: str = "w2"
    seed: int = number(1, "1", 0, 2**31 - 1, "fixes them")
    speed: float = number(0.06, "m/s", 0.001, 0.12, "along the eight")
    rate: float = number(
        1.0, "1", 0.01, 100.0, "simulated seconds per second, as far as the machine keeps up"
    )
    plan: str = "corridor"
    aerial: bool = False
    parameter_file: str | None = None


def simulated_swarm(options: SimulationOptions) -> Swarm:
    """The swarm of a simulation; looked at here, and not by the world when a score of processes have started.

    Raises:
        UserError: A file cannot be used, or the swarm cannot be simulated.
    """
    if options.world not in WORLDS:
        raise ParameterError(f"argument world = '{options.world}' must be one of {', '.join(WORLDS)}.")
    if options.plan not in FLOOR_PLANS:
        raise ParameterError(f"argument plan = '{options.plan}' must be one of {', '.join(FLOOR_PLANS)}.")
    check_parameter_file(options.parameter_file)
    swarm = load_swarm(Path(options.swarm_file))
    if not has_pushbots(swarm):
        check_swarm(swarm)
    return swarm


def graph_of(options: SimulationOptions, swarm: Swarm, links: str) -> list[NodeSpec]:
    """The nodes that simulate a swarm, of whichever kind its robots are.

    Args:
        options: What the user chose.
        swarm: As `simulated_swarm` has it.
        links: Folder for serial ports and files of the simulation; exists.
    """
    robots = [robot.name for robot in swarm.robots]
    if not has_pushbots(swarm):
        return simulation_nodes(options, robots, links)
    calibrate_lasers(robots, options.seed, Path(links))
    world: Parameters = {
        "swarm_file": options.swarm_file,
        "plan": options.plan,
        "seed": options.seed,
        "rate": options.rate,
    }
    return pushbot_nodes(world, robots, links, options.parameter_file)


def seen_from_above(swarm: Swarm) -> Swarm:
    """A swarm as the estimator is given it when an overhead camera is all that there is.

    Robots have odometry alone, and where they start is not known.
    """
    robots = (replace(robot, start=None, camera=None, faces=()) for robot in swarm.robots)
    return Swarm(tuple(robots))


def simulation_nodes(options: SimulationOptions, robots: Sequence[str], links: str) -> list[NodeSpec]:
    """The nodes of a simulation of e-pucks, in the order in which they start.

    Args:
        options: What the user chose.
        robots: The names of the swarm's robots.
        links: Folder where their serial ports appear; exists. An overhead camera's files are written there.
    """
    drivers, vision, estimator = "swarm_loc_drivers", "swarm_loc_vision", "swarm_loc_estimator"
    swarm: Parameters = {"swarm_file": options.swarm_file}
    time: Parameters = {"use_sim_time": True}
    world: Parameters = {
        **swarm,
        "world": options.world,
        "seed": options.seed,
        "rate": options.rate,
        "link_folder": links,
        "answer_within": _ANSWER_WITHIN_S,
    }
    steering: Parameters = {**swarm, "speed": options.speed, "wait_for_poses": True, "aerial": options.aerial}
    described: Parameters = dict(swarm)
    file = options.parameter_file
    cameras: list[NodeSpec] = []
    if options.aerial:
        described, ground = _aerial_files(options, Path(links))
        world |= {**ground, "aerial_rate": _AERIAL_RATE_HZ}
        seeing: Parameters = {**ground, **_AERIAL_CAMERA, **_reliable("aerial"), **time}
        cameras = [NodeSpec(vision, "aerial_camera_node", "aerial_camera", "aerial", seeing, file)]
    nodes = [
        NodeSpec(estimator, "estimator_node", "estimator", "", {**described, **time}, file),
        NodeSpec(drivers, "epuck_world_node", "epuck_world", "", world, file),
        NodeSpec(drivers, "eight_steering_node", "eight_steering", "", {**steering, **time}, file),
        *cameras,
    ]
    for robot in robots:
        address: Parameters = {"address": f"{links}/{robot}"}
        nodes.append(NodeSpec(drivers, "epuck_driver_node", "epuck_driver", robot, {**address, **time}, file))
        if not options.aerial:
            camera: Parameters = {**swarm, "robot": robot, **_reliable(robot), **time}
            nodes.append(NodeSpec(vision, "marker_detector_node", "marker_detector", robot, camera, file))
    return nodes


def _reliable(space: str) -> Parameters:
    """That no image of a camera may get lost because the machine is busy, nor the calibration before it."""
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
