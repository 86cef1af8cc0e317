"""The graph of simulated PushBots as data: a hall, drivers, trackers, mapper, estimator, and who drives."""

from __future__ import annotations

from collections.abc import Sequence

from swarm_loc_drivers.sim.pushbot.optics import MAX_ROBOTS, laser_hz, led_hz
from swarm_loc_drivers.sim.worlds import WorldError, start_of
from swarm_loc_estimator.common.launching.graph import NodeSpec, ParameterValue
from swarm_loc_estimator.swarm.swarm import Swarm

TYPE = "pushbot"
"""The type, in a swarm description, of robots that are simulated so."""

Parameters = dict[str, ParameterValue]


def has_pushbots(swarm: Swarm) -> bool:
    """Whether a swarm is one of PushBots.

    Raises:
        WorldError: Only some of it are, or one has no start.
    """
    types = {robot.type for robot in swarm.robots}
    if TYPE not in types:
        return False
    for robot in swarm.robots:
        if robot.type != TYPE:
            raise WorldError(
                f"robot '{robot.name}' is no {TYPE}, and others are: one world has one kind of robots."
            )
        start_of(robot)
    if len(swarm.robots) > MAX_ROBOTS:
        raise WorldError(
            f"{len(swarm.robots)} robots are more than the {MAX_ROBOTS} whose lights trackers can tell"
            " from each other."
        )
    return True


def pushbot_nodes(world: Parameters, robots: Sequence[str], links: str, file: str | None) -> list[NodeSpec]:
    """The nodes of a simulation of PushBots, in the order in which they start.

    Args:
        world: Parameters of the world: `swarm_file`, `plan`, `seed` and `rate`.
        robots: Names of the robots.
        links: Folder where their serial ports appear, and where their laser calibrations are.
        file: Path of a ROS parameter file for all nodes, None for none.
    """
    drivers, vision, estimator = "swarm_loc_drivers", "swarm_loc_vision", "swarm_loc_estimator"
    time: Parameters = {"use_sim_time": True}
    swarm: Parameters = {"swarm_file": world["swarm_file"]}
    leds = [f"{robot}={led_hz(number)}" for number, robot in enumerate(robots)] if len(robots) > 1 else []
    mapper: Parameters = {**swarm, **({"led_frequencies": leds} if leds else {}), **time}
    exploration: Parameters = {**swarm, "wait_for_poses": True, **time}
    hall: Parameters = {**world, "link_folder": links}
    nodes = [
        NodeSpec(estimator, "estimator_node", "estimator", "", {**swarm, **time}, file),
        NodeSpec(estimator, "mapper_node", "mapper", "", mapper, file),
        NodeSpec(drivers, "pushbot_world_node", "pushbot_world", "", hall, file),
        NodeSpec(drivers, "exploration_node", "exploration", "", exploration, file),
    ]
    for number, robot in enumerate(robots):
        laser: Parameters = {"laser_frequency": laser_hz(number), **time}
        driver: Parameters = {"address": f"{links}/{robot}", "led_frequency": led_hz(number), **laser}
        others = [str(led_hz(other)) for other in range(len(robots)) if other != number]
        tracker: Parameters = {"calibration": f"{links}/{robot}.yaml", **laser}
        tracker |= {"light_frequencies": others} if others else {}
        nodes += [
            NodeSpec(drivers, "pushbot_driver_node", "pushbot_driver", robot, driver, file),
            NodeSpec(vision, "event_tracker_node", "event_tracker", robot, tracker, file),
        ]
    return nodes
