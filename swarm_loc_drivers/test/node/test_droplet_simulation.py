"""`simulate` with Droplets over DDS: infrared alone locates those that nobody has seen."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from node_world import stamp_ns

from bench.scenarios.droplets_run import DropletRunSettings, describe_droplets
from swarm_loc_drivers.sim.scenarios.droplets import starts
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of, simulated_swarm
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.offline.live_run import LiveGraph
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_estimator.timeline.estimator import Status

ROBOTS, SEED, PATIENCE_S = 4, 2, 150.0
SURE_M = 0.005  # The first sighting of a neighbour tells 3 cm, more of them 3 mm
SETTINGS = DropletRunSettings(seed=SEED, robots=ROBOTS, start_known=True)


@pytest.mark.timeout(400)
def test_droplets_that_nobody_sees_are_located_by_infrared(tmp_path: Path) -> None:
    """A tracker sees the first and the last of four, no start is known, and the second one wanders."""
    there = starts(SETTINGS.seed, SETTINGS.robots)
    known, unknown = tmp_path / "swarm.yaml", tmp_path / "without_starts.yaml"
    save_swarm(describe_droplets(SETTINGS, there), known)
    save_swarm(describe_droplets(replace(SETTINGS, start_known=False), there), unknown)
    (tmp_path / "links").mkdir()
    options = SimulationOptions(str(known), seed=SEED, rate=2.0)
    estimator, *others = graph_of(options, simulated_swarm(options), str(tmp_path / "links"))
    estimator = replace(estimator, parameters={**estimator.parameters, "swarm_file": str(unknown)})
    truth: dict[int, np.ndarray[tuple[int], np.dtype[np.float64]]] = {}

    def on_truth(message: PoseStamped) -> None:
        place, turn = message.pose.position, message.pose.orientation
        truth[stamp_ns(message)] = np.array([place.x, place.y, 2.0 * np.arctan2(turn.z, turn.w)])

    with LiveGraph([estimator, *others], tmp_path / "nodes.log") as graph:
        recorder = graph.recorder
        recorder.create_subscription(PoseStamped, "droplet2/ground_truth", on_truth, 1000)

        def way() -> float:
            return float(np.ptp([pose[:2] for pose in truth.values()], axis=0).max()) if truth else 0.0

        graph.wait_for(lambda: way() > 0.01, "move", PATIENCE_S)
        moved_ns = max(truth)

        def located() -> list[tuple[np.ndarray[tuple[int], np.dtype[np.float64]], float]]:
            """Errors of the second robot's poses since then that are sure, and their uncertainty [m]."""
            found = []
            for one in recorder.poses():
                if one.stamp_ns >= moved_ns and one.stamp_ns in truth and one.status[1] == Status.TRACKED:
                    error = se2.between(truth[one.stamp_ns], one.pose[1])
                    found.append((np.array(error), float(np.sqrt(one.covariance[1, 0, 0]))))
            return [(error, sigma) for error, sigma in found if sigma < SURE_M]

        graph.wait_for(lambda: len(located()) >= 20, "be located", PATIENCE_S)
        errors = np.array([error for error, _ in located()[-20:]])
        sigmas = [sigma for _, sigma in located()[-20:]]
    assert np.median(np.hypot(errors[:, 0], errors[:, 1])) < 0.01
    assert np.median(np.abs(errors[:, 2])) < 0.15
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 3.0 * max(sigmas)
    log = (tmp_path / "nodes.log").read_text(encoding="utf-8")
    for trouble in ("cannot be opened", "may still be moving", "Traceback"):
        assert trouble not in log
