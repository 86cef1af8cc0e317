"""Serves a web page with a live view of the swarm.

    ./run swarm_loc_estimator watch_node --ros-args -p swarm_file:=swarm.yaml

It subscribes to `swarm/poses`, `swarm/sightings` (while a page is open), `/diagnostics`, `aerial/detections`,
`aerial/identities`, `map`, `<robot>/ground_truth` and `<robot>/goal`; and publishes `/diagnostics`, and
`<robot>/cmd_vel` where driving is allowed. Parameters: see `doc/watch.md`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from swarm_loc_estimator.common.health import PATIENCE_S, Report, drop_values, level_of
from swarm_loc_estimator.common.messages.cdr import SWARM_POSES, CdrError
from swarm_loc_estimator.common.messages.poses import SwarmPosesReader
from swarm_loc_estimator.common.node import ConfiguredNode, run_node
from swarm_loc_estimator.mapping.messages import decode_occupancy_grid
from swarm_loc_estimator.nodes.parameters import WatchParameters
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.sightings import decode_sightings
from swarm_loc_estimator.watch.page import Frame, about, map_frame, poses_frame, sightings_frame
from swarm_loc_estimator.watch.robot_commands import RobotCommands
from swarm_loc_estimator.watch.robot_places import AerialNames, NewestMessages, Places
from swarm_loc_estimator.watch.server import Access, WatchServer
from swarm_loc_msgs.msg import AnonymousDetectionArray, RobotIdentities, SwarmPoses, SwarmSightings

_FLEETING = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches every publisher; messages that arrive too fast are lost for this node only."""
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_WORK_S, _LOOK_S = 0.05, 1.0
_PLACES_PERIOD_S = 0.1


