"""Builds one map with many robots, by laser pointers or lidars, as a ROS 2 node.

    ./run swarm_loc_estimator mapper_node --ros-args -p swarm_file:=swarm.yaml

Topics, services and parameters: see `doc/mapper_node.md`. The estimator, which owns the transforms, fuses
the fixes.
"""

from __future__ import annotations

import array
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.health import PATIENCE_S, Report, drop_values, level_of, listed
from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_estimator.common.messages.poses import encode_fix, encode_pose_stamped
from swarm_loc_estimator.common.node import BACKWARDS, ConfiguredNode, message_class, run_node
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.mapping import mapper_feed
from swarm_loc_estimator.mapping.grid import CELL, OccupancyMap
from swarm_loc_estimator.mapping.map_file import load_map, save_map
from swarm_loc_estimator.mapping.mapper import CooperativeMapper, Located
from swarm_loc_estimator.mapping.mapper_feed import MapperFeed, MapperInput
from swarm_loc_estimator.mapping.messages import led_frequencies
from swarm_loc_estimator.nodes.mapper_precompile import precompile
from swarm_loc_estimator.nodes.parameters import MapperParameters, chosen_robots
from swarm_loc_estimator.sensors.mounts import TF_STATIC, Mounts
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm

_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_TF_STATIC_QOS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_INPUT_QOS = QoSProfile(depth=200)


