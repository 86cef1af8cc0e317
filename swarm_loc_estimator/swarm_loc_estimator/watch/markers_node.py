"""Shows the swarm to RViz and Foxglove: markers of all robots, and each robot's filtered odometry.

    ./run swarm_loc_estimator markers_node --ros-args -p swarm_file:=swarm.yaml

It publishes `swarm/markers` and `<robot>/odometry/filtered`. While one of these has a subscriber, the node
subscribes to `swarm/poses`, `swarm/sightings` and, for the twist, `<robot>/odom`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from visualization_msgs.msg import MarkerArray

from swarm_loc_estimator.common.messages import poses
from swarm_loc_estimator.common.messages.cdr import CdrError
from swarm_loc_estimator.common.messages.poses import EstimateMessage, SwarmPosesReader
from swarm_loc_estimator.common.node import ConfiguredNode, run_node
from swarm_loc_estimator.nodes.parameters import MarkersParameters
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.sightings import Sightings, decode_sightings
from swarm_loc_estimator.watch.markers import MarkersEncoder
from swarm_loc_msgs.msg import SwarmPoses, SwarmSightings

_LOOK_S = 0.5
_FLEETING = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
_RELIABLE = QoSProfile(depth=10)
_THROTTLE_S = 30.0
_OLD_NS = 1_000_000_000
_UNKNOWN_TWIST = (0.0, 0.0, 0.0)


class MarkersNode(ConfiguredNode[MarkersParameters]):
    """Converts estimates while its topics have subscribers."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("markers", MarkersParameters, **node_arguments)
        self._swarm = load_swarm(Path(self.params.swarm_file))
        self._names = tuple(robot.name for robot in self._swarm.robots)
        self._reader = SwarmPosesReader()
        self._encoder: MarkersEncoder | None = None
        self._period_ns = round(1e9 / self.params.rate)
        self._sent_ns = 0

        self._seen: tuple[int, Sightings] | None = None
        self._twist: dict[int, tuple[float, float, float]] = {}
        self._markers = self.create_publisher(MarkerArray, "swarm/markers", _RELIABLE)
        topics = [f"{name}/odometry/filtered" for name in self._names]
        self._filtered = [self.create_publisher(Odometry, topic, _RELIABLE) for topic in topics]
        self._heard: dict[str, Subscription] = {}
        self.create_steady_timer(_LOOK_S, self._look_around)
        self.get_logger().info(f"ready: {len(self._names)} robots of '{self.params.swarm_file}'")

    def _look_around(self) -> None:
        """Subscribe to the inputs that the present subscribers need."""
        markers = bool(self._markers.get_subscription_count())
        robots = [k for k, one in enumerate(self._filtered) if one.get_subscription_count()]
        self._listen("swarm/poses", SwarmPoses, self._on_poses, wanted=markers or bool(robots))
        self._listen("swarm/sightings", SwarmSightings, self._on_sightings, wanted=markers)
        for k, name in enumerate(self._names):
            self._listen(f"{name}/odom", Odometry, partial(self._on_odometry, k), wanted=k in robots)

    def _listen(self, topic: str, message_class: type, use: Any, *, wanted: bool) -> None:
        if wanted and topic not in self._heard:
            take = partial(self._on_message, topic, use)
            self._heard[topic] = self.create_subscription(message_class, topic, take, _FLEETING, raw=True)
        elif not wanted and topic in self._heard:
            self.destroy_subscription(self._heard.pop(topic))

    def _on_message(self, topic: str, use: Callable[[bytes], None], data: bytes) -> None:
        try:
            use(data)
        except CdrError:
            self._warn(topic)

    def _on_odometry(self, robot: int, data: bytes) -> None:
        self._twist[robot] = poses.decode_odometry(data).twist

    def _on_sightings(self, data: bytes) -> None:
        self._seen = decode_sightings(data)

    def _on_poses(self, data: bytes) -> None:
        estimate = self._reader.read(data)
        if estimate.names != self._names:
            self._warn("swarm/poses of another swarm")
            return
        self._publish_odometry(estimate)
        is_due = abs(estimate.stamp_ns - self._sent_ns) >= self._period_ns
        if is_due and self._markers.get_subscription_count():
            self._sent_ns = estimate.stamp_ns
            self._encoder = self._encoder or MarkersEncoder(self._swarm, estimate.frame_id)
            seen = self._seen if self._seen and abs(estimate.stamp_ns - self._seen[0]) <= _OLD_NS else None
            self._markers.publish(self._encoder.encode(estimate, seen[1] if seen else None))

    def _publish_odometry(self, estimate: EstimateMessage) -> None:
        """Publish pose in map and twist of the robots whose topics have subscribers."""
        for k, publisher in enumerate(self._filtered):
            if not np.isfinite(estimate.pose[k]).all() or not publisher.get_subscription_count():
                continue
            covariance = poses.planar_covariance(0.0, 0.0, 0.0)
            covariance[poses.PLANE] = estimate.covariance[k]
            frames = estimate.frame_id, f"{self._names[k]}/base_link"
            stamps_ns = np.array([estimate.stamp_ns])
            twists = np.array([self._twist.get(k, _UNKNOWN_TWIST)])
            messages = poses.encode_odometry(*frames, stamps_ns, estimate.pose[k : k + 1], twists, covariance)
            publisher.publish(messages[0])

    def _warn(self, what: str) -> None:
        self.get_logger().warning(f"{what} cannot be read", throttle_duration_sec=_THROTTLE_S)


main = partial(run_node, "markers_node", MarkersNode)
