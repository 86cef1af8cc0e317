"""A bag played into the live graph over DDS, and what comes out on its topics.

The graph is the one that `graph` and the launch file start, in processes of their own. It gets a ROS domain
that no other has, and stays on this machine: nothing of it mixes with robots that are about.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rclpy
from domain_coordinator import domain_id
from numpy.typing import NDArray
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from typing_extensions import Self

from swarm_loc_estimator.core.metrics import Track
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.graph import GraphOptions, NodeSpec, graph_nodes
from swarm_loc_estimator.io.bags import BagReader
from swarm_loc_estimator.io.ingest import input_topics
from swarm_loc_estimator.io.swarm_file import load_swarm
from swarm_loc_estimator.io.truth import TruthReader
from swarm_loc_estimator.nodes.estimator_parameters import EstimatorParameters
from swarm_loc_estimator.nodes.recorder import Recorder, read_poses
from swarm_loc_estimator.processes import Child, node_command, start, stop
from swarm_loc_estimator.replay_result import ReplayResult

ESTIMATOR, PLAYER = "estimator", "player"
_ALONE = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": ""}
_WAKE_S = 0.05
_START_PATIENCE_S = 600.0
"""An estimator that must be compiled first takes a minute, and several where others are at work, too."""
_SILENCE_PATIENCE_S = 30.0
_END_PATIENCE_S = 10.0


class LiveError(Exception):
    """The live graph did not do what it should; the text is one sentence."""


@dataclass(frozen=True)
class LiveRun:
    """What came out of a live graph.

    Attributes:
        result: Poses as received, ground truth of the bag, what the estimator dropped.
        arrival_ns: (M,) increasing, when the messages for the estimator had arrived in the bag; the player
            has published all of them.
        rate: Speed at which the bag was played.
        status: (T, N) of `SwarmPose.status`.
        received: Those that the estimator took in.
        estimator_core: CPU time of the estimator's process per second while the bag played.
        age_s: (A,) time of reception minus stamp of poses, in the bag's time, of those that came when it was
            known here.
    """

    result: ReplayResult
    arrival_ns: NDArray[np.int64]
    rate: float
    status: NDArray[np.uint8]
    received: int
    estimator_core: float
    age_s: FloatArray

    @property
    def sent(self) -> int:
        """Messages for the estimator that were published."""
        return len(self.arrival_ns)

    @property
    def lost(self) -> int:
        """Messages that went missing on the way."""
        return self.sent - self.received


@dataclass(frozen=True)
class BagContent:
    """What is known of a bag before it is played.

    Attributes:
        begin_ns: First log time.
        end_ns: Last one.
        arrival_ns: (M,) increasing, log times of the messages for the estimator.
        truth: Robot name -> ground truth.
        remarks: What could not be read, one sentence each.
    """

    begin_ns: int
    end_ns: int
    arrival_ns: NDArray[np.int64]
    truth: Mapping[str, Track]
    remarks: tuple[str, ...]


Watch = Callable[[Recorder, BagContent], None]


def read_bag(bag: Path, swarm: Swarm) -> BagContent:
    """Read what evaluation needs of a bag.

    Raises:
        BagError: Nothing in the bag can be read.
    """
    truth, inputs = TruthReader(swarm), [topic.name for topic in input_topics(swarm)]
    arrivals = [np.zeros(0, dtype=np.int64)]
    with BagReader(bag) as reader:
        begin_ns, end_ns = reader.time_range_ns
        for batch in reader.batches([*truth.topics, *inputs]):
            is_truth = batch.topic < len(truth.topics)
            truth.add(batch.chosen(is_truth))
            arrivals.append(batch.log_ns[~is_truth])
        tracks = truth.tracks()
        remarks = (*reader.losses, *truth.remarks())
    return BagContent(begin_ns, end_ns, np.concatenate(arrivals), tracks, remarks)


class LiveGraph:
    """A graph that runs as child processes while this process listens; use it as a context manager.

    Args:
        options: The graph.
        log: File that the nodes' own output goes to.

    Attributes:
        recorder: What came out so far.

    Raises:
        LiveError: The estimator does not start.
    """

    recorder: Recorder

    def __init__(self, options: GraphOptions, log: Path) -> None:
        self._nodes = {node.name: node for node in graph_nodes(options)}
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
        """The process of a node."""
        return self._children[name].process

    def restart(self, name: str) -> None:
        """Kill a node and start it anew."""
        self.process(name).kill()
        self.process(name).wait()
        self._start(self._nodes[name])

    def wait_for(
        self,
        condition: Callable[[], bool],
        what: str,
        patience_s: float,
        needed: Collection[str] = (ESTIMATOR, PLAYER),
    ) -> None:
        """Listen until a condition holds.

        Args:
            condition: Of what was recorded; looked at after each event and now and then.
            what: The condition in words, to follow "did not".
            patience_s: How long nothing may come before that is an error.
            needed: Nodes that must go on meanwhile.

        Raises:
            LiveError: A node has ended, or patience has.
        """
        heard, since_s = -1, time.monotonic()
        while not condition():
            for name in needed:
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
        """Start the player last, when this process hears the estimator: no pose is missed."""
        for name, node in self._nodes.items():
            if name == PLAYER:
                self.wait_for(
                    lambda: self.recorder.count_publishers("swarm/poses") > 0,
                    "announce its poses",
                    _START_PATIENCE_S,
                    needed=[ESTIMATOR],
                )
            self._start(node)

    @property
    def _see(self) -> str:
        """Where to look, with what stands there last."""
        said = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return f" its nodes' output is in {self._log}" + (f", at last: {said[-1]}" if said else ".")

    def _start(self, node: NodeSpec) -> None:
        self._children[node.name] = Child(node, start(node_command(node), self._output))

    def _stop(self) -> None:
        stop(list(self._children.values()), self._note)

    def _note(self, line: str) -> None:
        self._output.write(f"{line}\n".encode())


def play_live(
    bag: Path,
    swarm_file: Path,
    *,
    log: Path,
    rate: float = 1.0,
    parameter_file: Path | None = None,
    watch: Watch = lambda _recorder, _content: None,
) -> LiveRun:
    """Play a whole bag into a live graph and collect the poses that come out.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file.
        swarm_file: Description of the swarm in it.
        log: File for the nodes' output.
        rate: Speed, 1 for real time.
        parameter_file: ROS parameter file for the nodes.
        watch: Called about once per event while the bag plays, to show progress.

    Raises:
        LiveError: The graph did not play to the end.
        GraphError: An executable is missing.
        BagError: Nothing in the bag can be read.
        SwarmFileError: The description cannot be used.
    """
    swarm = load_swarm(swarm_file)
    content = read_bag(bag, swarm)
    parameters = None if parameter_file is None else str(parameter_file)
    options = GraphOptions(str(swarm_file), bag=str(bag), rate=rate, parameter_file=parameters)
    with LiveGraph(options, log) as graph:
        recorder, estimator, player = graph.recorder, graph.process(ESTIMATOR), graph.process(PLAYER)

        def has_ended() -> bool:
            watch(recorder, content)
            return player.poll() is not None

        graph.wait_for(lambda: bool(recorder.raw), "publish poses", _START_PATIENCE_S)
        cpu_s, wall_s = cpu_seconds(estimator.pid), time.monotonic()
        graph.wait_for(has_ended, "go on publishing poses", _SILENCE_PATIENCE_S, needed=[ESTIMATOR])
        played_s = time.monotonic() - wall_s
        core = (cpu_seconds(estimator.pid) - cpu_s) / played_s
        if player.returncode:
            raise LiveError(f"The player ended with status {player.returncode}; see {log}.")
        _wait_for_the_rest(graph, len(content.arrival_ns), content.end_ns)
    poses = [read_poses(data) for data in recorder.raw]
    result = ReplayResult(
        title=f"{bag.name}, live at {rate:g} x",
        swarm=swarm,
        stamp_ns=np.array([one.stamp_ns for one in poses], dtype=np.int64),
        pose=np.array([one.pose for one in poses]),
        covariance=np.array([one.covariance for one in poses]),
        truth=content.truth,
        counters=dict(recorder.drops),
        remarks=content.remarks,
        data_s=(content.end_ns - content.begin_ns) * 1e-9,
        wall_s=played_s,
    )
    status = np.array([one.status for one in poses])
    age_s = _ages(np.array(recorder.received_ns, dtype=np.int64), result.stamp_ns)
    return LiveRun(result, content.arrival_ns, rate, status, recorder.inputs, core, age_s)


def _ages(received_ns: NDArray[np.int64], stamp_ns: NDArray[np.int64]) -> FloatArray:
    """Ages of poses at reception [s], where that time is known; before the first /clock it is zero."""
    known = received_ns > 0
    return (received_ns - stamp_ns)[known].astype(np.float64) * 1e-9


def cpu_seconds(pid: int) -> float:
    """CPU time that a process has used [s]."""
    fields = Path("/proc", str(pid), "stat").read_text(encoding="ascii").rpartition(")")[2].split()
    user_and_system = int(fields[11]) + int(fields[12])
    return user_and_system / os.sysconf("SC_CLK_TCK")


@contextmanager
def _own_domain() -> Iterator[None]:
    """Give this process and its children a ROS domain of their own on this machine."""
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
        reservation.__exit__(None, None, None)  # an error handed in would be taken for a domain in use


def _wait_for_the_rest(graph: LiveGraph, sent: int, end_ns: int) -> None:
    """Wait for poses of the bag's end, and for what the estimator then says of its inputs."""
    recorder, last_ns = graph.recorder, end_ns - round(EstimatorParameters().tick_period_s * 1e9)
    graph.wait_for(
        lambda: read_poses(recorder.raw[-1]).stamp_ns > last_ns,
        "publish poses of the bag's end",
        _END_PATIENCE_S,
        needed=[ESTIMATOR],
    )
    told: dict[int, int] = {}  # how many inputs by the n-th diagnostics

    def has_all() -> bool:
        """Whether everything has been taken in, or no more is."""
        told[recorder.diagnostics] = recorder.inputs
        before = told.get(recorder.diagnostics - 1)
        return recorder.inputs in (sent, before)

    graph.wait_for(
        has_all,
        "publish diagnostics",
        _END_PATIENCE_S,
        needed=[ESTIMATOR],
    )
