"""Replay a bag: messages in order of arrival, and poses by the very code that runs live."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.offline.recorded_bag import Progress, read_bag, unwatched
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.offline.runner import ListedSchedule, PeriodicSchedule, Runner
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Settings

TICK_S = 0.1
"""Default time between two outputs [s]."""


def replay(
    bag: Path,
    swarm: Swarm,
    settings: Settings | None = None,
    *,
    tick_s: float = TICK_S,
    stamp_ns: npt.NDArray[np.int64] | None = None,
    keep_sightings: bool = False,
    progress: Progress = unwatched,
) -> ReplayResult:
    """Estimate all poses from a bag and compare them with the ground truth that it may hold.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file.
        swarm: Who is in it.
        settings: Of the estimator.
        tick_s: Time between two outputs [s].
        stamp_ns: (T,) increasing, when to give poses instead, such as when a live estimator gave them.
        keep_sightings: Whether what the robots see is kept, too, for people who watch the run.
        progress: Called now and then.

    Raises:
        BagError: Nothing in the bag can be read.
    """
    periodic = PeriodicSchedule(round(tick_s * 1e9))
    schedule = periodic if stamp_ns is None else ListedSchedule(stamp_ns)
    runner = Runner(Estimator(swarm, settings), schedule, keep_sightings=keep_sightings)
    summary = read_bag(bag, swarm, runner.take, progress)
    runner.finish(summary.range_ns[1])
    remarks = list(summary.remarks)
    if periodic.jumps:
        jumps = f"The log time jumps ahead by more than an hour, {periodic.jumps} x"
        remarks.append(f"{jumps}; no poses are given meanwhile.")
    result = runner.result(bag.name, summary.range_ns, summary.truth, summary.received, tuple(remarks))
    return replace(result, maps=summary.maps, goals=summary.goals)
