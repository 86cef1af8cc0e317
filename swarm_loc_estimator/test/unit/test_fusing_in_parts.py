"""Fusing that is spread over many ticks, while time goes on."""

from __future__ import annotations

import numpy as np
import pytest
from core_messages import SECOND, T0
from core_run import play, ticks
from core_world import Plan, simulate

from swarm_loc_estimator.core.description.settings import EstimatorSettings
from swarm_loc_estimator.core.estimation.estimator import SwarmEstimate, SwarmEstimator


@pytest.mark.parametrize("sparse", [False, True])
def test_odometry_is_there_for_all_that_is_left_to_fuse_however_long_that_takes(sparse: bool) -> None:
    """Longer than odometry is kept otherwise."""
    world, begin_ns = simulate(Plan(4, 18.0, 0.3), seed=1), T0 + 6 * SECOND
    chosen = EstimatorSettings(fusion_period_s=0.05, sparse_from=2 if sparse else 250)
    sightings = [event for event in world.events if event.pose is None and event.stamp_ns <= begin_ns]
    late_ns = begin_ns - round(chosen.horizon_s * 1e9)
    arrivals = [(event.stamp_ns, event) for event in world.events if event.pose is not None]
    arrivals += [(one.stamp_ns if one.stamp_ns < late_ns else begin_ns, one) for one in sightings]
    before, after = ticks(T0, begin_ns - 1, 0.25), ticks(begin_ns, T0 + 18 * SECOND, 0.25)

    def run(*, at_once: bool) -> tuple[SwarmEstimator, SwarmEstimate]:
        estimator = SwarmEstimator(world.swarm, chosen)
        play(estimator, [one for one in arrivals if one[0] < begin_ns], before)
        left = [one for one in arrivals if one[0] >= begin_ns]
        return estimator, play(estimator, left, after, go_on=lambda: at_once)[-1]

    (whole, at_once), (in_parts, last) = run(at_once=True), run(at_once=False)
    assert not in_parts.is_fusing
    assert in_parts.drops == whole.drops
    np.testing.assert_allclose(last.poses, at_once.poses, atol=1e-9)
    np.testing.assert_allclose(last.covariances, at_once.covariances, atol=1e-9)
