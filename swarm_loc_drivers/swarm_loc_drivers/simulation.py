"""The whole graph of simulated e-pucks as data: world, drivers, steering, detectors, estimator.

`ros2 launch swarm_loc_drivers simulation.launch.py` and the `simulate` command start the same list.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from swarm_loc_estimator.graph import NodeSpec, ParameterValue

Parameters = dict[str, ParameterValue]

_ANSWER_WITHIN_S = 0.15
"""Pictures of real robots take so long to become detections, too."""


@dataclass(frozen=True)
class SimulationOptions:
    """What a user chooses about a simulation.

    Attributes:
        swarm_file: Path of the swarm description.
        link_folder: Where the robots' serial ports appear; exists.
        world: Which errors robots and cameras have.
        seed: Fixes them.
        speed: Along the eight [m/s].
        rate: Simulated seconds per second, as far as the machine keeps up.
        parameter_file: Path of a ROS parameter file for all nodes, None for none.
    """

    swarm_file: str
    link_folder: str
    world: str = "w2"
    seed: int = 1
    speed: float = 0.06
    rate: float = 1.0
    parameter_file: str | None = None


def simulation_nodes(options: SimulationOptions, robots: Sequence[str]) -> list[NodeSpec]:
    """The nodes of a simulation, in the order in which they start.

    Args:
        options: What the user chose.
        robots: The names of the swarm's robots.
    """
    drivers, vision, estimator = "swarm_loc_drivers", "swarm_loc_vision", "swarm_loc_estimator"
    swarm: Parameters = {"swarm_file": options.swarm_file}
    time: Parameters = {"use_sim_time": True}
    world: Parameters = {
        **swarm,
        "world": options.world,
        "seed": options.seed,
        "rate": options.rate,
        "link_folder": options.link_folder,
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
        address: Parameters = {"address": f"{options.link_folder}/{robot}"}
        # no picture may get lost because the machine is busy
        reliable: Parameters = {f"qos_overrides./{robot}/image_raw.subscription.reliability": "reliable"}
        camera: Parameters = {**swarm, "robot": robot, **reliable}
        nodes += [
            NodeSpec(drivers, "epuck_driver_node", "epuck_driver", robot, {**address, **time}, file),
            NodeSpec(vision, "marker_detector_node", "marker_detector", robot, {**camera, **time}, file),
        ]
    return nodes
