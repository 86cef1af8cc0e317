"""Play a bag into the live graph over DDS, record its poses, and compare them with those of a replay."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.launch import GraphOptions, NodeSpec, ParameterValue, graph_nodes
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.nodes.parameters import EstimatorParameters
from swarm_loc_estimator.offline.ground_truth import TruthReader
from swarm_loc_estimator.offline.live.graph import (
    START_PATIENCE_S,
    LiveError,
    LiveGraph,
    Recorder,
    cpu_seconds,
    read_poses,
    resident_mb,
)
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.registry import input_topics
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.settings import Settings

ESTIMATOR, PLAYER = "estimator", "player"
_SILENCE_PATIENCE_S = 30.0
_END_PATIENCE_S = 10.0


@dataclass(frozen=True)
class LiveRun:
    """Results of a run of the live graph."""

    result: ReplayResult  # Poses as received, ground truth of the bag, counts of dropped inputs
    # Topic of the estimator's inputs -> (M,) increasing log times of its messages in the bag, all of which
    # were published
    arrival_ns: Mapping[str, NDArray[np.int64]]
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
    arrival_ns: Mapping[str, NDArray[np.int64]]
    truth: Mapping[str, Trajectory]  # Robot name -> ground truth
    remarks: tuple[str, ...]  # What could not be read, one sentence each


Watch = Callable[[Recorder, BagContent], None]


def read_content(bag: Path, swarm: Swarm) -> BagContent:
    """Read ground truth and arrival times of a bag.

    Raises:
        BagError: Nothing in the bag can be read.
    """
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

    Args:
        options: Options of the graph, with the bag.
        log: File for the output of the nodes.
        inputs_only: Whether only inputs of the estimator are played.
        watch: Called about once per event while the bag plays.

    Raises:
        ValueError: The options have no bag.
        LiveError: The graph did not play to the end.
        GraphError: An executable is missing.
        BagError: Nothing in the bag can be read.
        SwarmFileError: The description cannot be used.
    """
    if options.bag is None:
        raise ValueError("there is no bag to play")
    bag, swarm = Path(options.bag), load_swarm(Path(options.swarm_file))
    content = read_content(bag, swarm)
    nodes = [
        _player_of(node, [*content.arrival_ns], inputs_only=inputs_only) if node.name == PLAYER else node
        for node in graph_nodes(options)
    ]
    begin_s = time.monotonic()
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
    result = replace(
        recorder.result(f"{bag.name}, live at {options.rate:g} x", swarm, content.truth),
        remarks=content.remarks,
        data_s=(content.end_ns - content.begin_ns) * 1e-9,
        wall_s=played_s,
    )
    received_ns = np.array(recorder.received_ns, dtype=np.int64)
    age_s: FloatArray = 1e-9 * (received_ns - result.stamp_ns)[received_ns > 0].astype(
        np.float64
    )  # 0 before the first /clock
    return LiveRun(
        result,
        content.arrival_ns,
        recorder.taken,
        options.rate,
        recorder.inputs,
        core,
        age_s,
        start_up_s,
        memory_mb,
    )


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
    the player's clock, and more on a busy machine. Only at settled stamps both have the same inputs; there
    the poses must be equal.
    """

    replayed: ReplayResult  # The replay
    distance_m: FloatArray  # (T, N) between the positions; NaN if neither is located, infinite if one is not
    turn_rad: FloatArray  # (T, N) absolute difference of the headings; NaN and infinite as above
    # (T,) whether the estimator had received exactly what had arrived by then in the bag
    settled: NDArray[np.bool_]

    @property
    def equal_share(self) -> float:
        """Share of the poses whose positions differ by less than a micrometre."""
        return float(np.mean(self.distance_m[~np.isnan(self.distance_m)] < _EQUAL_M))

    @property
    def rms_m(self) -> float:
        """Root mean square distance where both are located [m]."""
        return float(np.sqrt(np.mean(self.distance_m[np.isfinite(self.distance_m)] ** 2)))


def compare_with_replay(live: LiveRun, bag: Path, settings: Settings | None = None) -> Agreement:
    """Replay a bag at the stamps of live poses.

    Args:
        live: A run of the live graph.
        bag: The bag that it was played.
        settings: Of the live estimator.
    """
    replayed = replay(bag, live.result.swarm, settings, stamp_ns=live.result.stamp_ns)
    difference = live.result.poses - replayed.poses
    located = np.isfinite(live.result.poses).all(axis=2)
    one_only = located != np.isfinite(replayed.poses).all(axis=2)
    turn = np.where(one_only, np.inf, np.abs(se2.wrap_angle(difference[..., 2])))
    distance = np.where(one_only, np.inf, np.hypot(difference[..., 0], difference[..., 1]))
    return Agreement(replayed, distance, turn, _settled(live))


def _settled(live: LiveRun) -> NDArray[np.bool_]:
    """(T,) whether the poses include exactly the inputs that had arrived by their stamp, as far as known."""
    stamp_ns = live.result.stamp_ns
    counted_ns = np.array(sorted(live.taken), dtype=np.int64)
    before = np.searchsorted(counted_ns, stamp_ns, side="right")
    behind = np.searchsorted(counted_ns, stamp_ns, side="left") + 1
    settled = np.ones(stamp_ns.size, dtype=bool)
    for topic, arrival_ns in live.arrival_ns.items():
        # the messages of a topic come in order: equal counts mean equal messages
        taken = np.array([0, *(live.taken[at].get(topic, 0) for at in counted_ns.tolist()), arrival_ns.size])
        arrived = np.searchsorted(arrival_ns, stamp_ns, side="right")
        settled &= (taken[before] == arrived) & (taken[behind] == arrived)
    return settled
