"""Fusing that is spread over many ticks, while time goes on."""

import numpy as np
import pytest
from core_messages import SECOND, T0
from core_run import play, ticks
from core_world import Plan, simulate

from swarm_loc_estimator.filter.measurements import Measurements
from swarm_loc_estimator.filter.models import CARTESIAN
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.sensors.fix import about_robots
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.swarm import Robot
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.settings import Settings
from swarm_loc_estimator.timeline.timeline import Timeline

PERIOD_NS = SECOND // 5


def test_what_is_to_be_fused_again_is_not_forgotten_while_fusing_takes_several_ticks() -> None:
    """Odometry changes what was measured, and until fusing ends this has grown too old."""
    stepped: list[int] = []

    def step(_state: SwarmState, rows: Measurements, *_: object) -> None:
        stepped.extend(rows.stamp_ns.tolist())

    state = SwarmState(ParameterTable.of((Robot("a"),), ()))
    timeline = Timeline(Settings(fusion_period_s=1e-9 * PERIOD_NS, horizon_s=1.0), step, state, 0)
    stamp_ns = T0 + PERIOD_NS * np.arange(1, 6, dtype=np.int64)
    every = np.tile(np.eye(3), (stamp_ns.size, 1, 1))
    timeline.add(about_robots(0, stamp_ns, np.zeros((stamp_ns.size, 3)), every, CARTESIAN))
    timeline.advance(int(stamp_ns[-1]), lambda: False)
    assert stepped == [stamp_ns[0]]
    timeline.invalidate(np.array([T0]))
    for k in range(10):
        timeline.advance(int(stamp_ns[-1]) + k * SECOND, lambda: False)
    assert not timeline.is_busy
    assert stepped == 2 * stamp_ns.tolist()


@pytest.mark.parametrize("sparse", [False, True])
def test_odometry_is_there_for_all_that_is_left_to_fuse_however_long_that_takes(sparse: bool) -> None:
    """Longer than odometry is kept otherwise."""
    world, begin_ns = simulate(Plan(4, 18.0, 0.3), seed=1), T0 + 6 * SECOND
    chosen = Settings(fusion_period_s=0.05, sparse_from=2 if sparse else 250)
    sightings = [event for event in world.events if event.pose is None and event.stamp_ns <= begin_ns]
    late_ns = begin_ns - round(chosen.horizon_s * 1e9)
    arrivals = [(event.stamp_ns, event) for event in world.events if event.pose is not None]
    arrivals += [(one.stamp_ns if one.stamp_ns < late_ns else begin_ns, one) for one in sightings]
    before, after = ticks(T0, begin_ns - 1, 0.25), ticks(begin_ns, T0 + 18 * SECOND, 0.25)

    def run(*, at_once: bool) -> tuple[Estimator, Estimate]:
        estimator = Estimator(world.swarm, chosen)
        play(estimator, [one for one in arrivals if one[0] < begin_ns], before)
        left = [one for one in arrivals if one[0] >= begin_ns]
        return estimator, play(estimator, left, after, has_budget=lambda: at_once)[-1]

    (whole, at_once), (in_parts, last) = run(at_once=True), run(at_once=False)
    assert not in_parts.is_fusing
    assert in_parts.drops == whole.drops
    np.testing.assert_allclose(last.poses, at_once.poses, atol=1e-9)
    np.testing.assert_allclose(last.covariances, at_once.covariances, atol=1e-9)
