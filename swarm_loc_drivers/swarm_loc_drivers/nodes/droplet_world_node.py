"""One simulated world of Droplets as a ROS 2 node: robots that answer at their consoles, and /clock.

    ./run swarm_loc_drivers droplet_world_node --ros-args -p swarm_file:=swarm.yaml -p link_folder:=/tmp/links

Drivers connect to serial ports named like the robots in `link_folder`. The node publishes `/clock`, per robot
`ground_truth` (for evaluation and steering) and, in the place of a tracker above the table, `fix` of some.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile

from swarm_loc_drivers.nodes.droplet_world_parameters import DropletWorldParameters, make_droplet_world
from swarm_loc_drivers.nodes.odometry_output import stamp_message, yaw_quaternion
from swarm_loc_drivers.nodes.world_time import WorldTime
from swarm_loc_drivers.sim.droplet_fixes import Fix, Tracker
from swarm_loc_drivers.sim.droplet_world import STEP_NS, SimulatedDroplet
from swarm_loc_drivers.sim.firmware.droplet_firmware import DropletFirmware
from swarm_loc_drivers.sim.firmware.host import FirmwareHost
from swarm_loc_estimator.io.planar import planar_covariance
from swarm_loc_estimator.nodes.declare import declare_parameters
from swarm_loc_estimator.nodes.parameter_table import ParameterError
from swarm_loc_estimator.nodes.running import Stop, run_node

_FIX_QOS = QoSProfile(depth=10)
_CLOCK_STEPS = 2
"""Droplets are slow; many drivers hear the clock."""


class DropletWorldNode(Node):
    """Steps the world, serves its robots' consoles, publishes what is to be seen of it.

    Args:
        node_arguments: Further arguments of `rclpy.node.Node`.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("droplet_world", **node_arguments)
        self._wishes = declare_parameters(self, DropletWorldParameters)
        swarm, self._world = make_droplet_world(self._wishes)
        names = [robot.name for robot in swarm.robots]
        self._host = FirmwareHost()
        for robot, name in enumerate(names):
            self.get_logger().info(f"{name} answers at {self._serve(robot, name)}")
        rate, truth_rate = self._wishes.rate, self._wishes.truth_rate
        self._time = WorldTime(self, names, STEP_NS, rate, truth_rate, _CLOCK_STEPS)
        self._tracker = Tracker(
            tuple(swarm.index_of[name] for name in self._wishes.fixed),
            self._wishes.fix_rate,
            (self._wishes.fix_sigma, self._wishes.fix_heading_sigma),
            self._wishes.seed,
        )
        self._fixes = {
            swarm.index_of[name]: self.create_publisher(PoseWithCovarianceStamped, f"{name}/fix", _FIX_QOS)
            for name in self._wishes.fixed
        }

    def run(self, stop: Stop) -> int:
        """Let time pass until asked to stop; the exit status."""
        self._time.run(self._step, self._host, stop)
        return 0

    def destroy_node(self) -> None:
        """Switch the robots off, too."""
        self._host.close()
        super().destroy_node()

    def _serve(self, robot: int, name: str) -> str:
        """Put a robot on its port; the address for its driver."""
        folder = self._wishes.link_folder
        try:
            return str(
                self._host.serve_pty(
                    DropletFirmware(SimulatedDroplet(self._world, robot)), Path(folder) / name
                )
            )
        except OSError as error:
            raise ParameterError(
                f"parameter link_folder = {folder} cannot be used for {name}: {error.strerror}."
            ) from error

    def _step(self) -> None:
        self._world.step()
        self._time.tell(self._world.now_ns, self._world.poses)
        for fix in self._tracker.look(self._world.now_ns, self._world.poses):
            self._fixes[fix.robot].publish(self._fix_message(fix))

    def _fix_message(self, fix: Fix) -> PoseWithCovarianceStamped:
        message = PoseWithCovarianceStamped()
        message.header.stamp = stamp_message(fix.stamp_ns)
        message.header.frame_id = "map"
        pose, (sigma, heading_sigma) = message.pose.pose, self._tracker.sigmas
        pose.position.x, pose.position.y = float(fix.pose[0]), float(fix.pose[1])
        pose.orientation = yaw_quaternion(float(fix.pose[2]))
        covariance = planar_covariance(sigma**2, sigma**2, heading_sigma**2)
        message.pose.covariance = np.ravel(covariance)
        return message


def main() -> int:
    """Run until SIGINT or SIGTERM; 1 when a parameter cannot be used."""
    return run_node("droplet_world_node", DropletWorldNode, DropletWorldNode.run)


if __name__ == "__main__":
    sys.exit(main())
