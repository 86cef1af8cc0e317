"""Serves a web page with a live view of the swarm.

    ./run swarm_loc_estimator watch_node --ros-args -p swarm_file:=swarm.yaml

Topics and parameters: see `doc/watch.md`. It subscribes to `swarm/sightings` while a page is open.
"""

from __future__ import annotations

import math
import queue
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import OccupancyGrid
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from swarm_loc_estimator.common.health import PATIENCE_S, Report, drop_values, level_of
from swarm_loc_estimator.common.messages.cdr import SWARM_POSES, CdrError, nanoseconds
from swarm_loc_estimator.common.messages.poses import SwarmPosesReader, decode_pose_stamped
from swarm_loc_estimator.common.node import ConfiguredNode, run_node
from swarm_loc_estimator.mapping.messages import decode_occupancy_grid
from swarm_loc_estimator.nodes.parameters import WatchParameters
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.sightings import decode_sightings
from swarm_loc_estimator.watch import page
from swarm_loc_estimator.watch.page import Frame
from swarm_loc_estimator.watch.server import Access, Answer, Command, WatchServer
from swarm_loc_msgs import msg
from swarm_loc_msgs.srv import SetRobotPose

_MAX_WAITING = 64
_DRIVEN_NS = 400_000_000  # Time without a command after which a driven robot is stopped


class RobotCommands:
    """Executes commands one after the other, in the node's thread; `now_ns` is a steady clock."""

    def __init__(
        self, node: Node, names: Sequence[str], parameters: WatchParameters, now_ns: Callable[[], int]
    ) -> None:
        self._node = node
        self._names = names
        self._parameters = parameters
        self._now_ns = now_ns
        self.dropped = 0  # Number of commands dropped from the full queue
        self._waiting: queue.Queue[tuple[Command, Answer]] = queue.Queue(_MAX_WAITING)
        self._reset = node.create_client(Trigger, f"{parameters.estimator}/reset")
        self._set_pose = node.create_client(SetRobotPose, f"{parameters.estimator}/set_robot_pose")
        self._velocity: dict[int, Publisher] = {}
        self._driven_until_ns: dict[int, int] = {}
        self._obey: Mapping[str, Callable[[Command, Answer], None]] = {
            "reset": lambda _, answer: self._call(self._reset, Trigger.Request(), answer),
            "set_pose": self._on_set_pose,
            "drive": self._on_drive,
        }

    def order(self, command: Command, answer: Answer) -> None:
        """Queue a command; may be called from any thread."""
        try:
            self._waiting.put_nowait((command, answer))
        except queue.Full:
            self.dropped += 1
            answer("Too many commands at once: this one was dropped.", ok=False)

    def work(self) -> None:
        """Execute queued commands, and stop robots whose last drive command is too old."""
        while not self._waiting.empty():  # only this thread takes commands out
            command, answer = self._waiting.get_nowait()
            if refusal := self._refusal(command):
                answer(refusal, ok=False)
            else:
                self._obey[command["do"]](command, answer)
        for robot, until_ns in tuple(self._driven_until_ns.items()):
            if self._now_ns() > until_ns:
                del self._driven_until_ns[robot]
                self._velocity[robot].publish(Twist())

    def _refusal(self, command: Command) -> str:
        """Reason to refuse a command, one sentence; "" if it is accepted."""
        todo = command["do"]
        if todo not in self._obey:
            return f"There is no command '{todo}'."
        if todo == "drive" and not self._parameters.teleop:
            return "Driving is not allowed: parameter teleop is false."
        if todo != "drive" and not self._parameters.commands:
            return "Commands are not allowed: parameter commands is false."
        return "" if command["robot"] >= 0 or todo == "reset" else "The command names no robot."

    def _on_set_pose(self, command: Command, answer: Answer) -> None:
        pose = numbers(command.get("pose"), 3)
        if pose is None:
            answer("A pose is three finite numbers.", ok=False)
            return
        request = SetRobotPose.Request(robot=self._names[command["robot"]])
        where = request.pose.pose
        where.position.x, where.position.y = pose[:2]
        where.orientation.z, where.orientation.w = math.sin(pose[2] / 2.0), math.cos(pose[2] / 2.0)
        self._call(self._set_pose, request, answer)

    def _on_drive(self, command: Command, answer: Answer) -> None:
        ways = numbers([command.get("ahead"), command.get("left")], 2)
        if ways is None or max(map(abs, ways)) > 1.0:
            answer("Driving needs two shares from -1 to 1.", ok=False)
            return
        robot = command["robot"]
        if robot not in self._velocity:
            self._velocity[robot] = self._node.create_publisher(Twist, f"{self._names[robot]}/cmd_vel", 1)
        message = Twist()
        message.linear.x = ways[0] * self._parameters.teleop_speed
        message.angular.z = ways[1] * self._parameters.teleop_turn_rate
        self._velocity[robot].publish(message)
        self._driven_until_ns[robot] = self._now_ns() + _DRIVEN_NS

    def _call(self, client: Any, request: Any, answer: Answer) -> None:
        """Call a service whose response has `success` and `message`, and return these as answer."""
        if not client.service_is_ready():
            answer(f"Nobody offers {client.srv_name}: is the estimator running?", ok=False)
            return

        def on_done(future: Any) -> None:
            response = future.result()
            answer(response.message, ok=response.success)

        client.call_async(request).add_done_callback(on_done)


