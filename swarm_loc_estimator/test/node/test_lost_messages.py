"""Messages that are lost, on links and in the estimator."""

import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import rclpy
from nav_msgs.msg import Odometry
from node_world import Ros, detection_bytes, odometry_bytes
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy

from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE
from swarm_loc_estimator.nodes.estimator_topics import EstimatorInputs
from swarm_loc_estimator.sensors.inputs import live_topics
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_msgs.msg import MarkerDetectionArray

TOPIC = "alpha/odom"
DEPTH, IMAGES = 1000, 60  # Most that wait of odometry and of images, with a horizon of two seconds


class Inputs:
    """The inputs of a node of their own, which is in no executor, and what they count as dropped."""

    def __init__(self, ros: Ros, node: Node, swarm_file: Path, horizon_s: float = 60.0) -> None:
        self._ros, self.node = ros, node
        self.drops: Counter[str] = Counter()
        topics = [one for one in live_topics(load_swarm(swarm_file), shared=False) if one.name == TOPIC]
        self._inputs = EstimatorInputs(node, topics, self._note, horizon_s)

    def _note(self, why: str, count: int) -> None:
        self.drops += Counter({why: count})

    def publisher(self) -> tuple[Node, Publisher]:
        """A publisher, and its node, as of another process."""
        stranger = self._ros.stranger()
        publisher = stranger.create_publisher(Odometry, TOPIC, QoSProfile(depth=4 * DEPTH))
        self._ros.until(publisher.get_subscription_count)
        return stranger, publisher

    def send(self, publisher: Publisher, count: int) -> None:
        """Publish, and wait until all has come."""
        for _ in range(count):
            publisher.publish(odometry_bytes("alpha", time.time_ns()))
        self._ros.until(lambda: publisher.wait_for_all_acked(Duration()))

    def take_all(self) -> int:
        """Take all that waits, in several ticks; returns how many messages."""
        count = 0
        while taken := len(self._inputs.take(time.time_ns)):
            count += taken
        return count


@pytest.fixture
def inputs(ros: Ros, swarm_file: Path) -> Iterator[Inputs]:
    """Inputs that hear one robot's odometry."""
    node = rclpy.create_node("inputs")
    yield Inputs(ros, node, swarm_file)
    node.destroy_node()


def test_a_publisher_that_ends_beside_another_has_lost_nothing(ros: Ros, inputs: Inputs) -> None:
    ending, old = inputs.publisher()
    inputs.send(old, 60)
    assert inputs.take_all() == 60
    _, new = inputs.publisher()
    for _ in range(3):
        inputs.send(new, 2)
        inputs.send(old, 2)
    inputs.send(new, 1)
    inputs.send(old, 1)
    ending.destroy_publisher(old)
    ros.until(lambda: inputs.node.count_publishers(TOPIC) == 1)
    inputs.send(new, 5)
    assert inputs.take_all() == 19
    _, restarted = inputs.publisher()
    inputs.send(restarted, 3)
    inputs.send(new, 3)
    assert inputs.take_all() == 6
    assert not inputs.drops


def test_what_is_lost_after_one_of_two_publishers_has_ended_is_counted(ros: Ros, inputs: Inputs) -> None:
    (ending, old), (_, new) = inputs.publisher(), inputs.publisher()
    inputs.send(old, 90)
    inputs.send(new, 5)
    assert inputs.take_all() == 95
    ending.destroy_publisher(old)
    ros.until(lambda: inputs.node.count_publishers(TOPIC) == 1)
    inputs.send(new, DEPTH + 70)
    assert inputs.take_all() == DEPTH
    assert inputs.drops == {"overload": 70}


@pytest.mark.parametrize("others", [(), (9,), (2, 90)])
def test_what_a_full_queue_loses_is_counted_beside_other_publishers_too(
    inputs: Inputs, others: tuple[int, ...]
) -> None:
    _, publisher = inputs.publisher()
    inputs.send(publisher, 5)
    beside = [inputs.publisher()[1] for _ in others]
    for other, count in zip(beside, others, strict=True):
        inputs.send(other, count)
    assert inputs.take_all() == 5 + sum(others)
    inputs.send(publisher, DEPTH + 70)
    assert inputs.take_all() == DEPTH
    # which of several publishers a number follows is not known; the nearest one is taken
    assert inputs.drops == {"overload": 75 - max(one for one in (5, *others) if one < 75)}
    for each in (publisher, *beside):
        inputs.send(each, 5)
    assert inputs.take_all() == 5 + 5 * len(others)
    assert inputs.drops.total() <= 70


