"""Diagnostics of a driver: counts and rates once a second, changes of the link in the log."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile

from swarm_loc_drivers.common.robot_driver import RobotDriver

_PERIOD_S = 1.0
_THROTTLE_S, _WRONG_THROTTLE_S = 10.0, 60.0
_PATIENCE_S = 5.0
"""A robot that is being switched on, or a simulation that starts, does not answer at once."""


class DriverDiagnostics:
    """Publishes counts and rates of a driver.

    Args:
        node: Of the driver.
        driver: Whom to tell about.
        name: Of the status.
        address: Where the robot answers.
        rates: Counts of which the rate is told besides.
        wrong: Counts of which the log tells, and what they mean.
    """

    def __init__(
        self,
        node: Node,
        driver: RobotDriver[Any],
        name: str,
        address: str,
        rates: Sequence[str],
        wrong: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._node, self._driver = node, driver
        self._name, self._address, self._rates = name, address, tuple(rates)
        self._wrong = wrong
        self._reported: Counter[str] = Counter()
        self._began_s = self._reported_s = time.monotonic()
        self._told_trouble = driver.trouble
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # runs also while simulated time stands still
        node.create_timer(_PERIOD_S, self._report, clock=steady)

    def _report(self) -> None:
        trouble, counts = self._driver.trouble, Counter(self._driver.counts)
        self._log(trouble)
        self._warn(counts)
        now_s = time.monotonic()
        elapsed_s, self._reported_s = now_s - self._reported_s, now_s
        values = {name: str(count) for name, count in sorted(counts.items())}
        for name in self._rates:
            values[f"{name} rate [1/s]"] = f"{(counts[name] - self._reported[name]) / elapsed_s:.4g}"
        self._reported = counts
        status = DiagnosticStatus(
            level=DiagnosticStatus.ERROR if trouble else DiagnosticStatus.OK,
            name=self._name,
            message=trouble or "connected",
            hardware_id=self._address,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _log(self, trouble: str) -> None:
        """Say what has changed."""
        waited = time.monotonic() > self._began_s + _PATIENCE_S
        is_starting = not self._driver.counts["connections"] and not waited
        if trouble == self._told_trouble or is_starting:
            return
        self._told_trouble = trouble
        if trouble:
            self._node.get_logger().warning(trouble, throttle_duration_sec=_THROTTLE_S)
        else:
            self._node.get_logger().info(f"connected to {self._address}")

    def _warn(self, counts: Counter[str]) -> None:
        """Say what went wrong since the last report, once in a while."""
        news = [name for name in self._wrong if counts[name] > self._reported[name]]
        if news:
            words = "; ".join(f"{counts[name]} {name}: {self._wrong[name]}" for name in news)
            self._node.get_logger().warning(f"so far {words}", throttle_duration_sec=_WRONG_THROTTLE_S)
