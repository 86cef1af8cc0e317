"""Everything at once over DDS: images, firmware, drivers, detectors and estimator give true poses."""

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
from swarm_loc_msgs.msg import MarkerDetectionArray

PATIENCE_S = 100.0
# No data are too old, however long a busy machine stands still
PARAMETERS = (
    "epuck_world: {ros__parameters: {width: 640, height: 480}}\n"
    "estimator: {ros__parameters: {horizon_s: 20.0}}\n"
)


@pytest.mark.timeout(300)  # the renderer may have to be compiled first
def test_robots_are_located_by_what_their_cameras_see(tmp_path: Path) -> None:
    eight = Lemniscate(HALF_WIDTH)
    start, _ = eight.at(np.array([0.0, 0.5 * eight.length]))
    swarm = describe(EightSettings(robots=2), start)
    save_swarm(swarm, tmp_path / "swarm.yaml")
    (tmp_path / "parameters.yaml").write_text(PARAMETERS, encoding="utf-8")
    (tmp_path / "links").mkdir()
    options = SimulationOptions(
        str(tmp_path / "swarm.yaml"), world="w0", parameter_file=str(tmp_path / "parameters.yaml")
    )
    nodes = graph_of(options, swarm, str(tmp_path / "links"))
    truth: dict[int, np.ndarray[tuple[int], np.dtype[np.float64]]] = {}
    seen: list[MarkerDetectionArray] = []

    def on_truth(message: PoseStamped) -> None:
        truth[stamp_ns(message)] = np.array([message.pose.position.x, message.pose.position.y])

    with LiveGraph(nodes, tmp_path / "nodes.log") as graph:
        recorder = graph.recorder
        recorder.create_subscription(PoseStamped, "epuck1/ground_truth", on_truth, 1000)
        recorder.create_subscription(MarkerDetectionArray, "epuck1/detections", seen.append, 1000)

        def has_driven() -> bool:
            return bool(truth) and float(np.linalg.norm(next(reversed(truth.values())) - start[0, :2])) > 0.1

        graph.wait_for(has_driven, "drive", PATIENCE_S)
        driven_ns = max(truth)

        def tracked() -> list[EstimateMessage]:
            """Poses from then on at which all robots are tracked, and where the truth is known."""
            newest_ns = next(reversed(truth))
            return [
                one
                for one in recorder.poses()
                if driven_ns <= one.stamp_ns <= newest_ns and (one.status == Status.TRACKED).all()
            ]

        graph.wait_for(lambda: len(tracked()) >= 20, "be located", PATIENCE_S)
        located = tracked()[-20:]
    stamps, places = np.array(list(truth)), np.array(list(truth.values()))
    errors = [
        np.hypot(*(one.pose[0, axis] - np.interp(one.stamp_ns, stamps, places[:, axis]) for axis in (0, 1)))
        for one in located
    ]
    assert np.median(errors) < 0.02
    assert sum(len(array.detections) for array in seen) > len(seen)
    log = (tmp_path / "nodes.log").read_text(encoding="utf-8")
    assert "dropped" not in log
    assert "simulated time continues without" not in log
