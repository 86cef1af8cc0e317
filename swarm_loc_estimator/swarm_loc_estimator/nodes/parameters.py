"""ROS parameters of the nodes of this package. No ROS here."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from swarm_loc_estimator.common.parameters import ParameterError, autostart, flag, number, text, texts
from swarm_loc_estimator.mapping.settings import MapperSettings
from swarm_loc_estimator.timeline.settings import Settings


@dataclass(frozen=True)
class EstimatorParameters:
    """Parameters of `estimator_node`; those of the estimator itself are its settings."""

    autostart: bool = autostart()
    swarm_file: str = text("", "path of the swarm description", required=True)
    tick_period_s: float = number(0.05, "s", 0.005, 1.0, "period in which data is used and poses published")
    fusion_load: float = number(0.1, "1", 0.01, 1.0, "share of a core for fusing: big swarms fuse less often")
    map_frame: str = text("map", "frame that all poses are in", required=True)
    odom_frame: str = text("odom", "frame of odometry: transforms go to <robot>/odom_frame", required=True)
    publish_tf: bool = flag(True, "publish these transforms")
    tf_per_robot: bool = flag(False, "publish them on <robot>/tf, to odom_frame without <robot>/, for Nav2")
    transform_tolerance_s: float = number(0.0, "s", 0.0, 10.0, "post-dating of transforms, as by AMCL")
    publish_robot_poses: bool = flag(True, "publish <robot>/pose, too, unless shared_topics")
    shared_topics: bool = flag(False, "listen to swarm/odom, swarm/detections and swarm/fixes, not per robot")
    settings: Settings = field(default_factory=Settings, metadata={"numbers_of": Settings})

    def odom_frame_of(self, robot: str) -> str:
        """Frame of a robot's odometry."""
        return self.odom_frame if self.tf_per_robot else f"{robot}/{self.odom_frame}"


@dataclass(frozen=True)
class MapperParameters:
    """Parameters of `mapper_node`; those of the mapper itself are its settings."""

    swarm_file: str = text("", "path of the swarm description", required=True)
    robots: tuple[str, ...] = texts("robots that map; empty: all of the description")
    led_frequencies: tuple[str, ...] = texts("of LEDs, such as pushbot1=1000 [Hz]; empty: no lights are used")
    map_frame: str = text("map", "frame of the map, the fixes and the goals", required=True)
    map_period_s: float = number(2.0, "s", 0.1, 60.0, "period in which a changed map is published")
    load_map: str = text("", "path of the YAML of an earlier map, the background of the new one; empty: none")
    save_map: str = text("map.yaml", "path of the files that ~/save_map writes", required=True)
    settings: MapperSettings = field(default_factory=MapperSettings, metadata={"numbers_of": MapperSettings})


def chosen_robots(wanted: Collection[str], known: Collection[str]) -> list[str]:
    """The wanted ones of known robots, in their order; all if none is wanted. Raises ParameterError."""
    for name in wanted:
        if name not in known:
            raise ParameterError(f"parameter robots: there is no robot '{name}' in the swarm description.")
    return [name for name in known if not wanted or name in wanted]


@dataclass(frozen=True)
class PlayerParameters:
    """Parameters of `play`."""

    bag: str = text("", "a rosbag2 folder, or an .mcap or .db3 file", required=True)
    rate: float = number(1.0, "1", 0.01, 1000.0, "bag seconds per second")
    loop: bool = flag(False, "play again from the beginning at the end, without limit")
    start_offset_s: float = number(0.0, "s", 0.0, 1e9, "offset in the bag at which playing begins")
    topics: tuple[str, ...] = texts("topics to play; all when empty")
    wait_for_subscribers: int = number(0, "1", 0, 100000, "topics but /clock that need a subscriber first")
    clock: bool = flag(True, "publish /clock")


@dataclass(frozen=True)
class WatchParameters:
    """Parameters of `watch_node`."""

    swarm_file: str = text("", "path of the swarm description", required=True)
    title: str = text("", "heading of the page; empty: the name of the swarm description's folder")
    address: str = text("127.0.0.1", "what to listen on; others than loopback need a token", required=True)
    port: int = number(8420, "1", 0, 65535, "where to listen; 0: any port that is free")
    token: str = text("", "token of browsers, as ?token=, 8 characters or more, 5 different; empty: none")
    rate: float = number(20.0, "Hz", 0.5, 60.0, "how often a page gets new poses, at most")
    commands: bool = flag(True, "whether pages may reset the estimator and set poses, after a question")
    teleop: bool = flag(False, "whether pages may drive robots by <robot>/cmd_vel, too")
    teleop_speed: float = number(0.05, "m/s", 0.001, 10.0, "speed ahead while a key is held")
    teleop_turn_rate: float = number(0.8, "rad/s", 0.01, 20.0, "turn rate while a key is held")
    estimator: str = text("estimator", "name of the estimator's node, which obeys commands", required=True)


@dataclass(frozen=True)
class MarkersParameters:
    """Parameters of `markers_node`."""

    swarm_file: str = text("", "path of the swarm description", required=True)
    rate: float = number(10.0, "Hz", 0.1, 100.0, "how often markers are published, at most")
