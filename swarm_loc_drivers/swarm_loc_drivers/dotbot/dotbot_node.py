"""DotBots through the REST interface of PyDotBot's controller: poses as fixes, and velocities as commands.

    ./run swarm_loc_drivers dotbot_node --ros-args -p swarm_file:=swarm.yaml -p url:=http://localhost:8000

PyDotBot's frame has x to the right and y down in mm, and headings of 0 along y, clockwise; `map` has its
origin and y up.
"""

from __future__ import annotations

import json
import math
import urllib.request
from dataclasses import dataclass
from functools import partial
from http.client import HTTPException
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from rclpy.qos import QoSProfile

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.health import Report, drop_values, level_of, listed
from swarm_loc_estimator.common.messages.poses import HEADING_UNKNOWN, encode_fix
from swarm_loc_estimator.common.node import ConfiguredNode, run_node
from swarm_loc_estimator.common.parameters import ParameterError, number, text, texts
from swarm_loc_estimator.swarm.swarm_file import load_swarm

_TRACK_M = 0.081  # `TRACK_EFFECTIVE_MM` of dotbot/kinematics.py
_MAX_MM_S, _MAX_BYTES = 700, 1 << 20  # Maximum speed of a wheel [mm/s], and size of an answer
_QOS = QoSProfile(depth=10)


@dataclass(frozen=True)
class DotbotParameters:
    """Parameters of `dotbot_node`."""

    swarm_file: str = text("", "path of the swarm description", required=True)
    url: str = text("http://localhost:8000", "PyDotBot's controller")
    bodies: tuple[str, ...] = texts(
        "addresses of robots, such as BADCAFE111111111=dotbot1; empty: in the order of both"
    )
    rate: float = number(10.0, "1/s", 0.1, 100.0, "how often poses are asked for")
    timeout: float = number(0.5, "s", 0.01, 10.0, "for an answer")


def pose_of(dotbot: Any) -> tuple[FloatArray, bool] | None:
    """The pose (3,) in `map` of a robot as PyDotBot describes it, and whether its heading is known.

    None if it has no pose yet; an error of Python if the answer is none of PyDotBot's or not finite.
    """
    about = dotbot.get("pose") or dotbot.get("lh2_position")
    if about is None:
        return None
    known = about.get("heading_source", "none") != "none"
    yaw = -0.5 * math.pi - math.radians(about["heading_deg"]) if known else 0.0
    pose = np.array([1e-3 * about["x"], -1e-3 * about["y"], math.remainder(yaw, 2.0 * math.pi)])
    if not np.isfinite(pose).all():
        raise ValueError
    return pose, known


class DotbotNode(ConfiguredNode[DotbotParameters]):
    """Asks for poses and hands velocities on."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("dotbot", DotbotParameters, **node_arguments)
        robots = load_swarm(Path(self.params.swarm_file)).robots
        if not self.params.url.startswith(("http://", "https://")):
            raise ParameterError(f"parameter url = '{self.params.url}' must begin with http:// or https://.")
        self._names = [robot.name for robot in robots]
        self._models = {robot.name: robot.fix for robot in robots}
        self._address = {name: body for body, _, name in (one.partition("=") for one in self.params.bodies)}
        if unknown := self._address.keys() - {*self._names}:
            raise ParameterError(
                f"parameter bodies names {listed(sorted(unknown))}, but the robots are {listed(self._names)}."
            )
        self._seen: dict[str, object] = {}
        self._trouble = ""  # Why the last question had no answer
        self._wanted: dict[str, Twist] = {}
        kind = PoseWithCovarianceStamped
        self._fixes = {name: self.create_publisher(kind, f"{name}/fix", _QOS) for name in self._names}
        for name in self._names:
            self.create_subscription(Twist, f"{name}/cmd_vel", partial(self._on_velocity, name), _QOS)
        self.create_timer(1.0 / self.params.rate, self._ask)
        self.start_diagnostics(self._on_diagnostics)

    def _ask(self) -> None:
        """Publish what has changed since the last answer."""
        answer = self._request("GET", "dotbots")
        known_ones = (one for one in answer if isinstance(one, dict)) if isinstance(answer, list) else ()
        dotbots = {str(one.get("address")): one for one in known_ones}
        if not self.params.bodies:  # in order; a robot keeps its address while others come and go
            free = sorted(dotbots.keys() - {*self._address.values()})
            nameless = (name for name in self._names if name not in self._address)
            self._address |= dict(zip(nameless, free, strict=False))
        for name, address in self._address.items():
            about = dotbots.get(address, {})
            try:
                found = pose_of(about)
            except (AttributeError, KeyError, TypeError, ValueError):
                self.health.drop("bad_answer", f"{address} has no pose of finite numbers")
                continue
            if found is None or self._seen.get(name) == about.get("last_seen"):
                continue
            self._seen[name] = about.get("last_seen")
            self.health.received(name)
            model, (pose, known) = self._models[name], found
            heading = model.heading_sigma**2 if known else 2.0 * HEADING_UNKNOWN
            covariance = np.diag([model.position_sigma**2, model.position_sigma**2, heading])
            stamp_ns = self.get_clock().now().nanoseconds
            self._fixes[name].publish(encode_fix("map", stamp_ns, pose, covariance))
        while self._wanted:
            self._drive(*self._wanted.popitem())

    def _drive(self, name: str, wanted: Twist) -> None:
        """Command the newest velocity; wheels stop half a second after the last command."""
        if name in self._address:
            turn = 0.5 * _TRACK_M * wanted.angular.z
            speeds = (wanted.linear.x - turn, wanted.linear.x + turn)
            left, right = (round(max(-_MAX_MM_S, min(_MAX_MM_S, 1e3 * one))) for one in speeds)
            body = {"left_mm_s": left, "right_mm_s": right}
            self._request("PUT", f"dotbots/{self._address[name]}/0/wheel_velocity", body)

    def _on_velocity(self, name: str, message: Twist) -> None:
        if math.isfinite(message.linear.x) and math.isfinite(message.angular.z):
            self._wanted[name] = message
        else:
            self.health.drop("bad_cmd_vel", f"of {name}")

    def _request(self, method: str, path: str, body: object = None) -> Any:
        """The decoded answer; None without one."""
        data = None if body is None else json.dumps(body).encode()
        url = f"{self.params.url}/controller/{path}"
        request = urllib.request.Request(url, data, {"Content-Type": "application/json"}, method=method)  # noqa: S310
        self._trouble = ""
        try:
            with urllib.request.urlopen(request, timeout=self.params.timeout) as answer:  # noqa: S310
                return json.loads(answer.read(_MAX_BYTES) or b"null")
        except (OSError, ValueError, RecursionError, HTTPException) as error:
            self._trouble = f"no answer of {url}: {error}"
            return None

    def _on_diagnostics(self) -> None:
        silent = [name for name in self._names if self.health.silence(name)]
        message = self._trouble or (f"no poses of {listed(silent)}" if silent else "")
        self.health.warn_of("trouble", {"": message} if message else {})
        self.health.warn_of_drops()
        values = drop_values(self.health.drops)
        self.publish_reports(Report(self.status_name, message or "asking", level_of(message), values))


main = partial(run_node, "dotbot_node", DotbotNode)
