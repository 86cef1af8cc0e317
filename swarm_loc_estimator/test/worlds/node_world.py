"""What the node tests share: a small swarm that stands and sees two landmarks, and ROS around it."""

import importlib.util
import math
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from processor_wait import waited_s
from rclpy.duration import Duration
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from typing_extensions import Self

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.launch import executable_path
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE, encode_detections
from swarm_loc_estimator.common.messages.poses import encode_odometry
from swarm_loc_estimator.common.node import end_at_task_errors
from swarm_loc_estimator.sensors.camera import CONTENT_POSE
from swarm_loc_msgs.msg import MarkerDetectionArray, SwarmPose, SwarmPoses

SECOND = 1_000_000_000
STEP_NS = SECOND // 20
T0_NS = 1_000 * SECOND
PATIENCE_S = 60.0
SWARM_YAML = """
fileversion: 1
defaults:
  sensor: {forward_sigma: 0.02, left_sigma: 0.02, heading_sigma: 0.05}
  faces: {front: {x: 0.0, yaw: 0.0}}
robots:
  alpha: {ids: {front: 1}, start: {x: 0.0, y: 0.0, theta: 0.0}}
  beta: {ids: {front: 2}}
landmarks:
  100: {x: 2.0, y: 0.0, yaw: 3.14159265}
  101: {x: 2.0, y: 1.0, yaw: 3.14159265}
"""
LANDMARKS = {100: (2.0, 0.0, math.pi), 101: (2.0, 1.0, math.pi)}
TRUE_POSES = {"alpha": (0.0, 0.0, 0.0), "beta": (0.0, 1.0, 0.0)}
UNKNOWN_ID = 999
SETTINGS = {"fusion_load": 1.0}  # Every tick fuses, however fast the test lets time pass

_RELIABLE = QoSProfile(depth=100)

Poses = dict[str, tuple[float, float, float]]


