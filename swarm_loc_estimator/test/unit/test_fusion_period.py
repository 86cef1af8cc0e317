"""Fusion periods are closed at their end: what is measured when it is fused belongs to what ends then."""

from __future__ import annotations

import numpy as np
from core_messages import SECOND, T0
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.core.description.estimated_parameters import ParameterTable
from swarm_loc_estimator.core.description.settings import EstimatorSettings
from swarm_loc_estimator.core.description.swarm import Robot
from swarm_loc_estimator.core.estimation.fusion_period import end_of_period, middle_of_period
from swarm_loc_estimator.core.estimation.timeline import Timeline
from swarm_loc_estimator.core.filter.measurement_model import Kind, MeasurementArray
from swarm_loc_estimator.core.filter.state import SwarmState
from swarm_loc_estimator.core.inputs.validation import about_robots
from swarm_loc_estimator.numerics.arrays import IntArray

PERIOD_NS = SECOND // 5


@given(st.integers(0, 2**62), st.integers(1, 10**10))
def test_a_period_holds_its_last_instant_and_not_its_first(stamp_ns: int, period_ns: int) -> None:
    end_ns = end_of_period(stamp_ns, period_ns)
    assert end_ns % period_ns == 0
    assert end_ns - period_ns < stamp_ns <= end_ns
    assert end_of_period(end_ns, period_ns) == end_ns
    assert end_of_period(end_ns + 1, period_ns) == end_ns + period_ns
    assert end_of_period(np.array([stamp_ns, end_ns + 1]), period_ns).tolist() == [end_ns, end_ns + period_ns]
    assert middle_of_period(stamp_ns, period_ns) == end_ns - period_ns + period_ns // 2


@given(st.sets(st.integers(1, PERIOD_NS - 1), max_size=9), st.sets(st.integers(1, 9)))
def test_what_is_not_late_is_fused_once(offsets_ns: set[int], resting: set[int]) -> None:
    """Also what is measured at the very instants of fusing, whichever of these there are."""
    fused: list[int] = []

    def step(_state: SwarmState, rows: MeasurementArray, _verdicts: object, _nis: object) -> None:
        assert np.unique(end_of_period(rows["stamp_ns"], PERIOD_NS)).size == 1
        fused.extend(rows["stamp_ns"].tolist())

    state = SwarmState(ParameterTable.of((Robot("a"),), ()))
    timeline = Timeline(EstimatorSettings(fusion_period_s=1e-9 * PERIOD_NS), step, state, 0)
    stamp_ns = np.add.outer(T0 + PERIOD_NS * np.arange(10), [*sorted(offsets_ns), PERIOD_NS])
    for k, measured_ns in enumerate(stamp_ns, 1):
        timeline.add(fixes(measured_ns))
        if k not in resting:
            timeline.advance(int(measured_ns[-1]))
    assert fused == stamp_ns.ravel().tolist()


def fixes(stamp_ns: IntArray) -> MeasurementArray:
    return about_robots(
        0, stamp_ns, np.zeros((stamp_ns.size, 3)), np.tile(np.eye(3), (stamp_ns.size, 1, 1)), Kind.CARTESIAN
    )