def numbers(values: object, count: int) -> list[float] | None:
    """The given number of finite numbers from a page; None if invalid."""
    found: list[float] = []
    if isinstance(values, list) and all(type(one) in (int, float) for one in values):
        with suppress(OverflowError):  # a whole number of more than 308 digits
            found = [float(one) for one in values]
    return found if len(found) == count and all(map(math.isfinite, found)) else None


_OLD_NS = 500_000_000
_IMAGES = 8
_NEWEST_ONLY = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches reliable and best-effort publishers, and never blocks one."""


class Places:
    """The newest place of each robot, of a topic `<robot>/...` that is subscribed to once it has a publisher.

    With `keeps` a place is valid until the next one, at any age. No executor may handle the subscriptions.
    """

    def __init__(
        self, node: Node, kind: str, topics: Sequence[str], drop: Callable[[str], None], *, keeps: bool
    ) -> None:
        self._node = node
        self._kind = kind
        self._drop = drop
        self._keeps = keeps
        self._topics = {node.resolve_topic_name(topic): robot for robot, topic in enumerate(topics)}
        self._subscriptions: dict[int, Subscription] = {}
        self._newest: dict[int, tuple[int, tuple[float, float, float]]] = {}
        self._sent_ns = -1

    def look_for_publishers(self, published: Mapping[str, object]) -> None:
        """Subscribe to the topics that have a publisher by now."""
        for topic, robot in self._topics.items():
            if robot not in self._subscriptions and topic in published:
                self._subscriptions[robot] = self._node.create_subscription(
                    PoseStamped, topic, lambda _data: None, _NEWEST_ONLY, raw=True
                )

    @property
    def subscriptions(self) -> frozenset[Subscription]:
        """Subscriptions that no executor may handle."""
        return frozenset(self._subscriptions.values())

    def frame(self) -> Frame | None:
        """All places, of the messages received by now; None if none has changed since the last call."""
        for robot, subscription in self._subscriptions.items():
            taken = subscription.handle.take_message(PoseStamped, True)
            if taken is None:
                continue
            try:
                message = decode_pose_stamped(taken[0])
            except CdrError:
                self._drop("malformed")
                continue
            if np.isfinite(message.pose).all():
                self._newest[robot] = (message.stamp_ns, message.pose)
            else:
                self._drop("not_finite")
        newest_ns = max((stamp_ns for stamp_ns, _ in self._newest.values()), default=-1)
        if newest_ns == self._sent_ns:
            return None
        self._sent_ns = newest_ns
        limit_ns = 0 if self._keeps else newest_ns - _OLD_NS
        shown = {robot: pose for robot, (at_ns, pose) in self._newest.items() if at_ns >= limit_ns}
        return page.places_frame(self._kind, newest_ns, [*shown], np.array([*shown.values()]).reshape(-1, 3))

    def clear(self) -> None:
        """Clear all places."""
        self._newest.clear()
        self._sent_ns = -1


class AerialNames:
    """Joins anonymous detections with their identities, by the stamp of their image."""

    def __init__(self, index_of: dict[str, int]) -> None:
        self._index_of = index_of
        self._images: dict[int, msg.AnonymousDetectionArray] = {}

    def detections(self, message: msg.AnonymousDetectionArray) -> Frame:
        """The frame of an image without identities."""
        stamp_ns = nanoseconds(message.header.stamp)
        self._images[stamp_ns] = message
        while len(self._images) > _IMAGES:
            del self._images[next(iter(self._images))]
        return self._frame(stamp_ns, ())

    def identities(self, message: msg.RobotIdentities) -> Frame | None:
        """The frame of one of the newest images with identities; None for an older image."""
        stamp_ns = nanoseconds(message.header.stamp)
        if stamp_ns not in self._images:
            return None
        return self._frame(stamp_ns, message.identities)

    def _frame(self, stamp_ns: int, identities: Iterable[msg.RobotIdentity]) -> Frame:
        seen = self._images[stamp_ns].detections
        position = np.array([(one.x, one.y) for one in seen]).reshape(-1, 2)
        robot, probability = np.full(len(seen), -1), np.zeros(len(seen))
        for one in identities:
            if 0 <= one.detection < len(seen) and one.name in self._index_of:
                robot[one.detection] = self._index_of[one.name]
                probability[one.detection] = one.probability
        return page.aerial_frame(stamp_ns, position, robot, probability)


_FLEETING = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches every publisher; messages that arrive too fast are lost only for this node."""
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_WORK_S, _LOOK_S = 0.05, 1.0
_PLACES_PERIOD_S = 0.1


