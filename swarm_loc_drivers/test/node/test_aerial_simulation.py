"""Everything over DDS under an overhead camera: robots of unknown start find themselves in its images."""

from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from node_world import stamp_ns

from bench.scenarios.eight_run import EightSettings, describe
from swarm_loc_drivers.sim.scenarios.eight import HALF_WIDTH, Lemniscate
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of
from swarm_loc_estimator.common.messages.poses import EstimateMessage
from swarm_loc_estimator.offline.live_run import LiveGraph
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_estimator.timeline.estimator import Status

PATIENCE_S = 100.0
# No data are too old, however long a busy machine stands still
PARAMETERS = (
    "epuck_world: {ros__parameters: {aerial_width: 640, aerial_height: 480}}\n"
    "estimator: {ros__parameters: {horizon_s: 20.0}}\n"
)
ROBOTS = 3


@pytest.mark.timeout(300)  # the renderer may have to be compiled first
def test_robots_are_located_by_a_camera_that_cannot_tell_them_apart(tmp_path: Path) -> None:
    eight = Lemniscate(HALF_WIDTH)
    start, _ = eight.at(np.arange(ROBOTS) * eight.length / ROBOTS)
    swarm = describe(EightSettings(robots=ROBOTS), start)
    save_swarm(swarm, tmp_path / "swarm.yaml")
    (tmp_path / "parameters.yaml").write_text(PARAMETERS, encoding="utf-8")
    (tmp_path / "links").mkdir()
    options = SimulationOptions(
        str(tmp_path / "swarm.yaml"),
        world="w0",
        aerial=True,
        parameter_file=str(tmp_path / "parameters.yaml"),
    )
    names = [robot.name for robot in swarm.robots]
    nodes = graph_of(options, swarm, str(tmp_path / "links"))
    truth: dict[str, dict[int, tuple[float, float]]] = {name: {} for name in names}

    with LiveGraph(nodes, tmp_path / "nodes.log") as graph:
        recorder = graph.recorder
        for name in names:

            def on_truth(message: PoseStamped, name: str = name) -> None:
                truth[name][stamp_ns(message)] = (message.pose.position.x, message.pose.position.y)

            recorder.create_subscription(PoseStamped, f"{name}/ground_truth", on_truth, 1000)

        def tracked() -> list[EstimateMessage]:
            """Poses at which all robots are tracked, and where the truth is known."""
            if not all(truth.values()):
                return []
            oldest_ns, newest_ns = (max(map(min, truth.values())), min(map(max, truth.values())))
            return [
                one
                for one in recorder.poses()
                if oldest_ns <= one.stamp_ns <= newest_ns and (one.status == Status.TRACKED).all()
            ]

        graph.wait_for(lambda: len(tracked()) >= 20, "be located", PATIENCE_S)
        located = tracked()[-10:]
    for one in located:
        for robot, name in enumerate(names):
            stamps = np.array(list(truth[name]))
            places = np.array(list(truth[name].values()))
            true = [np.interp(one.stamp_ns, stamps, places[:, axis]) for axis in (0, 1)]
            assert np.hypot(*(one.pose[robot, :2] - true)) < 0.02
    log = (tmp_path / "nodes.log").read_text(encoding="utf-8")
    assert "dropped" not in log
    assert "simulated time continues without" not in log
