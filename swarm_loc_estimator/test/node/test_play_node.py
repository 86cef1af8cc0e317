"""The player: what it publishes, and with which quality of service."""

import signal
from pathlib import Path

import pytest
from nav_msgs.msg import Odometry
from node_world import SECOND, STEP_NS, T0_NS, Program, Ros, detection_bytes, odometry_bytes, sight
from rclpy.duration import Duration, Infinite
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rosbags.interfaces import QosDurability, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosgraph_msgs.msg import Clock

from swarm_loc_estimator.common.bags.writer import RELIABLE, BagWriter, typestore
from swarm_loc_estimator.common.messages.cdr import DETECTIONS, ODOMETRY
from swarm_loc_msgs.msg import MarkerDetectionArray

COUNT = 200
LATE_NS = 3_000_000


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Ten seconds of alpha's odometry and sightings, and of beta's odometry."""
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        for name, message_type in (
            ("alpha/odom", ODOMETRY),
            ("beta/odom", ODOMETRY),
            ("alpha/detections", DETECTIONS),
        ):
            writer.add_topic(name, message_type)
        for step in range(COUNT):
            stamp_ns = T0_NS + step * STEP_NS
            for name in ("alpha", "beta"):
                writer.write(f"{name}/odom", stamp_ns + LATE_NS, odometry_bytes(name, stamp_ns))
            data = detection_bytes("alpha", stamp_ns, sight((0.0, 0.0, 0.0)))
            writer.write("alpha/detections", stamp_ns + LATE_NS, data)
    return path


class Listener:
    """Keeps what comes on a topic, as bytes."""

    def __init__(self, ros: Ros, message_class: type, topic: str) -> None:
        self.heard: list[bytes] = []
        ros.tester.create_subscription(
            message_class, topic, self.heard.append, QoSProfile(depth=2 * COUNT), raw=True
        )


def _player(bag: Path | str, tmp_path: Path, *arguments: str, **parameters: object) -> Program:
    return Program("play", tmp_path / "log", {"bag": bag, **parameters}, arguments)


def _clock(ros: Ros) -> list[int]:
    times: list[int] = []
    ros.tester.create_subscription(
        Clock, "/clock", lambda message: times.append(int(Time.from_msg(message.clock).nanoseconds)), 10_000
    )
    return times


def test_every_message_arrives_unchanged_and_never_before_its_time(
    ros: Ros, bag: Path, tmp_path: Path
) -> None:
    odometry = Listener(ros, Odometry, "alpha/odom")
    detections = Listener(ros, MarkerDetectionArray, "alpha/detections")
    times = _clock(ros)
    with _player(bag, tmp_path, rate=20, wait_for_subscribers=2) as player:
        ros.until(lambda: player.process.poll() is not None)
        assert player.end() == 0
        summary = player.output.splitlines()[-1]
    stamps = [T0_NS + step * STEP_NS for step in range(COUNT)]
    ros.until(lambda: len(odometry.heard) >= COUNT and len(detections.heard) >= COUNT)
    ros.until(lambda: times and times[-1] >= stamps[-1] + LATE_NS)

    assert odometry.heard == [odometry_bytes("alpha", stamp) for stamp in stamps]
    assert detections.heard == [detection_bytes("alpha", stamp, sight((0.0, 0.0, 0.0))) for stamp in stamps]
    assert summary.startswith(f"played {3 * COUNT} messages of {(COUNT - 1) * STEP_NS / SECOND:.1f} s in ")
    assert times == sorted(times)
    assert times[0] == T0_NS + LATE_NS


def test_a_part_of_a_bag_under_other_names(ros: Ros, bag: Path, tmp_path: Path) -> None:
    renamed, left_out = Listener(ros, Odometry, "gamma/odom"), Listener(ros, Odometry, "beta/odom")
    arguments = ("-r", "alpha/odom:=gamma/odom")
    chosen = {"topics": "['/alpha/odom']", "start_offset_s": 5, "clock": "false"}
    with _player(bag, tmp_path, *arguments, rate=20, wait_for_subscribers=1, **chosen) as player:
        ros.until(lambda: player.process.poll() is not None)
        assert player.end() == 0
    ros.until(lambda: len(renamed.heard) >= COUNT // 2)

    assert renamed.heard == [odometry_bytes("alpha", T0_NS + k * STEP_NS) for k in range(COUNT // 2, COUNT)]
    assert not left_out.heard


def test_a_loop_begins_anew_until_a_signal(ros: Ros, bag: Path, tmp_path: Path) -> None:
    times = _clock(ros)
    Listener(ros, Odometry, "alpha/odom")
    with _player(bag, tmp_path, rate=50, wait_for_subscribers=1, loop="true") as player:
        ros.until(lambda: times.count(T0_NS + LATE_NS) >= 3)
        assert player.end(signal.SIGINT) == 0
        assert "Traceback" not in player.output
        assert "played" in player.output


def test_a_loop_over_nothing_ends(ros: Ros, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("alpha/odom", ODOMETRY)
    with _player(tmp_path / "bag", tmp_path, loop="true") as player:
        ros.until(lambda: player.process.poll() is not None)
        assert player.end() == 0
        assert "played 0 messages" in player.output


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"bag": "/nowhere"}, "There is no bag '/nowhere'."),
        ({"topics": "[gamma/odom]"}, "parameter topics names 'gamma/odom', but"),
        (
            {"start_offset_s": 10.5},
            "parameter start_offset_s = 10.5 must lie within the bag, which lasts 9.95 s.",
        ),
    ],
)
def test_a_wrong_parameter_ends_the_player_with_one_sentence(
    bag: Path, tmp_path: Path, parameters: dict[str, object], sentence: str
) -> None:
    with _player(**{"bag": bag, "tmp_path": tmp_path, **parameters}) as player:  # type: ignore[arg-type]
        assert player.end() == 1
        (line,) = player.output.splitlines()
    assert line.startswith("play: ")
    assert sentence in line


def test_a_player_that_is_stopped_does_not_wait_for_one_who_does_not_listen(
    ros: Ros, bag: Path, tmp_path: Path, swarm_file: Path
) -> None:
    odometry, times = Listener(ros, Odometry, "alpha/odom"), _clock(ros)
    with Program("estimator_node", tmp_path / "estimator", {"swarm_file": swarm_file}) as estimator:
        estimator.wait_for("ready")
        with _player(bag, tmp_path, rate=20, loop="true", wait_for_subscribers=3) as player:
            ros.until(lambda: len(odometry.heard) > COUNT)
            estimator.process.send_signal(signal.SIGSTOP)
            heard = len(odometry.heard)
            ros.until(lambda: len(odometry.heard) > heard + COUNT)
            took_s = player.seconds_to_end(signal.SIGINT)
            assert player.end() == 0
    assert times
    assert took_s < 2.0


BEST_EFFORT = RELIABLE._replace(reliability=QosReliability.BEST_EFFORT, deadline=QosTime(0, 500_000_000))
LATCHED = RELIABLE._replace(durability=QosDurability.TRANSIENT_LOCAL, depth=1)
VAGUE = RELIABLE._replace(reliability=QosReliability.SYSTEM_DEFAULT, durability=QosDurability.BEST_AVAILABLE)
TOPICS = {
    "best_effort": [BEST_EFFORT, BEST_EFFORT],
    "latched": [LATCHED],
    "vague": [VAGUE],
    "different": [RELIABLE, BEST_EFFORT],
    "unknown": [],
    "tf_static": [],
}


def _bag(path: Path) -> Path:
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for name, profiles in TOPICS.items():
            topic = writer.add_connection(
                f"/{name}", ODOMETRY, typestore=typestore(), offered_qos_profiles=profiles
            )
            writer.write(topic, T0_NS, odometry_bytes(name, T0_NS))
    return path


def test_topics_offer_what_was_recorded_and_else_what_all_can_hear(ros: Ros, tmp_path: Path) -> None:
    parameters = {"bag": _bag(tmp_path / "bag"), "wait_for_subscribers": len(TOPICS)}
    with Program("play", tmp_path / "log", parameters):
        ros.until(lambda: all(ros.tester.count_publishers(name) for name in TOPICS))
        offered: dict[str, QoSProfile] = {
            name: ros.tester.get_publishers_info_by_topic(name)[0].qos_profile for name in TOPICS
        }

    unreliable = [name for name, qos in offered.items() if qos.reliability == ReliabilityPolicy.BEST_EFFORT]
    latched = [name for name, qos in offered.items() if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL]
    assert unreliable == ["best_effort"]
    assert latched == ["latched", "tf_static"]
    assert offered["best_effort"].deadline == Duration(nanoseconds=500_000_000)
    assert offered["latched"].deadline == offered["unknown"].deadline == Infinite