class WatchNode(ConfiguredNode[WatchParameters]):
    """Converts messages to frames and passes them to the server."""

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
        self._places: list[Places] = []
        for kind, topic in (("truth", "ground_truth"), ("goals", "goal")):
            topics = [f"{name}/{topic}" for name in self._names]
            drop = partial(self._drop, f"<robot>/{topic}")
            self._places.append(Places(self, kind, topics, drop, keeps=kind == "goals"))
        self._commands = RobotCommands(self, self._names, self.params, time.monotonic_ns)
        title = self.params.title or path.resolve().parent.name
        first = page.about(self._swarm, title, teleop=self.params.teleop, commands=self.params.commands)
        access = Access(self.params.address, self.params.token)
        self.server = WatchServer(first, access, self.params.port, self.params.rate, self._commands.order)
        raw: Callable[..., Subscription] = partial(self.create_subscription, raw=True)
        raw(msg.SwarmPoses, "swarm/poses", self._on_poses, _FLEETING)
        raw(DiagnosticArray, "/diagnostics", self._on_diagnostics, _FLEETING)
        hear, aerial, show = self.create_subscription, self._aerial, self._publish
        image = msg.AnonymousDetectionArray
        hear(image, "aerial/detections", lambda m: show(aerial.detections(m)), _FLEETING)
        hear(msg.RobotIdentities, "aerial/identities", lambda m: show(aerial.identities(m)), _FLEETING)
        follow = SubscriptionEventCallbacks(incompatible_qos=self._follow_map)
        self._map = raw(OccupancyGrid, "map", self._on_map, _LATCHED, event_callbacks=follow)
        self.create_steady_timer(_WORK_S, self._commands.work)
        self.create_steady_timer(_LOOK_S, self._look_around)
        self.start_diagnostics(self._on_diagnostics_timer)
        self.get_logger().info(f"watch the swarm at {self.server.url}")

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Subscriptions that an executor handles; the others are polled when new poses arrive."""
        taken = {one for places in getattr(self, "_places", ()) for one in places.subscriptions}
        return (one for one in super().subscriptions if one not in taken)

    def destroy_node(self) -> None:
        """Close the connections of pages and destroy the node."""
        self.server.close()
        super().destroy_node()

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
        # the clock has jumped back, and the server clears its history
        if estimate.stamp_ns < self._newest_ns:
            for places in self._places:
                places.clear()
        self._newest_ns = estimate.stamp_ns
        self._heard_s = time.monotonic()
        self.server.publish(page.poses_frame(estimate))
        if self._heard_s > self._places_s + _PLACES_PERIOD_S:
            self._places_s = self._heard_s
            for places in self._places:
                self._publish(places.frame())

    def _on_sightings(self, data: bytes) -> None:
        try:
            self.server.publish(page.sightings_frame(*decode_sightings(data)))
        except CdrError:
            self._drop("swarm/sightings", "malformed")

    def _on_map(self, data: bytes) -> None:
        try:
            self.server.publish(page.map_frame(self._newest_ns, decode_occupancy_grid(data)))
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
                self.server.send_text({"kind": "report", "stamp": self._newest_ns * 1e-6, **report}, robot)

    def _look_around(self) -> None:
        """Subscribe to published topics, and to sightings while a page is open; report missing ones."""
        published = dict(self.get_topic_names_and_types())
        for places in self._places:
            places.look_for_publishers(published)
        if self.server.has_viewers and self._sightings is None:
            create = partial(self.create_subscription, msg.SwarmSightings, "swarm/sightings", raw=True)
            self._sightings = create(self._on_sightings, _FLEETING)
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
        self.health.drop(f"{topic} {reason}")


main = partial(run_node, "watch_node", WatchNode)
