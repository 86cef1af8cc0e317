"""Run a graph as child processes in a ROS domain of its own, and record its poses and diagnostics.

The graph is that of the commands and launch files. Its ROS domain is otherwise unused and limited
to this machine, so that it cannot interfere with real robots.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from domain_coordinator import domain_id
from numpy.typing import NDArray
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from typing_extensions import Self

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.launch import Child, NodeSpec, node_command, start, stop
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.registry import kinds
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_msgs.msg import SwarmPoses

START_PATIENCE_S = 600.0  # Compiling the estimator takes three minutes, more on a busy machine
_ALONE = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": ""}
_WAKE_S = 0.05


class LiveError(UserError):
    """The live graph has failed; the message is one sentence."""


class LiveGraph:
    """A graph that runs as child processes while this process listens; use it as a context manager.

    Args:
        nodes: The estimator first; the others start when this process has discovered its poses.
        log: File for the output of the nodes.

    Raises:
        LiveError: The estimator does not start.
    """

    recorder: Recorder  # Records poses and diagnostics

    def __init__(self, nodes: Sequence[NodeSpec], log: Path) -> None:
        self._nodes = {node.full_name: node for node in nodes}
        self._log = log
        self._children: dict[str, Child] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._log.parent.mkdir(parents=True, exist_ok=True)
            self._output = stack.enter_context(self._log.open("wb"))
            stack.enter_context(_own_domain())
            context = rclpy.Context()
            rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
            stack.callback(context.try_shutdown)
            self.recorder = Recorder(context=context)
            stack.callback(self.recorder.destroy_node)
            self._executor = EventsExecutor(context=context)
            stack.callback(self._executor.shutdown)
            self._executor.add_node(self.recorder)
            stack.callback(self._stop)
            self._start_all()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def process(self, name: str) -> subprocess.Popen[bytes]:
        """The process of a node by its full name."""
        return self._children[name].process

    def kill(self, name: str) -> None:
        """Kill a node."""
        self.process(name).kill()
        self.process(name).wait()

    def restart(self, name: str) -> None:
        """Kill a node if it runs, and start it."""
        self.kill(name)
        self._start(self._nodes[name])

    def wait_for(
        self,
        condition: Callable[[], bool],
        what: str,
        patience_s: float,
        needed: Collection[str] | None = None,
    ) -> None:
        """Process messages until a condition holds.

        Args:
            condition: Checked after each event and every 50 ms.
            what: The condition in words, following "did not".
            patience_s: Timeout since the last poses.
            needed: Nodes that must keep running; None: all that have started.

        Raises:
            LiveError: A node has ended, or the timeout has passed.
        """
        heard, since_s = -1, time.monotonic()
        while not condition():
            for name in self._children if needed is None else needed:
                if self.process(name).poll() is not None:
                    raise LiveError(
                        f"Node {name} has ended, status {self.process(name).returncode};{self._see}"
                    )
            if len(self.recorder.raw) != heard:
                heard, since_s = len(self.recorder.raw), time.monotonic()
            if time.monotonic() > since_s + patience_s:
                raise LiveError(f"The graph did not {what} within {patience_s:.0f} s;{self._see}")
            self._executor.spin_once(timeout_sec=_WAKE_S)

    def _start_all(self) -> None:
        """Start the estimator, and the others once this process has discovered it: no pose is missed."""
        estimator, *others = self._nodes.values()
        self._start(estimator)
        self.wait_for(
            lambda: self.recorder.count_publishers("swarm/poses") > 0,
            "announce its poses",
            START_PATIENCE_S,
        )
        for node in others:
            self._start(node)

    @property
    def _see(self) -> str:
        """The end of an error message: the log and its last line."""
        said = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return f" its nodes' output is in {self._log}" + (f", at last: {said[-1]}" if said else ".")

    def _start(self, node: NodeSpec) -> None:
        self._children[node.full_name] = Child(node, start(node_command(node), self._output))

    def _stop(self) -> None:
        stop(list(self._children.values()), self._note)

    def _note(self, line: str) -> None:
        self._output.write(f"{line}\n".encode())


def cpu_seconds(pid: int) -> float:
    """CPU time of a process so far [s]."""
    fields = Path("/proc", str(pid), "stat").read_text(encoding="ascii").rpartition(")")[2].split()
    user_and_system = int(fields[11]) + int(fields[12])
    return user_and_system / os.sysconf("SC_CLK_TCK")


def resident_mb(pid: int) -> float:
    """Resident memory of a process [MB]."""
    lines = Path("/proc", str(pid), "status").read_text(encoding="ascii").splitlines()
    (kilobytes,) = [line.split()[1] for line in lines if line.startswith("VmRSS:")]
    return int(kilobytes) / 1e3


@contextmanager
def _own_domain() -> Iterator[None]:
    """Give this process and its children an unused ROS domain, limited to this machine."""
    reservation = domain_id()
    alone = {**_ALONE, "ROS_DOMAIN_ID": str(reservation.__enter__())}
    before = {name: os.environ.get(name) for name in alone}
    os.environ.update(alone)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        reservation.__exit__(None, None, None)  # it takes an exception for a domain in use


_DEEP = QoSProfile(depth=1000)
_ESTIMATOR = "estimator"
_DROPPED = "dropped: "
_RECEIVED = {f"{kind.topic} received": kind for kind in kinds().values()}


class Poses(NamedTuple):
    """One message of swarm/poses."""

    stamp_ns: int  # Time of the poses
    pose: FloatArray  # (N, 3) x [m], y [m], theta [rad] in map
    covariance: FloatArray  # (N, 3, 3)
    status: NDArray[np.uint8]  # (N,) of `SwarmPose.status`


class Recorder(Node):
    """Records all messages of swarm/poses with their times of reception, and counts from /diagnostics.

    Args:
        node_arguments: Further arguments of `rclpy.node.Node`.

    Attributes:
        raw: Serialized messages in order of reception.
        received_ns: Time of each reception by the graph's clock, which advances in steps of /clock.
        taken: Stamp of poses -> topic -> messages that the estimator had received by then, from /diagnostics,
            about once a second.
        inputs: Messages that the estimator has received, of all topics.
        drops: Dropped inputs of the estimator, by reason.
        diagnostics: Number of /diagnostics messages from the estimator.
    """

    def __init__(self, **node_arguments: Any) -> None:
        simulated = Parameter("use_sim_time", value=True)
        super().__init__("recorder", parameter_overrides=[simulated], **node_arguments)
        self.raw: list[bytes] = []
        self.received_ns: list[int] = []
        self._poses: list[Poses] = []
        self.taken: dict[int, dict[str, int]] = {}
        self.inputs = 0
        self.drops: dict[str, int] = {}
        self.diagnostics = 0
        self.create_subscription(SwarmPoses, "swarm/poses", self._on_poses, _DEEP, raw=True)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, _DEEP)

    def poses(self) -> Sequence[Poses]:
        """All messages so far in order of reception; each is decoded once."""
        self._poses.extend(map(read_poses, self.raw[len(self._poses) :]))
        return self._poses

    def result(self, title: str, swarm: Swarm, truth: Mapping[str, Trajectory]) -> ReplayResult:
        """All poses so far, at least one, with ground truth and the counts of dropped inputs."""
        stamps_ns, poses, covariances, status = zip(*self.poses(), strict=True)
        stamp_ns, columns = np.array(stamps_ns, dtype=np.int64), (np.array(poses), np.array(covariances))
        return ReplayResult(title, swarm, stamp_ns, *columns, np.array(status), truth, dict(self.drops))

    def _on_poses(self, data: bytes) -> None:
        self.raw.append(data)
        self.received_ns.append(self.get_clock().now().nanoseconds)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        own = [status for status in message.status if status.name == _ESTIMATOR]
        if not own:  # of another node
            return
        taken = _taken(message.status)
        self.taken[nanoseconds(message.header.stamp)] = taken
        self.inputs = sum(taken.values())
        self.drops = {
            value.key.removeprefix(_DROPPED): int(value.value)
            for value in own[0].values
            if value.key.startswith(_DROPPED)
        }
        self.diagnostics += 1


def _taken(statuses: Sequence[DiagnosticStatus]) -> dict[str, int]:
    """Topic -> messages that the estimator has received, from its status and those of the robots."""
    taken = {}
    for status in statuses:
        robot = status.name.removeprefix(_ESTIMATOR).removeprefix(": ")
        for value in status.values:
            if (kind := _RECEIVED.get(value.key)) is not None:
                taken[f"{robot}/{kind.topic}" if robot else kind.topic] = int(value.value)
    return taken


def read_poses(data: bytes) -> Poses:
    """Decode a serialized SwarmPoses."""
    message = deserialize_message(data, SwarmPoses)
    robots = message.robots
    return Poses(
        nanoseconds(message.header.stamp),
        np.array([(one.x, one.y, one.theta) for one in robots]).reshape(-1, 3),
        np.array([one.covariance for one in robots]).reshape(-1, 3, 3),
        np.array([one.status for one in robots], dtype=np.uint8),
    )
