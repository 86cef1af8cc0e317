"""More comes over DDS than an estimator can use: it leaves sightings out, says so, and stays right."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from node_world import TRUE_POSES, Ros, detection_bytes, odometry_bytes, overrides, repeated, sight

from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.timeline import HasBudget
from swarm_loc_msgs.msg import MarkerDetectionArray, SwarmPose, SwarmPoses

COST_S = 0.02  # Sixteen sightings come in a tick of 200 ms: they would take 320 ms


class SlowEstimator(Estimator):
    """Takes its time for each sighting that it fuses."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.cost_s = COST_S
        self.taken = np.zeros(len(self.swarm.robots), dtype=int)
        self.odometry = 0
        self._waiting = 0

    def convert(self, batch: Batch) -> Batch:
        """Count what comes."""
        self._waiting += batch["detections"].robot.size
        self.taken += np.bincount(batch["detections"].robot, minlength=self.taken.size)
        self.odometry += batch["odometry"].robot.size
        return super().convert(batch)

    def tick(self, now_ns: int, *, fuse: bool = True, has_budget: HasBudget = lambda: True) -> Estimate:
        """Fuse slowly."""
        if fuse:
            time.sleep(self.cost_s * self._waiting)
            self._waiting = 0
        return super().tick(now_ns, fuse=fuse, has_budget=has_budget)


@contextmanager
def driving(ros: Ros) -> Iterator[list[int]]:
    """Robots that send odometry and an image 20 times a second, from a process of their own; how often."""
    node, sent = ros.stranger(), [0]
    odometry = {name: node.create_publisher(Odometry, f"{name}/odom", 1000) for name in TRUE_POSES}
    images = {
        name: node.create_publisher(MarkerDetectionArray, f"{name}/detections", 1000) for name in TRUE_POSES
    }
    publishers = [*odometry.values(), *images.values()]
    ros.until(lambda: all(publisher.get_subscription_count() for publisher in publishers))

    def send() -> None:
        for name, pose in TRUE_POSES.items():
            stamp_ns = time.time_ns()
            odometry[name].publish(odometry_bytes(name, stamp_ns))
            images[name].publish(detection_bytes(name, stamp_ns, sight(pose)))
        sent[0] += 1

    with repeated(send):
        yield sent


def newest(heard: list[DiagnosticArray]) -> tuple[int, str, dict[str, str]]:
    (status,) = [one for one in heard[-1].status if one.name == "estimator"]
    return status.level, status.message, {pair.key: pair.value for pair in status.values}


def test_an_overloaded_estimator_sheds_sightings_evenly_and_says_so(ros: Ros, swarm_file: Any) -> None:
    made: list[SlowEstimator] = []

    def create(*arguments: Any) -> SlowEstimator:
        made.append(SlowEstimator(*arguments))
        return made[-1]

    # No tick takes as long as this horizon, so that no message is too old to be read
    parameters = overrides(swarm_file=str(swarm_file), tick_period_s=0.2, fusion_load=0.5, horizon_s=5.0)
    ros.add(EstimatorNode(create, parameter_overrides=parameters))
    (slow,) = made
    poses: list[SwarmPoses] = ros.listen(SwarmPoses, "swarm/poses")
    heard: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")

    def left_out() -> float:
        value = newest(heard)[2].get("sightings left out [1]", "-") if heard else "-"
        return 0.0 if value == "-" else float(value)

    with driving(ros) as sent:
        ros.until(lambda: left_out() > 0.3)
        level, sentence, values = newest(heard)
        assert level == DiagnosticStatus.WARN
        assert "overload: dropped " in sentence
        assert sentence.endswith("uniformly over robots")
        assert int(values["dropped: shed_detections"]) > 0

        slow.taken[:] = 0
        ros.until(lambda: slow.taken.sum() > 60)
        assert slow.taken[0] == pytest.approx(slow.taken[1], abs=4)

        slow.cost_s = 0.0  # the load falls
        ros.until(lambda: bool(heard) and newest(heard)[2].get("sightings left out [1]") == "0")
        assert "overload" not in newest(heard)[1]

    ros.until(lambda: slow.odometry == 2 * sent[0])
    assert "dropped: overload" not in newest(heard)[2]
    for message in poses[-10:]:
        for robot in message.robots:
            assert robot.status == SwarmPose.STATUS_TRACKED
            assert (robot.x, robot.y, robot.theta) == pytest.approx(TRUE_POSES[robot.name], abs=0.02)


class BusyEstimator(Estimator):
    """Once, a message comes while it reads others for longer than its clock may seem to jump back."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.send: Callable[[], None] | None = None
        self.received = 0

    def convert(self, batch: Batch) -> Batch:
        """Read slowly, once."""
        self.received += batch["odometry"].robot.size
        if self.send is not None and self.received:
            self.send()
            self.send, end_s = None, time.monotonic() + 5.0 * self.settings.jump_back_s
            while time.monotonic() < end_s:
                pass
        return super().convert(batch)


def test_what_comes_while_much_is_read_is_no_jump_of_the_clock(ros: Ros, swarm_file: Any) -> None:
    made: list[BusyEstimator] = []

    def create(*arguments: Any) -> BusyEstimator:
        made.append(BusyEstimator(*arguments))
        return made[-1]

    ros.add(
        EstimatorNode(create, parameter_overrides=overrides(swarm_file=str(swarm_file), jump_back_s=0.02))
    )
    (busy,) = made
    publisher = ros.stranger().create_publisher(Odometry, "alpha/odom", 100)
    ros.until(publisher.get_subscription_count)

    def send() -> None:
        publisher.publish(odometry_bytes("alpha", time.time_ns()))
        assert publisher.wait_for_all_acked()

    busy.send = send
    send()
    ros.until(lambda: busy.received == 2)
    assert busy.time_jumps == 0
