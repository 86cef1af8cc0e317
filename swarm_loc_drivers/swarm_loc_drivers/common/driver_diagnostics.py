"""Diagnostics of a driver: counts and rates once a second, changes of the link in the log."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from swarm_loc_drivers.common.robot_driver import RobotDriver
from swarm_loc_estimator.common.health import PATIENCE_S, Level, Report
from swarm_loc_estimator.common.node import ConfiguredNode


class DriverDiagnostics:
    """Publishes counts and rates of a driver.

    Args:
        node: Node of the driver.
        driver: The driver.
        name: Name of the status.
        address: Where the robot answers.
        rates: Counts whose rates are published, too.
        wrong: Counts of errors, which the log warns of, and what they mean.
    """

    def __init__(
        self,
        node: ConfiguredNode[Any],
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
        self._reported_s = time.monotonic()
        self._was_in_trouble = bool(driver.trouble)
        node.start_diagnostics(self._report)

    def _report(self) -> None:
        trouble, counts = self._driver.trouble, Counter(self._driver.counts)
        self._log(trouble, counts)
        now_s = time.monotonic()
        elapsed_s, self._reported_s = now_s - self._reported_s, now_s
        values: dict[str, object] = dict(sorted(counts.items()))
        for name in self._rates:
            values[f"{name} rate [1/s]"] = f"{(counts[name] - self._reported[name]) / elapsed_s:.4g}"
        self._reported = counts
        level = Level.ERROR if trouble else Level.OK
        self._node.publish_reports(Report(self._name, trouble or "connected", level, values, self._address))

    def _log(self, trouble: str, counts: Counter[str]) -> None:
        """Log what has changed."""
        # a robot that is being switched on, or a simulation that starts, does not answer at once
        patience_s = 0.0 if counts["connections"] else PATIENCE_S
        self._node.health.warn_of("link", {trouble: trouble} if trouble else {}, patience_s)
        if self._was_in_trouble and not trouble:
            self._node.get_logger().info(f"connected to {self._address}")
        self._was_in_trouble = bool(trouble)
        wrong = {f"{name}: {meaning}": counts[name] for name, meaning in self._wrong.items()}
        self._node.health.warn_of_drops(wrong, "errors")
