"""The live graph: what comes out over DDS is what replay gives, also after the estimator was killed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from swarm_loc_estimator.cli.demo import main
from swarm_loc_estimator.core.estimation.estimator import Status
from swarm_loc_estimator.io.bags.cut import copy_beginning
from swarm_loc_estimator.io.swarm.swarm_file import load_swarm
from swarm_loc_estimator.launching.graph import GraphOptions, graph_nodes
from swarm_loc_estimator.live.agreement import compare_with_replay
from swarm_loc_estimator.live.graph import LiveError, LiveGraph
from swarm_loc_estimator.live.recorder import read_poses
from swarm_loc_estimator.live.run import ESTIMATOR, PLAYER, play_live, read_bag
from swarm_loc_estimator.numerics.trajectory import interpolate

DEMO = Path(__file__).parents[3] / "bags" / "eight_five_robots"
SWARM_FILE = DEMO / "swarm.yaml"
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first seconds of the demo's bag."""
    folder = tmp_path_factory.mktemp("bags") / "short"
    copy_beginning(DEMO, folder, 10.0)
    return folder


def test_live_poses_are_those_of_replay(bag: Path, tmp_path: Path) -> None:
    every_tick = tmp_path / "parameters.yaml"  # fuses, however slow the machine
    every_tick.write_text("estimator:\n  ros__parameters:\n    fusion_load: 1.0\n", encoding="utf-8")
    options = GraphOptions(str(SWARM_FILE), bag=str(bag), parameter_file=str(every_tick))
    live = play_live(options, log=tmp_path / "nodes.log")

    assert live.received == live.sent > 1000
    compared = compare_with_replay(live, bag)
    assert compared.settled[-1]
    assert compared.settled_max_m < 1e-6
    assert np.nanmax(compared.turn_rad[compared.settled]) < 1e-6
    assert np.nanmedian(compared.distance_m) < 1e-3


def test_poses_come_back_after_the_estimator_was_killed(tmp_path: Path) -> None:
    swarm, bag = load_swarm(SWARM_FILE), tmp_path / "bag"
    copy_beginning(DEMO, bag, 7.0)
    content = read_bag(bag, swarm)
    options = GraphOptions(str(SWARM_FILE), bag=str(bag), rate=0.5)
    with LiveGraph(graph_nodes(options), tmp_path / "nodes.log") as graph:
        recorder = graph.recorder
        graph.wait_for(lambda: len(recorder.raw) > 20, "publish poses", PATIENCE_S)
        before = len(recorder.raw)
        graph.restart(ESTIMATOR)
        graph.wait_for(lambda: len(recorder.raw) > before + 5, "publish poses again", PATIENCE_S)
        ended = graph.process(PLAYER).poll
        graph.wait_for(lambda: ended() is not None, "play on", PATIENCE_S, needed=[ESTIMATOR])
        last = read_poses(recorder.raw[-1])

    assert (last.status == Status.TRACKED).all()
    for robot, pose in zip(swarm.robots, last.pose, strict=True):
        truth, _ = interpolate(
            content.truth[robot.name], np.array([min(last.stamp_ns, content.end_ns)]), 200_000_000
        )
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
