"""Everything at once over DDS: images, firmware, drivers, detectors and estimator give true poses."""

from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from node_world import stamp_ns

from bench.scenarios.eight_run import EightSettings, describe
from swarm_loc_drivers.sim.scenarios.eight import eight_starts
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.poses import EstimateMessage
from swarm_loc_estimator.offline.live_run import LiveGraph
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_estimator.timeline.estimator import Status
from swarm_loc_msgs.msg import MarkerDetectionArray

PATIENCE_S = 100.0
# No data are too old, however long a busy machine stands still
PARAMETERS = (
    "epuck_world: {ros__parameters: {width: 640, height: 480, aerial_width: 640, aerial_height: 480}}\n"
    "estimator: {ros__parameters: {horizon_s: 20.0}}\n"
)


@pytest.mark.timeout(300)  # the renderer may have to be compiled first
@pytest.mark.parametrize(("robots", "aerial"), [(2, False), (3, True)], ids=["own cameras", "camera above"])
def test_robots_are_located_by_cameras(tmp_path: Path, robots: int, *, aerial: bool) -> None:
    """The camera above cannot tell robots apart, and nobody knows where they begin."""
    swarm = describe(EightSettings(robots=robots), eight_starts(robots))
    save_swarm(swarm, tmp_path / "swarm.yaml")
    (tmp_path / "parameters.yaml").write_text(PARAMETERS, encoding="utf-8")
    (tmp_path / "links").mkdir()
    files = {name: str(tmp_path / f"{name}.yaml") for name in ("swarm", "parameters")}
    options = SimulationOptions(files["swarm"], world="w0", aerial=aerial, parameter_file=files["parameters"])
    truth: list[dict[int, tuple[float, float]]] = [{} for _ in range(robots)]
    seen: list[MarkerDetectionArray] = []

    with LiveGraph(graph_of(options, swarm, str(tmp_path / "links")), tmp_path / "nodes.log") as graph:
        recorder = graph.recorder
        recorder.create_subscription(MarkerDetectionArray, "epuck1/detections", seen.append, 1000)
        for name, places in zip([one.name for one in swarm.robots], truth, strict=True):

            def on_truth(message: PoseStamped, places: dict[int, tuple[float, float]] = places) -> None:
                places[stamp_ns(message)] = (message.pose.position.x, message.pose.position.y)

            recorder.create_subscription(PoseStamped, f"{name}/ground_truth", on_truth, 1000)

        def has_driven() -> bool:
            return all(truth) and bool(np.ptp([*truth[0].values()], axis=0).max() > 0.1)

        graph.wait_for(has_driven, "drive", PATIENCE_S)
        driven_ns = max(map(max, truth))

        def tracked() -> list[EstimateMessage]:
            """Poses from then on at which all robots are tracked, and where the truth is known."""
            newest_ns = min(map(max, truth))
            return [
                one
                for one in recorder.poses()
                if driven_ns <= one.stamp_ns <= newest_ns and (one.status == Status.TRACKED).all()
            ]

        graph.wait_for(lambda: len(tracked()) >= 20, "be located", PATIENCE_S)
        located = tracked()[-20:]

    def place(robot: int, at_ns: int) -> FloatArray:
        stamps, places = np.array([*truth[robot]]), np.array([*truth[robot].values()])
        return np.array([np.interp(at_ns, stamps, places[:, axis]) for axis in (0, 1)])

    errors = np.array(
        [
            [np.linalg.norm(one.pose[robot, :2] - place(robot, one.stamp_ns)) for robot in range(robots)]
            for one in located
        ]
    )
    assert np.median(errors, axis=0).max() < 0.02
    if aerial:
        assert errors[-10:].max() < 0.02
    else:
        assert sum(len(array.detections) for array in seen) > len(seen)
    log = (tmp_path / "nodes.log").read_text(encoding="utf-8")
    assert "dropped" not in log
    assert "simulated time continues without" not in log
