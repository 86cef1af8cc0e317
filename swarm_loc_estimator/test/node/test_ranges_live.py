"""UWB ranges over DDS: the estimator takes them, corrects a pose with them, and names what it drops."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from node_world import SECOND, T0_NS, Ros, newest_status, odometry_bytes, overrides, stamp_ns, values_of
from rclpy.exceptions import InvalidTopicNameException
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Range as PairRange
from std_msgs.msg import Header

from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_msgs.msg import Range, RangeArray, SwarmPose, SwarmPoses

ANCHORS = {16: (-3.0, -3.0), 17: (3.0, -3.0), 18: (0.0, 3.0)}
SWARM_YAML = """
fileversion: 1
robots:
  alpha:
    camera: null
    uwb: {address: 1, range_sigma: 0.02}
    start: {x: 0.1, y: -0.1, theta: 0.0}
    start_sigma: {x: 0.2, y: 0.2}
anchors:
""" + "".join(
    f"  - {{address: {a}, x: {x}, y: {y}, z: 1.0, range_bias_sigma: 0.0}}\n" for a, (x, y) in ANCHORS.items()
)


def is_estimated(poses: list[SwarmPoses], before: int, now_ns: int) -> bool:
    """Whether an estimate at an instant has come after some."""
    return any(stamp_ns(one) == now_ns for one in poses[before:])


@pytest.mark.parametrize(
    "topics",
    [
        {"odom": "alpha/odom", "ranges": "alpha/ranges"},
        {"odom": "lab/alpha/odometry/filtered", "ranges": "radios/first"},
    ],
)
def test_ranges_correct_a_start(ros: Ros, tmp_path: Path, topics: dict[str, str]) -> None:
    """Topics have the expected names, or those of the description."""
    path = tmp_path / "swarm.yaml"
    of_others = "topics: {<robot>/odom: lab/<robot>/odometry/filtered, alpha/ranges: /radios/first}"
    named = "" if topics["ranges"] == "alpha/ranges" else of_others
    path.write_text(f"{SWARM_YAML}{named}\n", encoding="utf-8")
    ros.add(EstimatorNode(parameter_overrides=overrides(swarm_file=str(path), use_sim_time=True)))
    clock = ros.tester.create_publisher(Clock, "/clock", 10)
    odometry = ros.tester.create_publisher(Odometry, topics["odom"], 100)
    ranges = ros.tester.create_publisher(RangeArray, topics["ranges"], 100)
    poses = ros.listen(SwarmPoses, "swarm/poses")
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    ros.until(lambda: all(one.get_subscription_count() for one in (clock, odometry, ranges)))
    ros.until(lambda: ros.tester.count_publishers("swarm/poses"))
    measured = [Range(device=a, range=float(np.hypot(np.hypot(x, y), 1.0))) for a, (x, y) in ANCHORS.items()]
    for step in range(8):
        now_ns, before = T0_NS + step * SECOND // 2, len(poses)
        clock.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))
        odometry.publish(odometry_bytes("alpha", now_ns))
        header = Header(stamp=Time(nanoseconds=now_ns).to_msg())
        ranges.publish(RangeArray(header=header, ranges=[*measured, Range(device=99, range=1.0)]))
        ros.until(partial(is_estimated, poses, before, now_ns))
    ros.until(lambda: bool(heard) and stamp_ns(heard[-1]) >= now_ns)

    (alpha,) = poses[-1].robots
    assert alpha.status == SwarmPose.STATUS_TRACKED
    assert (alpha.x, alpha.y) == pytest.approx((0.0, 0.0), abs=0.02)
    assert values_of(newest_status(heard, "estimator: alpha"))["ranges received"] == "8"
    assert values_of(newest_status(heard, "estimator"))["dropped: uwb_unknown_address"] == "8"


def test_ranges_on_topics_of_pairs_correct_a_start(ros: Ros, tmp_path: Path) -> None:
    """The topics have names of radios, in both orders, as the drivers of tags and of anchors publish them."""
    path = tmp_path / "swarm.yaml"
    named = SWARM_YAML.replace("{address: 1,", "{address: 1, name: tag,").replace(
        "address: 16,", "address: 16, name: west,"
    )
    path.write_text(f"{named}range_topic: /uwb/n_{{from}}/n_{{to}}/distance\n", encoding="utf-8")
    ros.add(EstimatorNode(parameter_overrides=overrides(swarm_file=str(path), use_sim_time=True)))
    clock = ros.tester.create_publisher(Clock, "/clock", 10)
    odometry = ros.tester.create_publisher(Odometry, "alpha/odom", 100)
    names = {16: "uwb/n_tag/n_west/distance", 17: "uwb/n_17/n_tag/distance", 18: "uwb/n_tag/n_18/distance"}
    ranges = {a: ros.tester.create_publisher(PairRange, name, 10) for a, name in names.items()}
    poses = ros.listen(SwarmPoses, "swarm/poses")
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    ros.until(lambda: all(one.get_subscription_count() for one in (clock, odometry, *ranges.values())))
    ros.until(lambda: ros.tester.count_publishers("swarm/poses"))
    for step in range(8):
        now_ns, before = T0_NS + step * SECOND // 2, len(poses)
        clock.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))
        odometry.publish(odometry_bytes("alpha", now_ns))
        header = Header(stamp=Time(nanoseconds=now_ns).to_msg())
        for a, (x, y) in ANCHORS.items():
            ranges[a].publish(PairRange(header=header, range=float(np.hypot(np.hypot(x, y), 1.0))))
        ros.until(partial(is_estimated, poses, before, now_ns))
    ros.until(lambda: bool(heard) and stamp_ns(heard[-1]) >= now_ns)

    (alpha,) = poses[-1].robots
    assert alpha.status == SwarmPose.STATUS_TRACKED
    assert (alpha.x, alpha.y) == pytest.approx((0.0, 0.0), abs=0.02)
    assert values_of(newest_status(heard, "estimator: alpha"))["measurements used"] == "24"


@pytest.mark.usefixtures("ros")
def test_a_topic_that_ros_refuses_is_a_mistake_of_the_user(tmp_path: Path) -> None:
    """Tokens of topics must not begin with a digit."""
    path = tmp_path / "swarm.yaml"
    path.write_text(f"{SWARM_YAML}range_topic: /uwb/{{from}}/{{to}}/distance\n", encoding="utf-8")
    with pytest.raises(InvalidTopicNameException, match="must not start with a number"):
        EstimatorNode(parameter_overrides=overrides(swarm_file=str(path), use_sim_time=True))
