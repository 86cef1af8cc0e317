"""Publishes the messages of a bag with /clock, as `ros2 bag play --clock` does, for machines without it.

    ./run swarm_loc_estimator play --ros-args -p bag:=FOLDER -p rate:=4.0

Topics keep the names and types of the bag; remappings work as for any node. The node ends with the bag.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rosbags.interfaces import Qos, QosDurability, QosLiveliness, QosReliability
from rosgraph_msgs.msg import Clock as ClockMessage

from swarm_loc_estimator.common.bags.reader import BagReader, RawMessage
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.common.node import ConfiguredNode, MessageTypeError, Stop, message_class, run_node
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_estimator.nodes.parameters import PlayerParameters
from swarm_loc_estimator.nodes.playback import STEP_S, PlayedSoFar, play

_CLOCK = "clock"
_POLL_S = 0.05
_SETTLED_S = 0.5  # Discovery of subscriptions counts as complete after this time without a new one
_SAY_EVERY_S = 5.0
_LAST_WORDS_S = 30.0
"""For acknowledgements: DDS removes a dead subscriber after 20 s; a lossy radio asks again every 3 s."""
_AT_ONCE = Duration(nanoseconds=0)
_RUN_ON_S = 0.25  # /clock goes on after the last message, so that timers of other nodes process it
DEPTH = 1000  # History depth of the player's publishers, whatever the recorded depth; enough for any rate
RELIABLE = QoSProfile(depth=DEPTH)  # Reliable, which matches reliable and best-effort subscribers
LATCHED = QoSProfile(depth=DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_LATCHED_TOPICS = frozenset({"tf_static", "robot_description", "map"})

_LONGEST_NS = 2**63 - 1


class PlayNode(ConfiguredNode[PlayerParameters]):
    """Publishes the messages of a bag at their log times."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("player", PlayerParameters, **node_arguments)
        self._reader = BagReader(Path(self.params.bag))
        first_ns, last_ns = self._reader.time_range_ns
        self._begin_ns = first_ns + round(self.params.start_offset_s * 1e9)
        if self._begin_ns > last_ns:
            rule = f"must lie within the bag, which lasts {1e-9 * (last_ns - first_ns):g} s"
            raise ParameterError(f"parameter start_offset_s = {self.params.start_offset_s:g} {rule}.")
        self._publisher_of: dict[str, Publisher] = {}
        # first of all: others learn of publishers in this order, and of thousands the last one after long
        clock = partial(self.create_publisher, ClockMessage, "/clock", RELIABLE)
        self._clock_publisher = clock() if self.params.clock else None
        # the topics to play, without the /clock of the bag
        topics = {topic.name: topic for topic in self._reader.topics if topic.name != _CLOCK}
        wanted = [name.lstrip("/") for name in self.params.topics]
        for name in wanted:
            if name not in topics:
                there = f"'{self.params.bag}' has: {listed([*topics])}"
                raise ParameterError(f"parameter topics names '{name}', but {there}.")
        for topic in (topics[name] for name in wanted or topics):
            try:
                publishes = message_class(topic.type)
            except MessageTypeError:
                why = f"there is no type {topic.type} here"
                self.get_logger().warning(f"{topic.name} is not played: {why}")
                continue
            qos = playing_qos(topic.name, self._reader.offered_qos.get(topic.name, ()))
            self._publisher_of[topic.name] = self.create_publisher(publishes, topic.name, qos)
        self._own_executor = EventsExecutor()
        self._own_executor.add_node(self)
        self.so_far = PlayedSoFar()
        self._now_ns = 0

    def run(self, stop: Stop) -> int:
        """Play to the end, or until asked to stop; returns the exit status."""
        self._wait_for_subscribers(stop)
        while not stop.requested:
            played_before = self.so_far.messages
            messages = takewhile(lambda _: not stop.requested, self._reader.messages(self._publisher_of))
            play(messages, self._begin_ns, self.params.rate, self, self.so_far)
            if not self.params.loop or self.so_far.messages == played_before:
                break
        self._wait_for_acknowledgements(stop)
        # /clock goes on after the last message, in real time whatever the rate
        begin_s, begin_ns = time.monotonic(), self._now_ns
        for step in range(1, 0 if stop.requested else round(_RUN_ON_S / STEP_S) + 1):
            self.wait_until(begin_s + step * STEP_S)
            self.publish_clock(begin_ns + step * round(STEP_S * 1e9))
        for loss in self._reader.losses:
            print(f"play: {loss}", file=sys.stderr)
        print(self.so_far.summary(), flush=True)
        return 0

    def destroy_node(self) -> None:
        """Close the bag and destroy the node."""
        self._reader.close()
        self._own_executor.shutdown()
        super().destroy_node()

    def publish(self, message: RawMessage) -> None:
        """Publish a message of the bag."""
        topic, _, _, data = message
        self._publisher_of[topic].publish(bytes(data))

    def publish_clock(self, now_ns: int) -> None:
        """Publish /clock, if enabled."""
        self._now_ns = now_ns
        if self._clock_publisher is not None:
            self._clock_publisher.publish(ClockMessage(clock=Time(nanoseconds=now_ns).to_msg()))

    def now_s(self) -> float:
        """The steady clock."""
        return time.monotonic()

    def wait_until(self, instant_s: float) -> None:
        """Wait until an instant of the steady clock; serve the node's parameters meanwhile."""
        self._own_executor.spin_once(timeout_sec=max(0.0, instant_s - time.monotonic()))
        while (left_s := instant_s - time.monotonic()) > 0.0:
            self._own_executor.spin_once(timeout_sec=left_s)

    def _wait_for_subscribers(self, stop: Stop) -> None:
        """Wait until enough topics have subscribers and no new ones appear; log the reason."""
        wanted = self.params.wait_for_subscribers
        said_s = changed_s = time.monotonic()
        heard, clock_heard = 0, False
        while wanted and not stop.requested:
            now_s, before = time.monotonic(), heard
            heard = sum(p.get_subscription_count() > 0 for p in self._publisher_of.values())
            clock_heard = self._clock_publisher is None or self._clock_publisher.get_subscription_count() > 0
            changed_s = now_s if heard != before else changed_s
            if heard >= wanted and clock_heard and now_s > changed_s + _SETTLED_S:
                return
            if now_s > said_s + _SAY_EVERY_S:
                said_s = now_s
                clock = "" if clock_heard else " and for one of /clock (use_sim_time of the others)"
                self.get_logger().info(f"waiting for subscribers: {heard} of {wanted} topics have one{clock}")
            self._own_executor.spin_once(timeout_sec=_POLL_S)

    def _wait_for_acknowledgements(self, stop: Stop) -> None:
        """Wait until all subscribers have acknowledged the last message, or until stopped; log the reason."""
        silent, begin_s = self._publisher_of, time.monotonic()
        said_s = begin_s
        while silent and not stop.requested and (now_s := time.monotonic()) < begin_s + _LAST_WORDS_S:
            silent = {name: one for name, one in silent.items() if not one.wait_for_all_acked(_AT_ONCE)}
            if silent and now_s > said_s + _SAY_EVERY_S:
                said_s = now_s
                self.get_logger().info(f"waiting until all is received on {listed([*silent])}")
            if silent:
                self._own_executor.spin_once(timeout_sec=_POLL_S)
        if silent and not stop.requested:
            self.get_logger().warning(f"not everything was received on {listed([*silent])}")


