"""The drivers of Droplets as ROS 2 nodes: of one Droplet at a cable, and of a fleet of them in one process.

    ./run swarm_loc_drivers droplet_driver_node --ros-args -r __ns:=/droplet1 -p address:=/dev/ttyUSB0 \
        -p partners:='["6B6F", "DF64"]'
    ./run swarm_loc_drivers droplet_fleet_node --ros-args -p swarm_file:=swarm.yaml -p link_folder:=/tmp/links

The driver, one per cable, in the robot's namespace, follows `cmd_vel` and publishes `odom`, `brightness`,
`/tf` and `/diagnostics`; for Droplets without cable it follows and publishes `cmd_vel`, `odom` and `/tf` as
well. Service: `~/measure`. Parameters: see `parameters.py` and `doc/droplet_driver_node.md`.

For every robot of the swarm description that has an infrared board the fleet node starts such a driver, in
the robot's namespace and at the port of `link_folder` that is named like it; they take turns to emit. What
Droplets share, such as their model and their noise, is set once for all of them.
"""

from __future__ import annotations

from array import array
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from swarm_loc_drivers.common.robot_driver_node import RobotDriverNode, stamp_message
from swarm_loc_drivers.droplet.driver import OWN, DropletDriver, DropletListeners
from swarm_loc_drivers.droplet.exchange import Brightness
from swarm_loc_drivers.droplet.parameters import DropletFleetParameters, DropletParameters, DropletTraits
from swarm_loc_estimator.common.node import ConfiguredNode, Stop, run_node, spin
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_msgs.msg import BrightnessMatrix

_BRIGHTNESS_QOS = QoSProfile(depth=50)
_RATES = ("exchanges", "lines")
_WRONG = {
    "bad_cmd_vel": "velocities that were not finite or too large",
    "broken_matrices": "incomplete matrices",
    "equal_powers": "exchanges as bright at near as at far power; check that the firmware supports set_ir",
    "firmware_errors": "errors of the firmware",
    "foreign_receiver": "matrices that another robot has measured",
    "self_heard": "matrices of a robot that heard itself",
    "silent_sensors": "reports of a sensor that reads nothing",
    "unknown_commands": "commands that are unknown to the firmware",
    "unknown_ids": "matrices of robots that are not among the partners",
}


class DropletDriverNode(RobotDriverNode[DropletParameters]):
    """Passes velocities to the driver and publishes its data."""

    _driver: DropletDriver

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("droplet_driver", DropletParameters, **node_arguments)
        robot = self.get_namespace().strip("/")
        self._brightness = self.create_publisher(BrightnessMatrix, "brightness", _BRIGHTNESS_QOS)
        self._odometry = {OWN: self._odometry_output("odom", self._prefix)}
        for name in self.params.relayed_ids:
            path = _relayed_path(robot, name)
            self._odometry[name] = self._odometry_output(f"/{path}/odom", f"{path}/")
        listeners = DropletListeners(
            lambda name, state: self._odometry[name].publish(state), self._publish_brightness
        )
        self._driver = DropletDriver(self.params, listeners, self._now_ns)
        for name in self._odometry:
            topic = f"/{_relayed_path(robot, name)}/cmd_vel" if name else "cmd_vel"
            self._follow(topic, partial(self._driver.set_velocity, name))
        self.create_service(Trigger, "~/measure", self._on_measure)
        self._start_reports(self.params.address, _RATES, _WRONG)

    def _on_measure(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self.params.turns or not self.params.partners:
            response.message = "No partner is asked: there are none, or Droplets take turns."
        elif self._driver.trouble:
            response.message = f"No partner is asked: {self._driver.trouble}"
        else:
            self._driver.request_exchanges()
            response.success = True
            response.message = f"{len(self.params.partners)} partners are asked to emit."
        return response

    def _publish_brightness(self, receiver: int, one: Brightness) -> None:
        message = BrightnessMatrix(
            header=Header(stamp=stamp_message(one.stamp_ns), frame_id=self._base_frame),
            receiver=receiver,
            transmitter=one.transmitter,
            n=len(one.readings),
            power=int(one.power),
            saturation=self.params.saturation,
        )
        message.readings = array("i", one.readings.ravel().tolist())
        self._brightness.publish(message)


def _relayed_path(robot: str, name: str) -> str:
    """Namespace of a robot without a cable: next to that of the robot at the cable."""
    return "/".join([*robot.split("/")[:-1], name])


run_droplet_driver = partial(run_node, "droplet_driver_node", DropletDriverNode)


class DropletFleetNode(ConfiguredNode[DropletFleetParameters]):
    """Runs the nodes of the drivers."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("droplet_fleet", DropletFleetParameters, **node_arguments)
        parameters = self.params
        robots = load_swarm(Path(parameters.swarm_file)).robots
        names = [robot.name for robot in robots if robot.ir is not None]
        part, parts = parameters.part, parameters.parts
        if not names[part::parts]:
            raise ParameterError(f"parameter part = {part} of {parts} has none of the {len(names)} Droplets.")
        simulated = bool(self.get_parameter("use_sim_time").value)
        self._drivers: list[DropletDriverNode] = []
        for turn in range(part, len(names), parts):
            own = {
                **{one.name: getattr(parameters, one.name) for one in fields(DropletTraits)},
                "address": str(Path(parameters.link_folder) / names[turn]),
                "turns": len(names),
                "turn": turn,
                "use_sim_time": simulated,
            }
            # remappings on the command line apply only to the fleet node
            driver = DropletDriverNode(
                namespace=names[turn],
                parameter_overrides=[Parameter(name, value=value) for name, value in own.items()],
                use_global_arguments=False,
                start_parameter_services=False,
            )
            self._drivers.append(driver)

    def run(self, stop: Stop) -> int:
        """Drive all robots until asked to stop; the exit status."""
        for driver in self._drivers:
            driver.start()
        return spin(self, stop, *self._drivers)

    def destroy_node(self) -> None:
        """Stop all robots first."""
        for driver in self._drivers:
            driver.begin_to_stop()
        for driver in self._drivers:
            driver.destroy_node()
        super().destroy_node()


run_droplet_fleet = partial(run_node, "droplet_fleet_node", DropletFleetNode)
