"""Packets of events as ROS messages."""

from __future__ import annotations

from array import array

from std_msgs.msg import Header

from swarm_loc_drivers.common.odometry_output import stamp_message
from swarm_loc_drivers.pushbot.event_packets import EventPacket
from swarm_loc_drivers.pushbot.hardware import SENSOR_PX
from swarm_loc_estimator.common.messages.event_encoding import ENCODING
from swarm_loc_msgs.msg import EventPacket as EventPacketMessage


def event_message(packet: EventPacket, frame: str) -> EventPacketMessage:
    """A packet as a message; its bytes are copied once."""
    return EventPacketMessage(
        header=Header(stamp=stamp_message(packet.stamp_ns), frame_id=frame),
        height=SENSOR_PX,
        width=SENSOR_PX,
        seq=packet.number,
        time_base=max(0, packet.board_ns),
        encoding=ENCODING,
        events=array("B", packet.data),
    )
