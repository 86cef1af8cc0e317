"""One simulated room as a ROS 2 node: robots that drive about by themselves, their sensors, and /clock.

    ./run swarm_loc_drivers room_world_node --ros-args -p swarm_file:=swarm.yaml

The node publishes `/clock`, per robot `ground_truth`, and what the sensors of the description measure:
odometry, IMUs, lidars with their mounts on `/tf_static`, radios, detections of ceiling cameras, motion
capture and fixes. `<robot>/cmd_vel` drives a robot.
"""

from __future__ import annotations

import heapq
from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import Twist
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from tf2_msgs.msg import TFMessage

from swarm_loc_drivers.sim.room.sensors import Lidar, Message, sensors_of
from swarm_loc_drivers.sim.room.world import (
    ROOM_WORLDS,
    STEP_NS,
    RoomWorld,
    RoomWorldParameters,
    room_of,
)
from swarm_loc_drivers.sim.world_node import WorldNode
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.node import message_class, run_node
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_msgs.msg import SwarmPoses

_QOS = QoSProfile(depth=20)
_BEHIND_NS = 500_000_000  # Simulated time waits for poses that are older
_STATIC_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class RoomWorldNode(WorldNode[RoomWorldParameters]):
    """Steps the world, publishes clock, true poses and measurements."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("room_world", RoomWorldParameters, **node_arguments)
        params, swarm = self.params, load_swarm(Path(self.params.swarm_file))
        room = room_of(swarm, params.plan)
        self._world = RoomWorld(swarm, room, params.seed, ROOM_WORLDS[params.world])
        self.begin([robot.name for robot in swarm.robots], STEP_NS)
        for k, robot in enumerate(swarm.robots):
            topic = swarm.topic(robot.name, "cmd_vel")
            self.create_subscription(Twist, topic, partial(self._on_command, k), _QOS)
        # sensors with their topics, and messages on their way
        self._sensors = sensors_of(self._world)
        self._outputs: dict[str, Publisher] = {}
        for sensor in self._sensors:
            qos = qos_profile_sensor_data if isinstance(sensor, Lidar) else _QOS
            kind = message_class(sensor.message_type)
            self._outputs |= {one: self.create_publisher(kind, one, qos) for one in sensor.topics}
            if isinstance(sensor, Lidar):
                self._static = self.create_publisher(TFMessage, "/tf_static", _STATIC_QOS)
                self._static.publish(sensor.transforms())
        self._on_the_way: list[tuple[int, Message]] = []
        # an estimator for which simulated time waits
        self._located_ns: int | None = None
        self.create_subscription(SwarmPoses, "swarm/poses", self._on_poses, _QOS)

    def step(self) -> None:
        """Step the world; publish the time and the measurements that arrive now."""
        self._world.step()
        now_ns = self._world.now_ns
        self.publish_step(now_ns, self._world.poses)
        for sensor in self._sensors:
            for message in sensor.messages():
                heapq.heappush(self._on_the_way, message)
        while self._on_the_way and self._on_the_way[0][0] <= now_ns:
            topic, data = heapq.heappop(self._on_the_way)[1]
            self._outputs[topic].publish(data)

    def waits(self) -> bool:
        """Whether simulated time waits for an estimator that is behind."""
        return self._located_ns is not None and self._world.now_ns > self._located_ns + _BEHIND_NS

    def give_up(self) -> None:
        """Nobody publishes poses any more."""
        self._located_ns = None

    def _on_poses(self, message: SwarmPoses) -> None:
        self._located_ns = nanoseconds(message.header.stamp)

    def _on_command(self, robot: int, message: Twist) -> None:
        self._world.command(robot, message.linear.x, message.angular.z)


main = partial(run_node, "room_world_node", RoomWorldNode)
