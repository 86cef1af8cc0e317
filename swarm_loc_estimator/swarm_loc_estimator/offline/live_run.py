"""Run a graph as child processes, record its poses, play a bag into it, and compare it with a replay.

The graph is that of the commands and launch files. Its ROS domain is otherwise unused and limited
to this machine, so that it cannot interfere with real robots.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from domain_coordinator import domain_id
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from typing_extensions import Self

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.launch import (
    Child,
    GraphOptions,
    NodeSpec,
    ParameterValue,
    graph_nodes,
    node_command,
    start,
    stop,
)
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.messages.poses import EstimateMessage, SwarmPosesReader
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.nodes.parameters import EstimatorParameters
from swarm_loc_estimator.offline.recorded_bag import TruthReader
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.inputs import input_topics, kinds
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.settings import Settings
from swarm_loc_msgs.msg import SwarmPoses

START_PATIENCE_S = 600.0  # Compiling the estimator takes three minutes, more on a busy machine
_ALONE = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": ""}
_WAKE_S = 0.05


class LiveError(UserError):
    """The live graph has failed."""


class LiveGraph:
    """A graph that runs as child processes while this process listens; use it as a context manager.

    The estimator is the first node; the others start when this process has discovered its poses. Raises
    LiveError if the estimator does not start.
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
            stack.callback(lambda: stop([*self._children.values()], self._note))
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
        """Process messages until a condition holds, which is checked after each event and every 50 ms.

        `what` is the condition in words, following "did not". The patience is since the last poses. All nodes
        that have started, or those that are needed, must keep running. Raises LiveError if a node has ended,
        or the timeout has passed.
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
            lambda: self.recorder.count_publishers("swarm/poses") > 0, "announce its poses", START_PATIENCE_S
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
    before = {name: os.environ[name] for name in alone if name in os.environ}
    os.environ.update(alone)
    try:
        yield
    finally:
        for name in alone.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)
        reservation.__exit__(None, None, None)  # it takes an exception for a domain in use


_DEEP = QoSProfile(depth=1000)
_ESTIMATOR = "estimator"
_DROPPED = "dropped: "
_RECEIVED = {f"{kind.topic} received": kind for kind in kinds().values()}


class Recorder(Node):
    """Records all messages of swarm/poses with their times of reception, and counts from /diagnostics."""

    def __init__(self, **node_arguments: Any) -> None:
        simulated = Parameter("use_sim_time", value=True)
        super().__init__("recorder", parameter_overrides=[simulated], **node_arguments)
        self.raw: list[bytes] = []  # Serialized messages in order of reception
        # Time of each reception by the graph's clock, which advances in steps of /clock
        self.received_ns: list[int] = []
        self._poses: list[EstimateMessage] = []
        # Stamp of poses -> topic -> messages that the estimator had received by then, from /diagnostics,
        # about once a second
        self.taken: dict[int, dict[str, int]] = {}
        self.inputs = 0  # Messages that the estimator has received, of all topics
        self.drops: dict[str, int] = {}  # Dropped inputs of the estimator, by reason
        self.diagnostics = 0  # Number of /diagnostics messages from the estimator
        self.create_subscription(SwarmPoses, "swarm/poses", self._on_poses, _DEEP, raw=True)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, _DEEP)

    def poses(self) -> Sequence[EstimateMessage]:
        """All messages so far in order of reception; each is decoded once."""
        self._poses.extend(map(read_poses, self.raw[len(self._poses) :]))
        return self._poses

    def result(self, title: str, swarm: Swarm, truth: Mapping[str, Trajectory]) -> ReplayResult:
        """All poses so far, at least one, with ground truth and the counts of dropped inputs."""
        poses = self.poses()
        names = ("stamp_ns", "pose", "covariance", "status", "heading_known")
        stamp_ns, pose, covariance, status, known = (
            np.array([getattr(one, name) for one in poses]) for name in names
        )
        result = ReplayResult(title, swarm, stamp_ns, pose, covariance, status, heading_known=known)
        return replace(result, truth=truth, counters=dict(self.drops))

    def _on_poses(self, data: bytes) -> None:
        self.raw.append(data)
        self.received_ns.append(self.get_clock().now().nanoseconds)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        own = [status for status in message.status if status.name == _ESTIMATOR]
        if not own:  # of another node
            return
        taken = self.taken[nanoseconds(message.header.stamp)] = _taken(message.status)
        self.inputs = sum(taken.values())
        dropped = [value for value in own[0].values if value.key.startswith(_DROPPED)]
        self.drops = {value.key.removeprefix(_DROPPED): int(value.value) for value in dropped}
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


def read_poses(data: bytes) -> EstimateMessage:
    """Decode a serialized SwarmPoses."""
    return SwarmPosesReader().read(data)


ESTIMATOR, PLAYER = "estimator", "player"
_SILENCE_PATIENCE_S = 30.0
_END_PATIENCE_S = 10.0


@dataclass(frozen=True)
class LiveRun:
    """Results of a run of the live graph."""

    result: ReplayResult  # Poses as received, ground truth of the bag, counts of dropped inputs
    # Topic of the estimator's inputs -> (M,) increasing log times of its messages in the bag, all of which
    # were published
    arrival_ns: Mapping[str, IntArray]
    # Stamp of poses -> topic -> messages that the estimator had received by then; of some poses
    taken: Mapping[int, Mapping[str, int]]
    rate: float  # Speed of the player
    received: int  # Messages that the estimator received
    estimator_core: float  # CPU time of the estimator per second while the bag played
    # (A,) time of reception minus stamp of poses in the bag's time, once /clock was received here
    age_s: FloatArray
    # From the start of the estimator to its first poses, which come when all topics of the bag are discovered
    # and the player has begun
    start_up_s: float
    memory_mb: float  # Of the estimator at the end

    @property
    def sent(self) -> int:
        """Inputs of the estimator that were published."""
        return sum(map(len, self.arrival_ns.values()))

    @property
    def lost(self) -> int:
        """Inputs that were published but not received."""
        return self.sent - self.received


@dataclass(frozen=True)
class BagContent:
    """Contents of a bag, read before it is played."""

    begin_ns: int  # First log time
    end_ns: int  # Last one
    # Topic of the estimator's inputs -> (M,) increasing log times of its messages
    arrival_ns: Mapping[str, IntArray]
    truth: Mapping[str, Trajectory]  # Robot name -> ground truth
    remarks: tuple[str, ...]  # What could not be read, one sentence each


Watch = Callable[[Recorder, BagContent], None]


def read_content(bag: Path, swarm: Swarm) -> BagContent:
    """Read ground truth and arrival times of a bag; raises BagError if nothing in the bag can be read."""
    inputs = [topic.name for topic in input_topics(swarm)]
    with BagReader(bag) as reader:
        truth = TruthReader(swarm, reader.topics)
        begin_ns, end_ns = reader.time_range_ns
        recorded = [topic.name for topic in reader.topics if topic.name in set(inputs)]
        arrivals = [[np.zeros(0, dtype=np.int64)] for _ in recorded]
        for batch in reader.batches([*truth.topics, *recorded]):
            truth.add(batch.chosen(batch.topic < len(truth.topics)))
            for number, parts in enumerate(arrivals, len(truth.topics)):
                parts.append(batch.log_ns[batch.topic == number])
        tracks = truth.tracks()
        remarks = (*reader.losses, *truth.remarks())
    arrival_ns = {topic: np.concatenate(parts) for topic, parts in zip(recorded, arrivals, strict=True)}
    return BagContent(begin_ns, end_ns, arrival_ns, tracks, remarks)


def play_live(
    options: GraphOptions,
    *,
    log: Path,
    inputs_only: bool = False,
    watch: Watch = lambda _recorder, _content: None,
) -> LiveRun:
    """Play a whole bag into a live graph and record its poses.

    The output of the nodes goes to `log`. `watch` is called about once per event while the bag plays. With
    `inputs_only` only inputs of the estimator are played.

    Raises:
        ValueError: The options have no bag.
        LiveError: The graph did not play to the end.
        GraphError: An executable is missing.
        BagError: Nothing in the bag can be read.
        SwarmFileError: The description cannot be used.
    """
    if options.bag is None:
        raise ValueError("there is no bag to play")
    # what is in the bag, and who plays it
    bag, swarm = Path(options.bag), load_swarm(Path(options.swarm_file))
    content = read_content(bag, swarm)
    nodes = [
        _player_of(node, [*content.arrival_ns], inputs_only=inputs_only) if node.name == PLAYER else node
        for node in graph_nodes(options)
    ]
    begin_s = time.monotonic()
    # play it to its end, and measure the estimator meanwhile
    with LiveGraph(nodes, log) as graph:
        recorder, estimator, player = graph.recorder, graph.process(ESTIMATOR), graph.process(PLAYER)

        def has_ended() -> bool:
            watch(recorder, content)
            return player.poll() is not None

        graph.wait_for(lambda: bool(recorder.raw), "publish poses", START_PATIENCE_S)
        cpu_s, wall_s = cpu_seconds(estimator.pid), time.monotonic()
        start_up_s = wall_s - begin_s
        graph.wait_for(has_ended, "go on publishing poses", _SILENCE_PATIENCE_S, needed=[ESTIMATOR])
        played_s = time.monotonic() - wall_s
        core = (cpu_seconds(estimator.pid) - cpu_s) / played_s
        if player.returncode:
            raise LiveError(f"The player ended with status {player.returncode}; see {log}.")
        _wait_for_the_rest(graph, content)
        memory_mb = resident_mb(estimator.pid)
    # what was received, and how late
    result = replace(
        recorder.result(f"{bag.name}, live at {options.rate:g} x", swarm, content.truth),
        remarks=content.remarks,
        data_s=(content.end_ns - content.begin_ns) * 1e-9,
        wall_s=played_s,
    )
    received_ns = np.array(recorder.received_ns, dtype=np.int64)
    # 0 before the first /clock
    age_s: FloatArray = 1e-9 * (received_ns - result.stamp_ns)[received_ns > 0].astype(np.float64)
    heard = content.arrival_ns, recorder.taken, options.rate, recorder.inputs
    return LiveRun(result, *heard, core, age_s, start_up_s, memory_mb)


def _player_of(player: NodeSpec, inputs: Sequence[str], *, inputs_only: bool) -> NodeSpec:
    """The player that begins once the estimator has discovered all inputs."""
    changes: dict[str, ParameterValue] = {"wait_for_subscribers": max(1, len(inputs))}
    if inputs_only:
        changes["topics"] = [*inputs]
    return replace(player, parameters={**player.parameters, **changes})


def _wait_for_the_rest(graph: LiveGraph, content: BagContent) -> None:
    """Wait for poses of the end of the bag, and for the diagnostics after it."""
    sent = sum(map(len, content.arrival_ns.values()))
    recorder, last_ns = graph.recorder, content.end_ns - round(EstimatorParameters().tick_period_s * 1e9)
    graph.wait_for(
        lambda: read_poses(recorder.raw[-1]).stamp_ns > last_ns,
        "publish poses of the bag's end",
        _END_PATIENCE_S,
        needed=[ESTIMATOR],
    )
    inputs_at: dict[int, int] = {}  # number of diagnostics -> inputs received by then

    def has_all() -> bool:
        """Whether all inputs are received, or none has been received since the previous diagnostics."""
        inputs_at[recorder.diagnostics] = recorder.inputs
        return recorder.inputs in (sent, inputs_at.get(recorder.diagnostics - 1))

    graph.wait_for(has_all, "publish diagnostics", _END_PATIENCE_S, needed=[ESTIMATOR])


_EQUAL_M = 1e-6


@dataclass(frozen=True)
class Agreement:
    """Live poses compared with those of a replay at the same stamps.

    The live estimator lacks inputs that are still in transport when it gives a pose: those of up to a step of
    the player's clock, and more on a busy machine.
    """

    replayed: ReplayResult  # The replay
    distance_m: FloatArray  # (T, N) between the positions; NaN if neither is located, infinite if one is not

    @property
    def equal_share(self) -> float:
        """Share of the poses whose positions differ by less than a micrometre."""
        return float(np.mean(self.distance_m[~np.isnan(self.distance_m)] < _EQUAL_M))

    @property
    def rms_m(self) -> float:
        """Root mean square distance where both are located [m]."""
        return float(np.sqrt(np.mean(self.distance_m[np.isfinite(self.distance_m)] ** 2)))


def compare_with_replay(live: LiveRun, bag: Path, settings: Settings | None = None) -> Agreement:
    """Replay a bag at the stamps of live poses, with the settings of the live estimator."""
    replayed = replay(bag, live.result.swarm, settings, stamp_ns=live.result.stamp_ns)
    difference = live.result.poses - replayed.poses
    located = np.isfinite(live.result.poses).all(axis=2)
    one_only = located != np.isfinite(replayed.poses).all(axis=2)
    distance = np.where(one_only, np.inf, np.hypot(difference[..., 0], difference[..., 1]))
    return Agreement(replayed, distance)
