"""The driver of one PushBot as a ROS 2 node, in the robot's namespace.

    ./run swarm_loc_drivers pushbot_driver_node --ros-args -r __ns:=/pushbot1 -p address:=tcp://192.168.1.11

It takes `cmd_vel` and publishes `odom`, `events`, `/tf` and `/diagnostics`. Parameters: see
`doc/pushbot_driver_node.md`.
"""

from __future__ import annotations

from array import array
from functools import partial
from typing import Any

from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header

from swarm_loc_drivers.common.robot_driver_node import RobotDriverNode, stamp_message
from swarm_loc_drivers.pushbot.driver import PushbotDriver, PushbotListeners
from swarm_loc_drivers.pushbot.event_parser import EventPacket, precompile
from swarm_loc_drivers.pushbot.parameters import PushbotParameters
from swarm_loc_drivers.pushbot.protocol import SENSOR_PX
from swarm_loc_estimator.common.messages.cdr import EVENT_PACKETS
from swarm_loc_estimator.common.messages.event_encoding import ENCODING
from swarm_loc_estimator.common.node import message_class, run_node

EVENT_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)  # Holds half a second of packets
_RATES = ("events", "packets", "readings")
_WRONG = {
    "bad_cmd_vel": "velocities that were not finite or too large",
    "corrupt_events": "wrongly decoded events, as after lost bytes",
    "counter_restarts": "discontinuous wheel ticks",
    "ignored_stops": "stops that the wheels did not obey within a second",
    "implausible_counters": "wheel ticks beyond the motors' speed",
    "long_lines": "lines of text without an end",
    "refused_commands": "commands that the robot did not understand",
    "skipped_bytes": "bytes outside events and lines",
    "time_jumps": "times that stepped back or far ahead",
}


class PushbotDriverNode(RobotDriverNode[PushbotParameters]):
    """Passes velocities to the driver and publishes its data."""

    _driver: PushbotDriver

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("pushbot_driver", PushbotParameters, **node_arguments)
        precompile()
        odometry = self._odometry_output("odom", self._prefix)
        self._camera_frame = f"{self._prefix}event_camera_optical_frame"
        self._packet_class = message_class(EVENT_PACKETS[0])
        self._events = self.create_publisher(self._packet_class, "events", EVENT_QOS)
        self._driver = PushbotDriver(
            self.params, PushbotListeners(odometry.publish, self._publish), self._now_ns
        )
        self._start_reports(str(self.params.link_address), _RATES, _WRONG)
        self._follow("cmd_vel", self._driver.set_velocity)

    def _publish(self, packet: EventPacket) -> None:
        message = self._packet_class(
            header=Header(stamp=stamp_message(packet.stamp_ns), frame_id=self._camera_frame),
            height=SENSOR_PX,
            width=SENSOR_PX,
            seq=packet.number,
            time_base=max(0, packet.board_ns),
            encoding=ENCODING,
        )
        message.events = array("B", packet.data)
        self._events.publish(message)


main = partial(run_node, "pushbot_driver_node", PushbotDriverNode)
