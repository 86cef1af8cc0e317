"""Listens to the live graph of a swarm for some seconds."""

from __future__ import annotations

import signal
import time
from contextlib import suppress
from functools import partial

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from swarm_loc_estimator.common.node import MessageTypeError, message_class
from swarm_loc_estimator.doctor.doctor import is_looked_at, keep
from swarm_loc_estimator.doctor.evidence import Evidence, Heard, Message, Publisher, Wanted
from swarm_loc_estimator.offline.recorded_bag import Progress
from swarm_loc_estimator.swarm.swarm import Swarm

_FLEETING = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)  # Hears every publisher
_LATCHED = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_LOOK_S = 0.5  # Time between two looks at the topics of the graph [s]
_OWN = ("parameter_events", "rosout")


class Listener(Node):
    """Keeps messages of wanted types on topics in a namespace ("": none), with arrivals by its clock."""

    def __init__(
        self, swarm: Swarm, namespace: str = "", is_wanted: Wanted = is_looked_at, *, use_sim_time: bool
    ) -> None:
        override = Parameter("use_sim_time", Parameter.Type.BOOL, use_sim_time)
        super().__init__("doctor", namespace=namespace, parameter_overrides=[override])
        self._swarm = swarm
        self._is_wanted = is_wanted
        self._messages: dict[str, list[Message]] = {}
        self._types: dict[str, str] = {}
        self._full: dict[str, str] = {}

    def listen(self, seconds: float, progress: Progress) -> Evidence:
        """What is heard in some seconds, or until SIGINT."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        begin_s = time.monotonic()
        looked_s = begin_s - _LOOK_S
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with suppress(KeyboardInterrupt):
            while (now_s := time.monotonic()) < begin_s + seconds:
                if now_s - looked_s >= _LOOK_S:
                    self._follow_topics()
                    looked_s = now_s
                progress((now_s - begin_s) / seconds, "listening")
                executor.spin_once(timeout_sec=0.1)
        executor.remove_node(self)
        # messages before the first /clock have no time of arrival; without any /clock, that is the finding
        is_timed = any(one.arrival_ns for kept in self._messages.values() for one in kept)
        topics = {}
        for name, kind in self._types.items():
            messages = [one for one in self._messages.get(name, []) if one.arrival_ns or not is_timed]
            publishers = [
                Publisher(
                    f"{one.node_namespace.rstrip('/')}/{one.node_name}",
                    one.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT,
                    one.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
                )
                for one in self.get_publishers_info_by_topic(self._full[name])
            ]
            topics[name] = Heard(kind, messages, tuple(publishers))
        return Evidence(self._swarm, topics, is_live=True)

    def _follow_topics(self) -> None:
        own = self.get_namespace().rstrip("/")
        for full, types in self.get_topic_names_and_types():
            name = full.removeprefix(f"{own}/").lstrip("/")
            if name in self._types or name in _OWN or not self.count_publishers(full):
                continue
            self._types[name], self._full[name] = types[0], full
            if not self._is_wanted(types[0]):
                continue
            try:
                kind = message_class(types[0])
            except MessageTypeError:
                continue  # the topic is known by its name and type
            qos = _LATCHED if name.endswith("tf_static") else _FLEETING
            self.create_subscription(kind, full, partial(self._on_message, name), qos, raw=True)

    def _on_message(self, name: str, data: bytes) -> None:
        arrival_ns = int(self.get_clock().now().nanoseconds)
        keep(self._messages.setdefault(name, []), self._types[name], Message(arrival_ns, data))


def listen(
    swarm: Swarm,
    seconds: float,
    progress: Progress,
    namespace: str = "",
    is_wanted: Wanted = is_looked_at,
    *,
    use_sim_time: bool,
) -> Evidence:
    """What is heard of a swarm in some seconds, or until SIGINT."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Listener(swarm, namespace, is_wanted, use_sim_time=use_sim_time)
    try:
        return node.listen(seconds, progress)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
