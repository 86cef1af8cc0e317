"""An estimator that starts after PushBots have begun to map: do the mapper's fixes locate them?"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.integrity.scoring import Estimated, Score, scored
from bench.pushbot.bag import PushbotBagSettings, write_pushbot_bag
from bench.shared.bags import copy_part, first_log_ns
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Status

LATE_START = "late_start_mapping"
_PLANS, _SLIPS = ("corridor", "office", "ring"), (0.01, 0.02, 0.04)
_DURATION_S, _LATE_S = 160.0, (10.0, 90.0)
_RIGHT_M = 0.3  # Distance from the truth that a mapper's first map may be off
_MAX_GAP_NS = 1_000_000_000


def run_late_start(seed: int, folder: Path) -> Score:
    """Write a run of two PushBots to a folder, and start the estimator late, by seed.

    The recovery is counted from the fix by which all robots have one.
    """
    whole, late = folder / "whole", folder / "late"
    plan, slip = _PLANS[seed % len(_PLANS)], _SLIPS[seed % len(_SLIPS)]
    write_pushbot_bag(PushbotBagSettings(seed, _DURATION_S, 2, plan, slip), whole, "")
    late_s = float(np.random.default_rng([seed, 5]).uniform(*_LATE_S))
    copy_part(whole, late, _DURATION_S, late_s)
    swarm = load_swarm(whole / "swarm.yaml")
    result = replay(late, swarm)
    truth, known = zip(
        *(interpolate(result.truth[one.name], result.stamp_ns, _MAX_GAP_NS) for one in swarm.robots),
        strict=True,
    )
    inside = np.all(known, axis=0)
    error = result.poses[inside] - np.stack(truth, axis=1)[inside]
    error[..., 2] = wrap_angle(error[..., 2])
    time_s = 1e-9 * (result.stamp_ns[inside] - result.stamp_ns[0])
    first_ns = max(first_log_ns(late, f"{one.name}/fix") for one in swarm.robots)
    tracked = result.status[inside] == Status.TRACKED
    estimated = Estimated(time_s, error, result.covariances[inside], tracked)
    return scored(estimated, 1e-9 * (first_ns - result.stamp_ns[0]), right_m=_RIGHT_M)