def playing_qos(topic: str, recorded: Sequence[Qos]) -> QoSProfile:
    """The profile of a topic by those recorded; if they differ: reliable, and latched where that is usual."""
    profiles = [_profile(one) for one in recorded]
    if profiles and all(one == profiles[0] for one in profiles):
        return profiles[0]
    return LATCHED if topic in _LATCHED_TOPICS else RELIABLE


def _profile(recorded: Qos) -> QoSProfile:
    """A recorded profile; unspecified policies are replaced by the defaults of this player."""
    latched = recorded.durability is QosDurability.TRANSIENT_LOCAL
    is_lossy = recorded.reliability is QosReliability.BEST_EFFORT
    by_hand = recorded.liveliness is QosLiveliness.MANUAL_BY_TOPIC
    durations = {
        name: Duration(nanoseconds=min(time.sec * 1_000_000_000 + time.nsec, _LONGEST_NS))
        for name in ("deadline", "lifespan", "liveliness_lease_duration")
        for time in [getattr(recorded, name)]
    }
    return QoSProfile(
        # of a latched topic, late subscribers get as much as they used to
        depth=recorded.depth if latched and 0 < recorded.depth < DEPTH else DEPTH,
        reliability=ReliabilityPolicy.BEST_EFFORT if is_lossy else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC if by_hand else LivelinessPolicy.AUTOMATIC,
        **durations,
    )


main = partial(run_node, "play", PlayNode)