class WatchNode(ConfiguredNode[WatchParameters]):
    """Converts messages to frames and passes them to the server.

    Args:
        node_arguments: Further arguments of `rclpy.node.Node`.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("watch", WatchParameters, **node_arguments)
        path = Path(self.params.swarm_file)
        self._swarm = load_swarm(path)
        self._names = tuple(robot.name for robot in self._swarm.robots)
        self._reader = SwarmPosesReader()
        self._newest_ns = 0
        self._places_s = -1.0
        self._heard_s = time.monotonic()
        self._known_drops: Counter[str] = Counter()
        self._aerial = AerialNames(dict(self._swarm.index_of))
        self._sightings: Subscription | None = None
        self._truth, self._truth_places = self._places("truth", "ground_truth", keeps=False)
        self._goals, self._goal_places = self._places("goals", "goal", keeps=True)
        self._commands = RobotCommands(self, self._names, self.params, time.monotonic_ns)
        title = self.params.title or path.resolve().parent.name
        first = about(self._swarm, title, teleop=self.params.teleop, commands=self.params.commands)
        access = Access(self.params.address, self.params.token)
        self.server = WatchServer(first, access, self.params.port, self.params.rate, self._commands.order)
        self._subscribe()
        self.create_steady_timer(_WORK_S, self._commands.work)
        self.create_steady_timer(_LOOK_S, self._look_around)
        self.start_diagnostics(self._on_diagnostics_timer)
        self.get_logger().info(f"watch the swarm at {self.server.url}")

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Subscriptions that an executor handles; the others are polled when new poses arrive."""
        taken = self._truth.subscriptions | self._goals.subscriptions if hasattr(self, "_goals") else ()
        return (one for one in super().subscriptions if one not in taken)

    def destroy_node(self) -> None:
        """Close the connections of pages and destroy the node."""
        self.server.close()
        super().destroy_node()

    def _places(self, kind: str, topic: str, *, keeps: bool) -> tuple[NewestMessages, Places]:
        topics = [f"{name}/{topic}" for name in self._names]
        drop = partial(self._drop, f"<robot>/{topic}")
        return NewestMessages(self, PoseStamped, topics), Places(kind, drop, keeps=keeps)

    def _subscribe(self) -> None:
        raw: Callable[..., Subscription] = partial(self.create_subscription, raw=True)
        raw(SwarmPoses, "swarm/poses", self._on_poses, _FLEETING)
        raw(DiagnosticArray, "/diagnostics", self._on_diagnostics, _FLEETING)
        self.create_subscription(
            AnonymousDetectionArray,
            "aerial/detections",
            lambda message: self._publish(self._aerial.detections(message)),
            _FLEETING,
        )
        self.create_subscription(
            RobotIdentities,
            "aerial/identities",
            lambda message: self._publish(self._aerial.identities(message)),
            _FLEETING,
        )
        follow = SubscriptionEventCallbacks(incompatible_qos=self._follow_map)
        self._map = raw(OccupancyGrid, "map", self._on_map, _LATCHED, event_callbacks=follow)

    def _follow_map(self, _event: object) -> None:
        """Subscribe again if the map's publisher is volatile or best effort."""
        if self._map.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT:
            return
        self.destroy_subscription(self._map)
        self._map = self.create_subscription(OccupancyGrid, "map", self._on_map, _FLEETING, raw=True)
        self.get_logger().info("map is not published transient local: it is shown from its next message on")

    def _publish(self, frame: Frame | None) -> None:
        if frame is not None:
            self.server.publish(frame)

    def _on_poses(self, data: bytes) -> None:
        try:
            estimate = self._reader.read(data)
        except CdrError:
            self._drop("swarm/poses", "malformed")
            return
        if estimate.names != self._names:
            self._drop("swarm/poses", "other_swarm")
            return
        if (
            estimate.stamp_ns < self._newest_ns
        ):  # the clock has jumped back, and the server clears its history
            self._truth_places.clear()
            self._goal_places.clear()
        self._newest_ns = estimate.stamp_ns
        self._heard_s = time.monotonic()
        self.server.publish(poses_frame(estimate))
        if self._heard_s > self._places_s + _PLACES_PERIOD_S:
            self._places_s = self._heard_s
            self._truth.take(self._truth_places.take)
            self._goals.take(self._goal_places.take)
            self._publish(self._truth_places.frame())
            self._publish(self._goal_places.frame())

    def _on_sightings(self, data: bytes) -> None:
        try:
            self.server.publish(sightings_frame(*decode_sightings(data)))
        except CdrError:
            self._drop("swarm/sightings", "malformed")

    def _on_map(self, data: bytes) -> None:
        try:
            self.server.publish(map_frame(self._newest_ns, decode_occupancy_grid(data)))
        except CdrError:
            self._drop("map", "malformed")

    def _on_diagnostics(self, data: bytes) -> None:
        """Forward the diagnostics of the robots that some page has selected."""
        chosen = self.server.selected
        if not chosen:
            return
        wanted = {f"{self.params.estimator}: {self._names[robot]}": robot for robot in chosen}
        for status in deserialize_message(data, DiagnosticArray).status:
            robot = wanted.get(status.name)
            if robot is not None:
                values = {pair.key: pair.value for pair in status.values}
                report = {"robot": robot, "message": status.message, "values": values}
                stamp_ms = self._newest_ns * 1e-6
                self.server.send_text({"kind": "report", "stamp": stamp_ms, **report}, robot)

    def _look_around(self) -> None:
        """Subscribe to published topics, and to sightings while a page is open; report missing ones."""
        published = dict(self.get_topic_names_and_types())
        self._truth.look_for_publishers(published)
        self._goals.look_for_publishers(published)
        if self.server.has_viewers and self._sightings is None:
            self._sightings = self.create_subscription(
                SwarmSightings, "swarm/sightings", self._on_sightings, _FLEETING, raw=True
            )
        elif not self.server.has_viewers and self._sightings is not None:
            self.destroy_subscription(self._sightings)
            self._sightings = None
        if time.monotonic() > self._heard_s + PATIENCE_S:
            self._heard_s = time.monotonic()
            missing = f"messages received on swarm/poses{self.why_missing('swarm/poses', SWARM_POSES)}"
            self.health.warn("missing", f"no {missing}")
            self.server.send_text({"kind": "said", "text": f"No {missing}.", "ok": False})

    def _on_diagnostics_timer(self) -> None:
        self.health.warn_of_drops()
        self.health.drops["command too_many"] = self._commands.dropped
        load, drops = self.server.load(), +self.health.drops
        grown, self._known_drops = drops - self._known_drops, drops
        said = [f"{count} dropped: {what}" for what, count in grown.items()]
        said += [f"{load.slow} slow"] if load.slow else []
        values: dict[str, object] = {
            "pages": load.pages,
            "slow pages": load.slow,
            "frames left out for slow pages": load.left_out,
            "texts left out for slow pages": load.texts_left_out,
            "pages refused": load.refused,
            **drop_values(drops),
        }
        message = ", ".join([f"{load.pages} pages", *said])
        self.publish_reports(Report(self.get_name(), message, level_of(said), values))

    def _drop(self, topic: str, reason: str) -> None:
        """Count a dropped message."""
        self.health.drop(f"{topic} {reason}")


main = partial(run_node, "watch_node", WatchNode)
