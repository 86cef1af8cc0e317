"""Run the estimator over a recording in memory; the poses are those of `replay`."""

from __future__ import annotations

from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.offline.runner import PeriodicSchedule, Runner
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Settings


def rerun(
    recording: Recording, swarm: Swarm, tick_s: float, settings: Settings | None = None
) -> ReplayResult:
    """Poses at every whole multiple of `tick_s`, each from what had arrived by then."""
    runner = Runner(Estimator(swarm, settings), PeriodicSchedule(round(tick_s * 1e9)))
    runner.take(recording.messages)
    runner.finish(recording.range_ns[1])
    return runner.result(recording.name, recording.range_ns, recording.truth, {})
