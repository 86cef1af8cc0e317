"""A /clock before zero is dropped, and the node goes on."""

import pytest
from builtin_interfaces.msg import Time
from node_world import Ros, overrides
from rclpy.node import Node
from rclpy.time_source import TimeSource
from rosgraph_msgs.msg import Clock

from swarm_loc_estimator.common.node import drop_negative_clocks


def test_a_clock_before_zero_ends_nothing(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TimeSource, "clock_callback", TimeSource.clock_callback)  # put back afterwards
    drop_negative_clocks()
    node = ros.add(Node("simulated", parameter_overrides=overrides(use_sim_time=True)))
    (subscription,) = [one for one in node.subscriptions if one.topic_name == "/clock"]
    for sec, shown in ((7, 7), (-5, 7), (8, 8)):
        subscription.callback(Clock(clock=Time(sec=sec)))
        assert node.get_clock().now().nanoseconds == shown * 1_000_000_000
