"""One simulated world of PushBots as a ROS 2 node: robots that answer their drivers' bytes, and /clock.

    ./run swarm_loc_drivers pushbot_world_node --ros-args -p swarm_file:=swarm.yaml -p first_port:=56000

Drivers connect to tcp://localhost:56000, 56001, ... in the order of the swarm description, or with
`link_folder` to serial ports named like the robots. The node publishes `/clock` and per robot `ground_truth`
(for evaluation and steering).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from swarm_loc_drivers.pushbot.hardware import GENERATIONS
from swarm_loc_drivers.sim.pushbot.firmware import PushbotFirmware
from swarm_loc_drivers.sim.pushbot.pushbot_world_parameters import (
    PushbotWorldParameters,
    make_pushbot_world,
)
from swarm_loc_drivers.sim.pushbot.world import STEP_NS, SimulatedPushbot
from swarm_loc_drivers.sim.world_node import Pace, WorldNode
from swarm_loc_estimator.common.node import run_node


class PushbotWorldNode(WorldNode[PushbotWorldParameters]):
    """Steps the world and serves its robots' links."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("pushbot_world", PushbotWorldParameters, **node_arguments)
        chosen = self.params
        swarm, self._world = make_pushbot_world(chosen)
        self._names = [robot.name for robot in swarm.robots]
        link = (
            f"link_folder = {chosen.link_folder}"
            if chosen.link_folder
            else f"first_port = {chosen.first_port}"
        )
        self.begin(self._names, Pace(STEP_NS, chosen.rate, chosen.truth_rate), self._serve, link)

    def _serve(self, robot: int) -> str:
        """Put a robot on its link; the address for its driver."""
        chosen = self.params
        firmware = PushbotFirmware(SimulatedPushbot(self._world, robot), GENERATIONS[chosen.firmware])
        self._world.firmwares[robot] = firmware
        if chosen.link_folder:
            link = Path(chosen.link_folder) / self._names[robot]
            return str(self.host.serve_pty(firmware, link, waits=True))
        port = self.host.serve_tcp(firmware, port=chosen.first_port and chosen.first_port + robot)
        return f"tcp://localhost:{port}"

    def step(self) -> None:
        """Let the world do a step, and tell the time."""
        self._world.step()
        self.tell(self._world.now_ns, self._world.poses)


main = partial(run_node, "pushbot_world_node", PushbotWorldNode)
