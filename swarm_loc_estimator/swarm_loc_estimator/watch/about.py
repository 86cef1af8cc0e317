"""What a page is told of a swarm before any frame: names, landmarks, who carries what."""

from __future__ import annotations

from typing import Any

from swarm_loc_estimator.swarm.swarm import Swarm

_BODY_PER_WHEELS = 0.66
"""Radius of a robot's body by the distance of its wheels, as of an e-puck."""


def about(swarm: Swarm, title: str, *, teleop: bool = False, commands: bool = True) -> dict[str, Any]:
    """The swarm for the page.

    Args:
        swarm: Its description.
        title: Heading of the page.
        teleop: Whether robots may be driven.
        commands: Whether poses may be set and the estimator reset.
    """
    landmarks = [[mark.id, mark.x, mark.y, mark.yaw] for mark in swarm.landmarks]
    return {
        "kind": "about",
        "title": title,
        "names": [robot.name for robot in swarm.robots],
        "radius": [round(_BODY_PER_WHEELS * one.odometry.wheel_separation, 4) for one in swarm.robots],
        "infrared": [int(robot.ir is not None and robot.camera is None) for robot in swarm.robots],
        "landmarks": landmarks,
        "teleop": teleop,
        "commands": commands,
    }
