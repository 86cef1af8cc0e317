"""Simulated rooms as bags: what the sensors of a description send while its robots drive about."""

from __future__ import annotations

import heapq
from dataclasses import replace
from pathlib import Path

import numpy as np

from swarm_loc_drivers.sim.room.sensors import Lidar, Message, sensors_of
from swarm_loc_drivers.sim.room.world import (
    ROOM_WORLDS,
    RoomWorld,
    draw_missing_map,
    room_of,
    room_starts,
)
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import POSE_STAMPED, TRANSFORMS
from swarm_loc_estimator.common.messages.poses import encode_pose_stamped
from swarm_loc_estimator.swarm.swarm import Swarm

TRUTH_NS = 50_000_000


def placed_world(swarm: Swarm, world: str, seed: int, plan: str = "") -> RoomWorld:
    """The world of a swarm whose robots stand where the seed says; its map is drawn if it is missing."""
    room = room_of(swarm, plan)
    draw_missing_map(swarm, room)
    starts = [(x, y, theta) for x, y, theta in room_starts(swarm, room, seed).tolist()]
    robots = (replace(robot, start=start) for robot, start in zip(swarm.robots, starts, strict=True))
    return RoomWorld(replace(swarm, robots=tuple(robots)), room, seed, ROOM_WORLDS[world])


def record_room(world: RoomWorld, seconds: float, folder: Path) -> None:
    """Run a world and write its messages and true poses to a bag, in order of arrival."""
    sensors, on_the_way = sensors_of(world), list[tuple[int, Message]]()
    names = [robot.name for robot in world.swarm.robots]
    with BagWriter(folder) as bag:
        for name in names:
            bag.add_topic(f"{name}/ground_truth", POSE_STAMPED)
        for sensor in sensors:
            for topic in sensor.topics:
                bag.add_topic(topic, sensor.message_type)
            if isinstance(sensor, Lidar):
                bag.add_topic("tf_static", TRANSFORMS)
                bag.write("tf_static", world.now_ns, sensor.transforms())
        end_ns = world.now_ns + round(1e9 * seconds)
        while world.now_ns < end_ns:
            world.step()
            for message in (one for sensor in sensors for one in sensor.messages()):
                heapq.heappush(on_the_way, message)
            while on_the_way and on_the_way[0][0] <= world.now_ns:
                at_ns, (topic, data) = heapq.heappop(on_the_way)
                bag.write(topic, at_ns, data)
            if world.now_ns % TRUTH_NS == 0:
                stamp_ns = np.array([world.now_ns])
                for name, pose in zip(names, world.poses, strict=True):
                    data = encode_pose_stamped("map", stamp_ns, pose[None])[0]
                    bag.write(f"{name}/ground_truth", world.now_ns, data)
