"""ROS parameters of `watch_node`. No ROS here."""

from __future__ import annotations

from dataclasses import dataclass

from swarm_loc_estimator.common.parameters import flag, number, text


@dataclass(frozen=True)
class WatchParameters:
    """Parameters of `watch_node`."""

    swarm_file: str = text("", "path of the swarm description", required=True)
    title: str = text("", "heading of the page; empty: the name of the swarm description's folder")
    address: str = text(
        "127.0.0.1", "what to listen on; any but a loopback address needs a token", required=True
    )
    port: int = number(8420, "1", 0, 65535, "where to listen; 0: any port that is free")
    token: str = text("", "what browsers must give as ?token=; empty: nothing")
    rate: float = number(20.0, "Hz", 0.5, 60.0, "how often a page gets new poses, at most")
    commands: bool = flag(
        True, "whether pages may reset the estimator and set poses, each time after a question"
    )
    teleop: bool = flag(False, "whether pages may drive robots by <robot>/cmd_vel, too")
    teleop_speed: float = number(0.05, "m/s", 0.001, 10.0, "speed ahead while a key is held")
    teleop_turn_rate: float = number(0.8, "rad/s", 0.01, 20.0, "turn rate while a key is held")
    estimator: str = text(
        "estimator", "name of the estimator's node, whose services obey commands", required=True
    )
