"""Fusion periods: what belongs to one, and when those of large and of small swarms are fused."""

from dataclasses import replace

import numpy as np
import pytest
from core_messages import SECOND, T0
from core_run import on_time, play, ticks
from core_world import Plan, simulate
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.filter.measurements import Measurements
from swarm_loc_estimator.filter.models import CARTESIAN
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.sensors.fix import about_robots
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings
from swarm_loc_estimator.timeline.timeline import Timeline, end_of_period, middle_of_period

PERIOD_NS = SECOND // 5
SMALLEST_LARGE = Policy().delay_from


@given(st.integers(0, 2**62), st.integers(1, 10**10))
def test_a_period_holds_its_last_instant_and_not_its_first(stamp_ns: int, period_ns: int) -> None:
    end_ns = end_of_period(stamp_ns, period_ns)
    assert end_ns % period_ns == 0
    assert end_ns - period_ns < stamp_ns <= end_ns
    assert end_of_period(end_ns, period_ns) == end_ns
    assert end_of_period(end_ns + 1, period_ns) == end_ns + period_ns
    assert end_of_period(np.array([stamp_ns, end_ns + 1]), period_ns).tolist() == [end_ns, end_ns + period_ns]
    assert middle_of_period(stamp_ns, period_ns) == end_ns - period_ns + period_ns // 2


class Fused:
    """A timeline that keeps the stamps of what it fuses, and with them when it did."""

    def __init__(self, robots: int, delay_s: float = 0.0) -> None:
        self.stamp_ns: list[int] = []
        self.at_ns: list[int] = []
        self._now_ns = 0
        state = SwarmState(ParameterTable.of(([Robot(f"robot{k}") for k in range(robots)]), ()))
        chosen = Settings(fusion_period_s=1e-9 * PERIOD_NS, fusion_delay_s=delay_s)
        self.timeline = Timeline(chosen, self._step, state, 0)

    def advance(self, now_ns: int) -> None:
        """Fuse what is due."""
        self._now_ns = now_ns
        self.timeline.advance(now_ns)

    def _step(self, _state: SwarmState, rows: Measurements, *_: object) -> None:
        assert np.unique(end_of_period(rows.stamp_ns, PERIOD_NS)).size == 1
        self.stamp_ns.extend(rows.stamp_ns.tolist())
        self.at_ns.extend(rows.size * [self._now_ns])


@given(
    st.sampled_from([1, SMALLEST_LARGE]),
    st.sets(st.integers(1, PERIOD_NS - 1), max_size=9),
    st.sets(st.integers(1, 9)),
)
def test_what_is_not_late_is_fused_once(robots: int, offsets_ns: set[int], resting: set[int]) -> None:
    """Also what is measured at the very instants of fusing, whichever of these there are."""
    fused = Fused(robots)
    stamp_ns = np.add.outer(T0 + PERIOD_NS * np.arange(10), [*sorted(offsets_ns), PERIOD_NS])
    for k, measured_ns in enumerate(stamp_ns, 1):
        fused.timeline.add(fixes(measured_ns))
        if k not in resting:
            fused.advance(int(measured_ns[-1]))
    assert fused.stamp_ns == stamp_ns.ravel().tolist()


@given(
    st.lists(
        st.tuples(st.integers(0, 10 * PERIOD_NS), st.integers(0, PERIOD_NS)),
        min_size=1,
        max_size=40,
        unique_by=lambda pair: pair[0],
    ),
    st.integers(1, 3),
)
def test_a_large_swarm_s_periods_wait_for_what_comes_late(
    measured: list[tuple[int, int]], ticks: int
) -> None:
    """All that comes within the delay is fused once, and not before it is over."""
    fused, delay_ns = Fused(SMALLEST_LARGE, 1e-9 * PERIOD_NS), PERIOD_NS
    arrivals = sorted((T0 + offset_ns + late_ns, T0 + offset_ns) for offset_ns, late_ns in measured)
    for now_ns in range(T0, T0 + 13 * PERIOD_NS, PERIOD_NS // ticks):
        while arrivals and arrivals[0][0] <= now_ns:
            fused.timeline.add(fixes(np.array([arrivals.pop(0)[1]])))
        fused.advance(now_ns)
    assert fused.stamp_ns == sorted(T0 + offset_ns for offset_ns, _ in measured)
    waited_ns = np.array(fused.at_ns) - end_of_period(np.array(fused.stamp_ns), PERIOD_NS)
    assert np.all((waited_ns >= delay_ns) & (waited_ns < delay_ns + PERIOD_NS // ticks + ticks))


def test_a_small_swarm_does_not_wait() -> None:
    fused = Fused(SMALLEST_LARGE - 1, 1.0)
    fused.timeline.add(fixes(np.array([T0 + 1])))
    fused.advance(T0 + 1)
    assert fused.stamp_ns == [T0 + 1]


def test_odometry_is_kept_for_what_waits_beyond_the_horizon() -> None:
    world = simulate(Plan(4, 18.0, 0.2), seed=3)
    robots = tuple(replace(one, odometry=replace(one.odometry, timeout_s=0.1)) for one in world.swarm.robots)
    world = replace(world, swarm=replace(world.swarm, robots=robots))
    chosen = Settings(fusion_period_s=1.0, fusion_delay_s=1.0, horizon_s=0.05)
    at_ns = ticks(T0, T0 + 20 * SECOND)
    at_once = Estimator(world.swarm, chosen)
    expected = play(at_once, on_time(world), at_ns)[-1]
    waiting = Estimator(world.swarm, replace(chosen, policy=Policy(delay_from=4)))
    found = play(waiting, on_time(world), at_ns)[-1]
    assert waiting.used == at_once.used > 100
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-9)
    np.testing.assert_allclose(found.covariances, expected.covariances, atol=1e-9)


def fixes(stamp_ns: IntArray) -> Measurements:
    return about_robots(
        0, stamp_ns, np.zeros((stamp_ns.size, 3)), np.tile(np.eye(3), (stamp_ns.size, 1, 1)), CARTESIAN
    )


@pytest.mark.parametrize(
    ("calibrated", "given_s", "period_s"),
    [(0, -1.0, 0.2), (249, -1.0, 0.2), (250, -1.0, 0.4), (600, -1.0, 0.5), (600, 0.2, 0.2), (600, 0.0, 0.0)],
)
def test_many_calibrated_robots_have_longer_periods_unless_one_is_given(
    calibrated: int, given_s: float, period_s: float
) -> None:
    kinds = [OdometryModel(distance_scale_sigma=0.03)] * calibrated + [OdometryModel()] * (700 - calibrated)
    swarm = Swarm(tuple(Robot(f"r{k}", odometry=kind) for k, kind in enumerate(kinds)), ())
    estimator = Estimator(swarm, Settings(fusion_period_s=given_s))
    assert estimator.settings.fusion_period_s == period_s
