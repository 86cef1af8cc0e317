"""The live graph: what comes out over DDS is what replay gives, also after the estimator was killed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from node_world import T0_NS, Ros
from rclpy.time import Time

from bench.shared.bags import copy_part
from swarm_loc_estimator.cli.demo import main
from swarm_loc_estimator.common.arrays import BoolArray
from swarm_loc_estimator.common.launch import GraphOptions, graph_nodes
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.offline.live_run import (
    ESTIMATOR,
    LiveError,
    LiveGraph,
    LiveRun,
    Recorder,
    compare_with_replay,
    play_live,
    read_content,
)
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Status
from swarm_loc_estimator.timeline.settings import Settings

DEMO = Path(__file__).parents[3] / "bags" / "eight_five_robots"
SWARM_FILE = DEMO / "swarm.yaml"
PATIENCE_S = 60.0
INPUTS = 400  # Of all robots in three seconds of the bag
POSES = 40  # Of two seconds


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags") / "short"
    copy_part(DEMO, folder, 10.0)
    return folder


def settled(live: LiveRun) -> BoolArray:
    """(T,) whether the poses include exactly the inputs that had arrived by their stamp, as far as known.

    There the poses must be equal to those of a replay.
    """
    stamp_ns = live.result.stamp_ns
    counted_ns = np.array(sorted(live.taken), dtype=np.int64)
    before = np.searchsorted(counted_ns, stamp_ns, side="right")
    after = np.searchsorted(counted_ns, stamp_ns, side="left") + 1
    same = np.ones(stamp_ns.size, dtype=bool)
    for topic, arrival_ns in live.arrival_ns.items():
        # the messages of a topic come in order: equal counts mean equal messages
        taken = np.array([0, *(live.taken[at].get(topic, 0) for at in counted_ns.tolist()), arrival_ns.size])
        arrived = np.searchsorted(arrival_ns, stamp_ns, side="right")
        same &= (taken[before] == arrived) & (taken[after] == arrived)
    return same


def test_live_poses_are_those_of_replay(bag: Path, tmp_path: Path) -> None:
    settings = Settings(horizon_s=11.0)  # longer than the bag
    # however slow the machine, every tick fuses and nothing is too old
    patient = {"estimator": {"ros__parameters": {"fusion_load": 1.0, "horizon_s": settings.horizon_s}}}
    (tmp_path / "parameters.yaml").write_text(json.dumps(patient), encoding="utf-8")
    parameters = str(tmp_path / "parameters.yaml")
    options = GraphOptions(str(SWARM_FILE), bag=str(bag), parameter_file=parameters)
    live = play_live(options, log=tmp_path / "nodes.log")

    assert live.received == live.sent > 1000
    compared = compare_with_replay(live, bag, settings)
    same = settled(live)
    assert same[-1]
    assert np.nanmax(compared.distance_m[same]) < 1e-6
    turn = wrap_angle(live.result.poses[same, :, 2] - compared.replayed.poses[same, :, 2])
    assert np.nanmax(np.abs(turn)) < 1e-6
    assert np.nanmedian(compared.distance_m) < 1e-3

    lacking = {at: {topic: count - 1 for topic, count in taken.items()} for at, taken in live.taken.items()}
    assert not settled(replace(live, taken=lacking)).any()


def test_the_recorder_counts_inputs_by_the_estimators_diagnostics_alone(ros: Ros) -> None:
    recorder = ros.add(Recorder())
    own = [
        DiagnosticStatus(name="estimator: alpha", values=[KeyValue(key="odom received", value="7")]),
        DiagnosticStatus(
            name="estimator",
            values=[
                KeyValue(key="aerial/detections received", value="2"),
                KeyValue(key="dropped: too_old", value="3"),
            ],
        ),
    ]
    message = DiagnosticArray(status=own)
    message.header.stamp = Time(nanoseconds=T0_NS).to_msg()
    recorder._on_diagnostics(message)
    recorder._on_diagnostics(DiagnosticArray(status=[DiagnosticStatus(name="watch")]))

    assert recorder.taken == {T0_NS: {"alpha/odom": 7, "aerial/detections": 2}}
    assert (recorder.inputs, recorder.drops, recorder.diagnostics) == (9, {"too_old": 3}, 1)


def test_poses_come_back_after_the_estimator_was_killed(tmp_path: Path) -> None:
    swarm = load_swarm(SWARM_FILE)
    content = read_content(DEMO, swarm)
    options = GraphOptions(str(SWARM_FILE), bag=str(DEMO), rate=0.5)
    with LiveGraph(graph_nodes(options), tmp_path / "nodes.log") as graph:
        recorder = graph.recorder
        graph.wait_for(lambda: recorder.inputs > INPUTS, "take in the bag", PATIENCE_S)
        graph.restart(ESTIMATOR)
        # poses of the killed one may still come, but its counts do not restart
        graph.wait_for(lambda: recorder.inputs < INPUTS, "restart", PATIENCE_S)
        before = len(recorder.raw)

        def tracked_for_a_while() -> bool:
            lately = recorder.poses()[before:][-POSES:]
            return len(lately) == POSES and all((one.status == Status.TRACKED).all() for one in lately)

        graph.wait_for(tracked_for_a_while, "track all robots again", PATIENCE_S)
        last = recorder.poses()[-1]

    for robot, pose in zip(swarm.robots, last.pose, strict=True):
        truth, _ = interpolate(content.truth[robot.name], np.array([last.stamp_ns]), 200_000_000)
        assert np.hypot(*(pose - truth[0])[:2]) < 0.05, robot.name


def test_a_graph_that_fails_says_so(bag: Path, tmp_path: Path) -> None:
    options = GraphOptions(str(tmp_path / "missing.yaml"), bag=str(bag))
    graph = LiveGraph(graph_nodes(options), tmp_path / "nodes.log")
    with pytest.raises(LiveError, match=r"Node estimator has ended, status 1;.*missing\.yaml"), graph:
        pytest.fail("the graph started without a swarm description")
    assert graph.process(ESTIMATOR).returncode == 1


def test_what_the_demo_cannot_use_is_said_in_a_sentence(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "nope")]) == 1
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit):
        main([str(bag), "--out", str(tmp_path / "file" / "out")])
    first, *_, last = capsys.readouterr().err.splitlines()
    assert first == f"There is no bag '{tmp_path / 'nope'}'."
    assert "cannot be written" in last
