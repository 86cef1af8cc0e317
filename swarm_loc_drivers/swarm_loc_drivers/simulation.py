"""The whole graph of simulated e-pucks as data: world, drivers, steering, detectors, estimator.

`ros2 launch swarm_loc_drivers simulation.launch.py` and the `simulate` command start the same list.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from swarm_loc_drivers.sim.common.error_model import WORLDS
from swarm_loc_drivers.sim.epuck.world import check_swarm
from swarm_loc_estimator.core.description.swarm import Swarm
from swarm_loc_estimator.io.swarm.swarm_file import load_swarm
from swarm_loc_estimator.launching.graph import NodeSpec, ParameterValue
from swarm_loc_estimator.launching.options import check_parameter_file
from swarm_loc_estimator.parameters.number_spec import number
from swarm_loc_estimator.parameters.table import ParameterError

Parameters = dict[str, ParameterValue]

_ANSWER_WITHIN_S = 0.15
"""Images of real robots take so long to become detections, too."""


@dataclass(frozen=True)
class SimulationOptions:
    """What a user chooses about a simulation.

    Attributes:
        swarm_file: Path of the swarm description.
        world: Which errors robots and cameras have.
        seed: Fixes them.
        speed: Along the eight [m/s].
        rate: Simulated seconds per second, as far as the machine keeps up.
        parameter_file: Path of a ROS parameter file for all nodes, None for none.
    """

    swarm_file: str
    world: str = "w2"
    seed: int = number(1, "1", 0, 2**31 - 1, "fixes them")
    speed: float = number(0.06, "m/s", 0.001, 0.12, "along the eight")
    rate: float = number(
        1.0, "1", 0.01, 100.0, "simulated seconds per second, as far as the machine keeps up"
    )
    parameter_file: str | None = None


def simulated_swarm(options: SimulationOptions) -> Swarm:
    """The swarm of a simulation; looked at here, and not by the world when a score of processes have started.

    Raises:
        UserError: A file cannot be used, or the swarm cannot be simulated.
    """
    if options.world not in WORLDS:
        raise ParameterError(f"argument world = '{options.world}' must be one of {', '.join(WORLDS)}.")
    check_parameter_file(options.parameter_file)
    swarm = load_swarm(Path(options.swarm_file))
    check_swarm(swarm)
    return swarm


def simulation_nodes(options: SimulationOptions, robots: Sequence[str], links: str) -> list[NodeSpec]:
    """The nodes of a simulation, in the order in which they start.

    Args:
        options: What the user chose.
        robots: The names of the swarm's robots.
        links: Folder where their serial ports appear; exists.
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
    steering: Parameters = {**swarm, "speed": options.speed, "wait_for_poses": True}
    file = options.parameter_file
    nodes = [
        NodeSpec(estimator, "estimator_node", "estimator", "", {**swarm, **time}, file),
        NodeSpec(drivers, "epuck_world_node", "epuck_world", "", world, file),
        NodeSpec(drivers, "eight_steering_node", "eight_steering", "", {**steering, **time}, file),
    ]
    for robot in robots:
        address: Parameters = {"address": f"{links}/{robot}"}
        # no image may get lost because the machine is busy, nor the calibration before the first one
        reliable: Parameters = {
            f"qos_overrides./{robot}/{topic}.subscription.reliability": "reliable"
            for topic in ("image_raw", "camera_info")
        }
        camera: Parameters = {**swarm, "robot": robot, **reliable}
        nodes += [
            NodeSpec(drivers, "epuck_driver_node", "epuck_driver", robot, {**address, **time}, file),
            NodeSpec(vision, "marker_detector_node", "marker_detector", robot, {**camera, **time}, file),
        ]
    return nodes