class MapperNode(ConfiguredNode[MapperParameters]):
    """Converts the inputs, calls the mapper and publishes its map, goals and fixes."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("mapper", MapperParameters, **node_arguments)
        swarm = load_swarm(Path(self.params.swarm_file))
        names = chosen_robots(self.params.robots, list(swarm.index_of))
        self._robots = [swarm.robots[swarm.index_of[name]] for name in names]
        self._mounts = Mounts(Swarm(tuple(self._robots)))
        independent = [robot.name for robot in self._robots if robot.fix.systematic_share < 1.0]
        if independent:
            need = f"its type in '{self.params.swarm_file}' needs 'fix: {{systematic_share: 1.0}}'"
            why = "an error of the map is in all of its fixes"
            raise mapper_feed.MapperInputError(f"robot '{independent[0]}' maps: {need}, since {why}.")
        self._frequencies = led_frequencies(self.params.led_frequencies, names)
        path = self.params.load_map
        self._background: OccupancyMap | None = load_map(Path(path), CELL) if path else None
        if not is_precompiled(precompile):
            self.get_logger().info("compiling the mapper for this machine: about half a minute")
        precompile()
        self._unframed = {f"{one.name}/{MapperInput.SCAN.topic}" for one in self._robots if one.lidar.is_used}
        self._clear()
        self._map = self.create_publisher(OccupancyGrid, "map", _LATCHED)
        self._visitation = self.create_publisher(OccupancyGrid, "visitation", _LATCHED)
        goal, fix = (PoseStamped, _LATCHED), (PoseWithCovarianceStamped, QoSProfile(depth=10))
        self._goals = [self.create_publisher(goal[0], f"{name}/goal", goal[1]) for name in names]
        self._fixes = [self.create_publisher(fix[0], f"{name}/fix", fix[1]) for name in names]
        for index, robot in enumerate(self._robots):
            for kind in mapper_feed.inputs_of(robot, lights=bool(self._frequencies)):
                take = partial(self._on_message, index, kind)
                topic = f"{robot.name}/{kind.topic}"
                qos = qos_profile_sensor_data if kind is MapperInput.SCAN else _INPUT_QOS
                self.create_subscription(message_class(kind.message_type), topic, take, qos, raw=True)
        spaces = ["", *(f"{robot.name}/" for robot in self._robots)] if self._unframed else []
        for topic in (f"{space}{TF_STATIC}" for space in spaces):
            take = partial(self._on_mount, topic)
            self.create_subscription(TFMessage, f"/{topic}", take, _TF_STATIC_QOS, raw=True)
        self.create_service(Trigger, "~/save_map", self._on_save)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self._jumps = self.get_clock().create_jump_callback(BACKWARDS, post_callback=self._on_jump)
        self.create_steady_timer(self.params.map_period_s, self._publish_map)
        self.start_diagnostics(self._on_diagnostics)
        self.get_logger().info(f"ready: {len(self._robots)} robots of '{self.params.swarm_file}'")

    def _clear(self, begin: Mapping[int, FloatArray] = MappingProxyType({})) -> None:
        """Start with an empty map and robots that have not joined yet, see `MapperFeed`."""
        self._mapper = CooperativeMapper(self.params.settings)
        self._mapper.background = self._background
        self.feed = MapperFeed(self._robots, self._mapper, self._frequencies, begin)
        self._located: dict[int, Located] = {}
        self._published: OccupancyMap | None = None

    def _on_mount(self, topic: str, data: bytes) -> None:
        """Take mounts of lidars from static transforms and first scans; with others the map starts over."""
        self._mounts.add_message(topic, data)
        robots = list(self._mounts.described().robots)
        if robots != self._robots:
            self._robots = robots
            if self._mapper.graph.count:
                self._clear(self.feed.begin)
            self.feed.describe(robots)
            self.get_logger().info(" ".join(self._mounts.remarks()))

    def _on_message(self, robot: int, kind: MapperInput, data: bytes) -> None:
        topic = f"{self._robots[robot].name}/{kind.topic}"
        if topic in self._unframed:
            self._unframed.remove(topic)
            self._on_mount(topic, data)
        self.feed.add(robot, kind, data)
        number = self.feed.number(robot)
        located = self._mapper.tracks[number].located if number is not None else None
        if number is None or located is None or self._located.get(robot) is located:
            return
        self._located[robot] = located
        frame, goal = self.params.map_frame, self._mapper.goal(number)
        covariance = mapper_feed.fix_covariance(self._mapper.covariance(number))
        self._fixes[robot].publish(encode_fix(frame, located.stamp_ns, located.pose, covariance))
        if goal is not None:
            # with the heading of the straight line from the present position
            way = goal.position - goal.pose[:2]
            pose = np.array([[*goal.position, np.arctan2(way[1], way[0])]])
            self._goals[robot].publish(encode_pose_stamped(frame, np.array([goal.stamp_ns]), pose)[0])

    def _publish_map(self) -> None:
        occupancy = self._mapper.occupancy()
        if occupancy is self._published:
            return
        self._published = occupancy
        header = Header(frame_id=self.params.map_frame, stamp=self.get_clock().now().to_msg())
        # probability of each cell [%], -1 if unknown, and its number of visits by robots, at most 100
        visits = np.minimum(self._mapper.visits.on(occupancy), 100).astype(float)
        self._map.publish(_grid(occupancy, occupancy.percent, header))
        self._visitation.publish(_grid(occupancy, visits, header))

    def _on_jump(self, _jump: object) -> None:
        self._clear()
        self.get_logger().warning("clock jumped back; map reset")

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._clear()
        response.success, response.message = (True, "The map has been reset.")
        return response

    def _on_save(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Solve all poses again and write the map."""
        self._mapper.finish()
        try:
            path, image = save_map(self._mapper.occupancy(), Path(self.params.save_map))
            response.success, response.message = True, f"The map is in '{path}' and '{image}'."
        except UserError as error:
            response.success, response.message = False, str(error)
        return response

    def _on_diagnostics(self) -> None:
        type_of = {kind.topic: kind.message_type for kind in MapperInput}
        named = [(topic, type_of[topic.rpartition("/")[2]]) for topic in self.feed.missing()]
        missing = [f"{topic}{self.why_missing(topic, kind)}" for topic, kind in named]
        sentence = f"no messages received on {listed(missing)}" if missing else ""
        self.health.warn_of("missing", {"": sentence} if missing else {}, PATIENCE_S)
        self.health.warn_of_drops(self.feed.all_drops)
        graph = self._mapper.graph
        values: dict[str, object] = {
            "stops": graph.count,
            "bearings": graph.constraints.bearings.count,
            **self._mapper.counters,
            **drop_values(self.feed.all_drops + self.feed.dropped_beams),
        }
        for kind in MapperInput:
            count = sum(self.feed.received[index, kind] for index in range(len(self._robots)))
            values[f"<robot>/{kind.topic} received"] = count
        message = sentence or f"{graph.count} stops"
        self.publish_reports(Report(self.get_name(), message, level_of(missing), values))


def _grid(occupancy: OccupancyMap, values: FloatArray, header: Header) -> OccupancyGrid:
    message = OccupancyGrid(header=header)
    message.info.map_load_time = header.stamp
    message.info.resolution = occupancy.cell
    message.info.width, message.info.height = values.shape
    message.info.origin.position.x, message.info.origin.position.y = map(float, occupancy.corner)
    message.info.origin.orientation.w = 1.0
    message.data = array.array("b", np.ascontiguousarray(np.round(values).astype(np.int8).T).tobytes())
    return message


main = partial(run_node, "mapper_node", MapperNode)
