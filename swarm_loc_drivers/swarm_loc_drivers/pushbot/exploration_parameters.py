"""Parameters of `exploration_node`. No ROS here."""

from __future__ import annotations

from dataclasses import dataclass, field

from swarm_loc_drivers.pushbot.stop_and_go import StopAndGoSettings
from swarm_loc_estimator.common.parameters import ParameterError, flag, text, texts
from swarm_loc_estimator.swarm.swarm import Swarm


@dataclass(frozen=True)
class ExplorationParameters:
    """Parameters of `exploration_node`; how the robots move is in its settings."""

    swarm_file: str = text("", "path of the swarm description", required=True)
    robots: tuple[str, ...] = texts("those that are driven; empty: all of the description")
    wait_for_poses: bool = flag(False, "begin only when swarm/poses is announced, too")
    settings: StopAndGoSettings = field(
        default_factory=StopAndGoSettings, metadata={"numbers_of": StopAndGoSettings}
    )


def driven_robots(parameters: ExplorationParameters, swarm: Swarm) -> list[str]:
    """The names of the robots that are driven, in the order of the description.

    Raises:
        ParameterError: One of those wanted is not known.
    """
    known = [robot.name for robot in swarm.robots]
    for name in parameters.robots:
        if name not in known:
            raise ParameterError(f"parameter robots: there is no robot '{name}' in the swarm description.")
    return [name for name in known if not parameters.robots or name in parameters.robots]
