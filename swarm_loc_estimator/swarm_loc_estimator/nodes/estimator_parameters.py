"""ROS parameters of `estimator_node`. No ROS here."""

from __future__ import annotations

from dataclasses import dataclass, field

from swarm_loc_estimator.common.parameters import flag, number, text
from swarm_loc_estimator.timeline.settings import Settings


@dataclass(frozen=True)
class EstimatorParameters:
    """Parameters of `estimator_node`; those of the estimator itself are its settings."""

    swarm_file: str = text("", "path of the swarm description", required=True)
    tick_period_s: float = number(
        0.05, "s", 0.005, 1.0, "period of the node's clock in which data is used and poses are published"
    )
    fusion_load: float = number(
        0.1, "1", 0.01, 1.0, "share of a core that fusing may take; a large swarm fuses at fewer ticks then"
    )
    map_frame: str = text("map", "frame that all poses are in", required=True)
    odom_frame: str = text(
        "odom", "transforms go from map_frame to <robot>/odom_frame, the frame of its odometry", required=True
    )
    publish_tf: bool = flag(True, "publish these transforms")
    publish_robot_poses: bool = flag(True, "publish <robot>/pose beside swarm/poses, unless shared_topics")
    shared_topics: bool = flag(
        False,
        "listen to swarm/odom, swarm/detections and swarm/fixes in place of topics of each robot",
    )
    settings: Settings = field(default_factory=Settings, metadata={"numbers_of": Settings})
