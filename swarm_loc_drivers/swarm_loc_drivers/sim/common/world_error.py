"""Errors of swarms that cannot be simulated, whichever world it is."""

from __future__ import annotations

from swarm_loc_estimator.common.errors import UserError
from swarm_loc_estimator.swarm.swarm import Pose2, Robot


class WorldError(UserError):
    """A swarm that cannot be simulated; the message is one sentence."""


def start_of(robot: Robot) -> Pose2:
    """Where a robot begins.

    Raises:
        WorldError: Nobody says.
    """
    if robot.start is None:
        raise WorldError(
            f"robot '{robot.name}' has no start pose, and a simulated robot has to be somewhere."
        )
    return robot.start