def module_at(path: Path) -> ModuleType:
    """A Python file that belongs to no package, such as a launch file."""
    spec = importlib.util.spec_from_file_location(path.name.partition(".")[0], path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def write_swarm(folder: Path) -> Path:
    path = folder / "swarm.yaml"
    path.write_text(SWARM_YAML, encoding="utf-8")
    return path


def odometry_bytes(robot: str, stamp_ns: int, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> bytes:
    frames = f"{robot}/odom", f"{robot}/base_link"
    return encode_odometry(*frames, np.array([stamp_ns]), np.array([pose]), np.zeros((1, 3)))[0]


def sight(
    pose: tuple[float, float, float],
    ids: Sequence[int] = tuple(LANDMARKS),
    markers: Mapping[int, tuple[float, float, float]] = LANDMARKS,
) -> NDArray[np.void]:
    """What a camera at a pose sees of markers; an unknown id is seen where the first landmark is."""
    detections = np.zeros(len(ids), DETECTION_DTYPE)
    for row, marker_id in zip(detections, ids, strict=True):
        seen = se2.between(np.array(pose), np.array(markers.get(marker_id, LANDMARKS[100])))
        row["id"], row["content"] = marker_id, CONTENT_POSE
        row["position"] = (-seen[1], 0.0, seen[0])
        row["orientation"] = (0.0, math.sin(-seen[2] / 2.0), 0.0, math.cos(-seen[2] / 2.0))
        row["covariance"][0, 0] = -1.0
    return detections


def detection_bytes(robot: str, stamp_ns: int, detections: NDArray[np.void]) -> bytes:
    return encode_detections(f"{robot}/camera_optical_frame", stamp_ns, detections)


def xytheta(pose: SwarmPose) -> NDArray[np.float64]:
    return np.array([pose.x, pose.y, pose.theta])


class Ros:
    """A ROS context with a node of the test's own, and an executor for all nodes of the test."""

    def __init__(self) -> None:
        rclpy.init(args=[])
        end_at_task_errors()
        self.executor = EventsExecutor()
        self.nodes: list[Node] = []
        self._strangers: list[Node] = []
        self.tester = self.add(rclpy.create_node("tester"))

    def add(self, node: Any) -> Any:
        """Let a node take part."""
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def stranger(self) -> Node:
        """A node of another participant, as of another process; it only publishes."""
        context = rclpy.Context()
        rclpy.init(args=[], context=context)
        self._strangers.append(rclpy.create_node("stranger", context=context))
        return self._strangers[-1]

    def listen(self, message_class: type, topic: str) -> list[Any]:
        """All messages that come on a topic from now on."""
        heard: list[Any] = []
        self.tester.create_subscription(message_class, topic, heard.append, 1000)
        return heard

    def call(self, service_class: Any, name: str, request: Any) -> Any:
        """The response of a service."""
        client = self.tester.create_client(service_class, name)
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def until(self, condition: Callable[[], object], patience_s: float = PATIENCE_S) -> None:
        """Handle events until something is so."""
        end_s = time.monotonic() + patience_s
        while not condition():
            assert time.monotonic() < end_s, "waited in vain"
            self.executor.spin_once(timeout_sec=0.02)

    def publish_until(self, publisher: Publisher, message: Any, condition: Callable[[], object]) -> None:
        """Publish until something is so: what is sent by best effort may get lost."""

        def happened() -> bool:
            if not condition():
                publisher.publish(message)
                return False
            return True

        self.until(happened)

    def close(self) -> None:
        """End all nodes, once the executor has let go of them: it crashes with the events of what is gone."""
        for node in self.nodes:
            self.executor.remove_node(node)
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        rclpy.shutdown()
        for stranger in self._strangers:
            stranger.destroy_node()
            stranger.context.shutdown()


def overrides(**values: Any) -> list[Parameter]:
    """Parameters of a node as the command line would set them."""
    return [Parameter(name, value=value) for name, value in values.items()]


class Robots:
    """The two robots' drivers and the simulated clock."""

    def __init__(self, ros: Ros, qos: QoSProfile = _RELIABLE) -> None:
        self._ros = ros
        self._qos = qos
        self._clock: Publisher = ros.tester.create_publisher(Clock, "/clock", 10)
        self._odometry = {name: self._publisher(Odometry, f"{name}/odom") for name in TRUE_POSES}
        self._detections = {
            name: self._publisher(MarkerDetectionArray, f"{name}/detections") for name in TRUE_POSES
        }
        self.poses: list[SwarmPoses] = ros.listen(SwarmPoses, "swarm/poses")

    def _publisher(self, message_class: type, topic: str) -> Publisher:
        return self._ros.tester.create_publisher(message_class, topic, self._qos)

    def wait_for_estimator(self) -> None:
        """Return once it hears all topics and is heard."""
        inputs = [self._clock, *self._odometry.values(), *self._detections.values()]
        self._ros.until(lambda: all(publisher.get_subscription_count() for publisher in inputs))
        self._ros.until(lambda: self._ros.tester.count_publishers("swarm/poses"))

    def wake_estimator(self, now_ns: int) -> None:
        """Tell the time until an estimator in another process answers.

        Whether it hears cannot be seen from here: DDS believes for a while in one that was killed, and knows
        of a new one before that one knows of us.
        """
        self.poses.clear()

        def answers() -> bool:
            self.tell_time(now_ns)
            return bool(self.poses)

        self._ros.until(answers)

    def step(self, now_ns: int, poses: Poses | None = None) -> None:
        """Publish the clock, everyone's odometry and sightings, and wait for the estimate that follows."""
        heard = len(self.poses)
        self.tell_time(now_ns)
        for name, pose in (poses or TRUE_POSES).items():
            self.odometry(name, odometry_bytes(name, now_ns, pose))
            self.detections(name, detection_bytes(name, now_ns, sight(pose)))
        self._ros.until(lambda: any(stamp_ns(pose) == now_ns for pose in self.poses[heard:]))

    def run(self, begin_ns: int, steps: int, poses: Callable[[int], Poses] | None = None) -> int:
        """So many steps; returns the time of the last."""
        for step in range(steps):
            self.step(begin_ns + step * STEP_NS, poses(begin_ns + step * STEP_NS) if poses else None)
        return begin_ns + (steps - 1) * STEP_NS

    def run_until(
        self, begin_ns: int, condition: Callable[[], object], poses: Callable[[int], Poses] | None = None
    ) -> int:
        """Steps until something is so; returns the time of the last."""
        now_ns, end_s = self.run(begin_ns, 1, poses), time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end_s, "went on in vain"
            now_ns = self.run(now_ns + STEP_NS, 1, poses)
        return now_ns

    def tell_time(self, now_ns: int) -> None:
        """Publish the clock."""
        self._clock.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))

    def wait_until_told(self) -> None:
        """Return once the time has come to every reliable subscription, whether it was handled or not."""
        assert self._clock.wait_for_all_acked(Duration(seconds=PATIENCE_S))

    def wait_until_received(self) -> None:
        """Return once all odometry and sightings are where the estimator takes them from."""
        for publisher in (*self._odometry.values(), *self._detections.values()):
            assert publisher.wait_for_all_acked(Duration(seconds=PATIENCE_S))

    def odometry(self, robot: str, data: bytes) -> None:
        """Publish serialized odometry."""
        self._odometry[robot].publish(data)

    def detections(self, robot: str, data: bytes) -> None:
        """Publish serialized detections."""
        self._detections[robot].publish(data)

    def newest(self, robot: str) -> SwarmPose:
        """The last estimate of a robot."""
        (pose,) = [pose for pose in self.poses[-1].robots if pose.name == robot]
        return pose

    def located(self, robot: str) -> bool:
        """Whether the last estimate says where a robot is, by sightings or by its configured start."""
        located = (SwarmPose.STATUS_TRACKED, SwarmPose.STATUS_UNCONFIRMED)
        return bool(self.poses) and self.newest(robot).status in located


