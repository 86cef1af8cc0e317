"""Passes poses of motion capture, AMCL and other localisers on as fixes or ground truth of robots.

    ./run swarm_loc_estimator localizer_bridge --ros-args -p swarm_file:=swarm.yaml -p source:=pose

It subscribes to topics of the localiser, and publishes `<robot>/fix` or `<robot>/ground_truth`, and
`/diagnostics`. Parameters that are not set are those of `localizer` in the description: see
`doc/motion_capture.md`.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy

from swarm_loc_estimator.common.health import PATIENCE_S, Report, drop_values, level_of, listed
from swarm_loc_estimator.common.node import ConfiguredNode, message_class, run_node
from swarm_loc_estimator.sensors.localizers import SOURCES, BridgeParameters, LocalizedRobots
from swarm_loc_estimator.swarm.swarm import BODY
from swarm_loc_estimator.swarm.swarm_file import load_swarm

_INPUT_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches publishers of both kinds; deeper than that of sensor data, since many nodes share /tf."""
_OUTPUT_QOS = QoSProfile(depth=10)


class LocalizerBridge(ConfiguredNode[BridgeParameters]):
    """Converts the messages of a localiser and publishes poses of robots."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("localizer_bridge", BridgeParameters, **node_arguments)
        swarm = load_swarm(Path(self.params.swarm_file))
        described = vars(swarm.localizer or BridgeParameters())
        usual = vars(BridgeParameters())
        unset = {name: value for name, value in described.items() if vars(self.params)[name] == usual[name]}
        parameters = self.params = replace(self.params, **{**unset, "swarm_file": self.params.swarm_file})
        self._source = SOURCES[parameters.source]
        self._robots = LocalizedRobots(parameters, list(swarm.index_of), self.health)
        self._used, self._dropped, self._trouble = 0, 0, ""
        kind: Any = PoseWithCovarianceStamped if parameters.output == "fix" else PoseStamped
        self._outputs = {
            robot: self.create_publisher(kind, f"{robot}/{parameters.output}", _OUTPUT_QOS)
            for robot in self._robots.robot_of.values()
        }
        received = message_class(self._source.message_type)
        for topic, body in self._robots.topics.items():
            self.create_subscription(received, topic, partial(self._on_message, topic, body), _INPUT_QOS)
        self.start_diagnostics(self._on_diagnostics)
        self.get_logger().info(f"ready: {len(self._outputs)} robots of '{parameters.swarm_file}'")

    def _on_message(self, topic: str, body: str, message: Any) -> None:
        self.health.received(topic)
        for robot, data in self._robots.serialized(message, body, self.get_clock().now().nanoseconds):
            self._outputs[robot].publish(data)

    def _on_diagnostics(self) -> None:
        robots, silence = self._robots, self.health.silence
        # whether every pose since the last report was dropped; without any pose, nothing changes
        used, dropped = robots.used, self.health.drops.total()
        if used > self._used:
            self._trouble = ""
        elif dropped > self._dropped:
            self._trouble = f"no pose can be used: {listed(sorted(self.health.drops))}"
        self._used, self._dropped = used, dropped
        # topics, and bodies on them, of which nothing was received yet or recently
        silent = [topic for topic in robots.topics if silence(topic)]
        missing = [f"{one}{self.why_missing(one, self._source.message_type)}" for one in silent]
        missing = missing or [label for label in robots.label_of.values() if silence(label)]
        if missing:
            self._note_topics_of_strangers()
        said = {name: f"body '{name}' is of no robot: name it in bodies" for name in robots.strangers}
        self.health.warn_of("missing", {one: f"no messages received on {one}" for one in missing}, PATIENCE_S)
        self.health.warn_of("strangers", said)
        self.health.warn_of_drops()
        message = f"no messages received on {listed(missing)}" if missing else ""
        message = "; ".join(filter(None, (message, *list(said.values())[:1])))
        values: dict[str, object] = {
            "poses": robots.used,
            "bodies of no robot": listed(sorted(robots.strangers)),
            **drop_values(self.health.drops),
        }
        message = message or self._trouble
        self.publish_reports(Report(self.status_name, message or "bridging", level_of(message), values))

    def _note_topics_of_strangers(self) -> None:
        """Note bodies with topics of their own that nobody describes."""
        name_of_body = self.resolve_topic_name(self._robots.topic.replace(BODY, "BODY"))
        before, own, after = name_of_body.partition("BODY")
        pattern = re.compile(f"{re.escape(before)}([^/]+){re.escape(after)}")
        for name, types in self.get_topic_names_and_types() if own else ():
            match = pattern.fullmatch(name)
            if match and match[1] not in self._robots.robot_of and self._source.message_type in types:
                self._robots.note_stranger(match[1])


main = partial(run_node, "localizer_bridge", LocalizerBridge)
