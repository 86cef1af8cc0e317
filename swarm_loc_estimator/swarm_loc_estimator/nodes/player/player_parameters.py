"""ROS parameters of `play`. No ROS here."""

from __future__ import annotations

from dataclasses import dataclass

from swarm_loc_estimator.common.parameters import flag, number, text, texts


@dataclass(frozen=True)
class PlayerParameters:
    """Parameters of `play`."""

    bag: str = text("", "a rosbag2 folder, or an .mcap or .db3 file", required=True)
    rate: float = number(1.0, "1", 0.01, 1000.0, "bag seconds per second")
    loop: bool = flag(False, "begin anew at the end, for ever")
    start_offset_s: float = number(0.0, "s", 0.0, 1e9, "how much of the bag's beginning to leave out")
    topics: tuple[str, ...] = texts("topics to play; all when empty")
    wait_for_subscribers: int = number(
        0, "1", 0, 100000, "begin when at least so many topics, and /clock, have a subscriber; 0: at once"
    )
    clock: bool = flag(True, "publish /clock")