def stamp_ns(message: Any) -> int:
    return int(Time.from_msg(message.header.stamp).nanoseconds)


def newest_status(heard: Sequence[DiagnosticArray], name: str) -> DiagnosticStatus:
    """The newest diagnostics of one name; empty ones before the first have come."""
    found = [status for message in heard for status in message.status if status.name == name]
    return found[-1] if found else DiagnosticStatus()


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def report(heard: Sequence[DiagnosticArray], name: str) -> tuple[DiagnosticStatus, dict[str, str]]:
    """The newest diagnostics of one name, and its values."""
    status = newest_status(heard, name)
    return status, values_of(status)


class Steps:
    """The simulated clock for some publishers, once an estimator hears all of them and is heard."""

    def __init__(self, ros: Ros, *inputs: Publisher) -> None:
        self._ros = ros
        self._clock: Publisher = ros.tester.create_publisher(Clock, "/clock", 10)
        self.poses: list[SwarmPoses] = ros.listen(SwarmPoses, "swarm/poses")
        ros.until(lambda: all(one.get_subscription_count() for one in (self._clock, *inputs)))
        ros.until(lambda: ros.tester.count_publishers("swarm/poses"))

    def step(self, now_ns: int, *messages: tuple[Publisher, Any]) -> None:
        """Publish messages and the time, and wait for the estimate that follows."""
        heard = len(self.poses)
        for publisher, message in messages:
            publisher.publish(message)
        self._clock.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))
        self._ros.until(lambda: any(stamp_ns(one) == now_ns for one in self.poses[heard:]))


@contextmanager
def repeated(send: Callable[[], None], period_s: float = 0.05) -> Iterator[None]:
    """Something is sent again and again, by a thread."""
    end = threading.Event()

    def run() -> None:
        while not end.wait(period_s):
            send()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


class Program:
    """An executable as a process of its own, its output in one file; options precede those of ROS."""

    def __init__(
        self,
        name: str,
        log: Path,
        parameters: dict[str, object],
        arguments: Sequence[str] = (),
        package: str = "swarm_loc_estimator",
        options: Sequence[str] = (),
    ) -> None:
        self.log = log
        command = [str(executable_path(package, name)), *options]
        command += ["--ros-args", *arguments] if arguments or parameters else []
        for key, value in parameters.items():
            command += ["-p", f"{key}:={value}"]
        with log.open("wb") as out:
            self.process = subprocess.Popen(command, stdout=out, stderr=out, env=dict(os.environ))

    @property
    def output(self) -> str:
        """What it has printed so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def wait_for(self, text: str) -> None:
        """Return once it has printed something."""
        end_s = time.monotonic() + PATIENCE_S
        while text not in self.output:
            assert self.process.poll() is None, self.output
            assert time.monotonic() < end_s, self.output
            with_patience(self.process, 0.05)

    def end(self, number: signal.Signals | None = None) -> int:
        """Send a signal, if any, and wait for the exit status."""
        if number is not None:
            self.process.send_signal(number)
        return self.process.wait(PATIENCE_S)

    def seconds_to_end(self, number: signal.Signals) -> float:
        """Send a signal and wait for the end; how long that took but for waiting for a processor."""
        begin_s, begin_waited_s = time.monotonic(), waited_s(self.process.pid)
        self.process.send_signal(number)
        os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOWAIT)  # its figures stay until it is reaped
        return time.monotonic() - begin_s - (waited_s(self.process.pid) - begin_waited_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()


def with_patience(process: subprocess.Popen[bytes], seconds: float) -> None:
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return