def test_what_has_waited_for_longer_than_the_horizon_is_dropped_unread_and_counted(
    ros: Ros, swarm_file: Path
) -> None:
    node = rclpy.create_node("inputs")
    inputs = Inputs(ros, node, swarm_file, horizon_s=2.0)
    _, publisher = inputs.publisher()
    inputs.send(publisher, 300)
    last_s = time.monotonic()
    ros.until(lambda: time.monotonic() > last_s + 2.1)
    inputs.send(publisher, 1)
    assert inputs.take_all() == 1
    assert inputs.drops == {"overload": 300}
    node.destroy_node()


def test_of_images_only_those_wait_that_come_within_the_horizon(ros: Ros, swarm_file: Path) -> None:
    node = rclpy.create_node("inputs")
    topics = [
        one for one in live_topics(load_swarm(swarm_file), shared=False) if one.kind.name == "detections"
    ]
    drops: Counter[str] = Counter()
    inputs = EstimatorInputs(node, topics[:1], lambda why, count: drops.update([why] * count), 2.0)
    publisher = ros.stranger().create_publisher(MarkerDetectionArray, topics[0].name, QoSProfile(depth=DEPTH))
    ros.until(publisher.get_subscription_count)
    sent = [
        detection_bytes("alpha", stamp_ns, np.zeros(0, DETECTION_DTYPE)) for stamp_ns in range(IMAGES + 51)
    ]
    publisher.publish(sent[0])
    ros.until(lambda: len(inputs.take(time.time_ns)) == 1)
    for data in sent[1:]:
        publisher.publish(data)
    ros.until(lambda: publisher.wait_for_all_acked(Duration()))
    taken: list[bytes] = []
    while more := inputs.take(time.time_ns):
        taken += [one.data for one in more]
    assert taken == sent[-IMAGES:]
    assert drops == {"overload": 50}
    assert inputs.unread == {"detections": 50}
    assert inputs.taken == {"detections": 1 + IMAGES}

    # what is sent again for a queue that is too short would come too late, and never be freed
    def reliability() -> list[ReliabilityPolicy]:
        infos = node.get_subscriptions_info_by_topic(topics[0].name)
        return [one.qos_profile.reliability for one in infos]

    ros.until(lambda: reliability() == [ReliabilityPolicy.BEST_EFFORT])
    ros.until(lambda: publisher.publish(sent[0]) or len(inputs.take(time.time_ns)) > 0)
    node.destroy_node()


PACKETS = 400  # More than fit between both ends at once
END = "import socket, sys; from lossy_link import forward; "
END += "forward(int(sys.argv[1]), socket.socket(fileno=int(sys.argv[2])), (0.5, 0.0), 0.0, 1)"


def pair() -> tuple[socket.socket, socket.socket]:
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)


@pytest.fixture
def machines() -> Iterator[list[socket.socket]]:
    """The ends of two machines that a link of half a second joins."""
    with ExitStack() as stack:
        machines: list[socket.socket] = []
        for between in pair():
            machine, device = pair()
            machine.settimeout(30.0)
            numbers = (device.fileno(), between.fileno())
            with device, between:
                process = stack.enter_context(
                    subprocess.Popen(
                        [sys.executable, "-c", END, *map(str, numbers)],
                        cwd=Path(__file__).parents[1] / "worlds",
                        pass_fds=numbers,
                    )
                )
            stack.callback(process.kill)
            machines.append(stack.enter_context(machine))
        yield machines


def received(machine: socket.socket) -> list[int]:
    return [int.from_bytes(machine.recv(2000)[:2], "big") for _ in range(PACKETS)]


def test_ends_that_are_both_full_go_on(machines: list[socket.socket]) -> None:
    """All packets of both sides are due at once, and neither end has room for those of the other."""
    with ThreadPoolExecutor() as pool:
        receiving = [pool.submit(received, machine) for machine in machines]
        for number in range(PACKETS):
            for machine in machines:
                machine.send(number.to_bytes(2, "big") * 700)

        for one in receiving:
            assert one.result() == [*range(PACKETS)]
