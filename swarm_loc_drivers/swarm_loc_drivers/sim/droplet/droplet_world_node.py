"""One simulated world of Droplets as a ROS 2 node: robots that answer at their consoles, and /clock.

    ./run swarm_loc_drivers droplet_world_node --ros-args -p swarm_file:=swarm.yaml -p link_folder:=/tmp/links

Drivers connect to serial ports named like the robots in `link_folder`. The node publishes `/clock`, per robot
`ground_truth` (for evaluation and steering) and, in the place of a tracker above the table, `fix` of some.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import QoSProfile

from swarm_loc_drivers.sim.droplet.firmware import DropletFirmware
from swarm_loc_drivers.sim.droplet.world import (
    STEP_NS,
    DropletWorldParameters,
    SimulatedDroplet,
    Tracker,
    make_droplet_world,
)
from swarm_loc_drivers.sim.world_node import WorldNode
from swarm_loc_estimator.common.messages.poses import encode_fix
from swarm_loc_estimator.common.node import run_node

_FIX_QOS = QoSProfile(depth=10)
_CLOCK_STEPS = 2  # Droplets are slow; many drivers hear the clock


class DropletWorldNode(WorldNode[DropletWorldParameters]):
    """Steps the world, serves its robots' consoles, publishes clock, true poses and fixes."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("droplet_world", DropletWorldParameters, **node_arguments)
        params = self.params
        swarm, self._world = make_droplet_world(params)
        names = [robot.name for robot in swarm.robots]
        self.serve(
            names, lambda robot: DropletFirmware(SimulatedDroplet(self._world, robot)), params.link_folder
        )
        self.begin(names, STEP_NS, clock_steps=_CLOCK_STEPS)
        fixed = tuple(swarm.index_of[name] for name in params.fixed)
        self._tracker = Tracker(
            fixed, params.fix_rate, params.fix_sigma, params.fix_heading_sigma, params.seed
        )
        self._fixes = {
            robot: self.create_publisher(PoseWithCovarianceStamped, f"{names[robot]}/fix", _FIX_QOS)
            for robot in fixed
        }

    def step(self) -> None:
        """Step the world; publish the time and then the fixes of the tracker."""
        self._world.step()
        self.publish_step(self._world.now_ns, self._world.poses)
        variances = np.square([self.params.fix_sigma, self.params.fix_sigma, self.params.fix_heading_sigma])
        for fix in self._tracker.look(self._world.now_ns, self._world.poses):
            message = encode_fix("map", fix.stamp_ns, fix.pose, np.diag(variances))
            self._fixes[fix.robot].publish(message)


main = partial(run_node, "droplet_world_node", DropletWorldNode)
