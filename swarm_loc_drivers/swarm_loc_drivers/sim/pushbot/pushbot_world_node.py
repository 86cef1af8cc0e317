"""One simulated world of PushBots as a ROS 2 node: robots that answer their drivers' bytes, and /clock.

    ./run swarm_loc_drivers pushbot_world_node --ros-args -p swarm_file:=swarm.yaml -p first_port:=56000

Drivers connect to tcp://localhost:56000, 56001, ... in the order of the swarm description, or with
`link_folder` to serial ports named like the robots. The node publishes `/clock` and per robot `ground_truth`
(for evaluation and steering).
"""

from __future__ import annotations

from functools import partial
from typing import Any

from swarm_loc_drivers.pushbot.protocol import GENERATIONS
from swarm_loc_drivers.sim.pushbot.firmware import PushbotFirmware
from swarm_loc_drivers.sim.pushbot.world import (
    STEP_NS,
    PushbotWorldParameters,
    SimulatedPushbot,
    make_pushbot_world,
)
from swarm_loc_drivers.sim.world_node import WorldNode
from swarm_loc_estimator.common.node import run_node


class PushbotWorldNode(WorldNode[PushbotWorldParameters]):
    """Steps the world and serves its robots' links."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("pushbot_world", PushbotWorldParameters, **node_arguments)
        params = self.params
        swarm, self._world = make_pushbot_world(params)
        names = [robot.name for robot in swarm.robots]
        self.serve(names, self._firmware_of, params.link_folder, first_port=params.first_port, waits=True)
        self.begin(names, STEP_NS)

    def _firmware_of(self, robot: int) -> PushbotFirmware:
        generation = GENERATIONS[self.params.firmware]
        firmware = PushbotFirmware(SimulatedPushbot(self._world, robot), generation, seed=robot)
        self._world.firmwares[robot] = firmware
        return firmware

    def step(self) -> None:
        """Step the world and publish the time."""
        self._world.step()
        self.publish_step(self._world.now_ns, self._world.poses)


main = partial(run_node, "pushbot_world_node", PushbotWorldNode)
