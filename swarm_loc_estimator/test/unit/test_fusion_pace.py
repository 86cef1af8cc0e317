"""Fusing keeps to its share of a core, but never lets data grow too old."""

import pytest

from swarm_loc_estimator.nodes.load import FusionPace

TICK_NS = 50_000_000
T0_NS = 1_000_000_000_000


def _fusions(pace: FusionPace, cpu_s: float, ticks: int, rate: float = 1.0) -> list[int]:
    """Ticks that fuse when each fusion takes `cpu_s` and bag time runs `rate` times as fast as the wall's."""
    chosen = []
    for tick in range(ticks):
        now_ns = T0_NS + tick * TICK_NS
        wall_s = tick * TICK_NS * 1e-9 / rate
        if pace.is_due(wall_s, now_ns):
            chosen.append(tick)
            pace.begin(wall_s, now_ns)
            pace.note(cpu_s)
    return chosen


@pytest.mark.parametrize(("cpu_s", "ticks_between"), [(0.001, 1), (0.009, 2), (0.016, 4)])
def test_fusing_takes_its_share(cpu_s: float, ticks_between: int) -> None:
    assert _fusions(FusionPace(0.1, 2.0), cpu_s, 41) == list(range(0, 41, ticks_between))


@pytest.mark.parametrize("rate", [1.0, 10.0])
def test_data_wait_for_a_quarter_of_the_horizon_at_most(rate: float) -> None:
    assert _fusions(FusionPace(0.1, 2.0), 3.0, 41, rate) == [0, 10, 20, 30, 40]


def test_time_that_jumps_back_is_not_waited_for() -> None:
    pace = FusionPace(0.1, 2.0)
    pace.begin(0.0, T0_NS)
    pace.note(1.0)
    assert not pace.is_due(0.05, T0_NS + TICK_NS)
    assert pace.is_due(0.05, T0_NS - TICK_NS)


def test_fusing_in_parts_rests_as_if_it_were_done_at_once() -> None:
    pace = FusionPace(0.1, 2.0)
    pace.begin(0.0, T0_NS)
    for _ in range(4):
        pace.note(0.005)
    assert not pace.is_due(0.19, T0_NS + TICK_NS)
    assert pace.is_due(0.21, T0_NS + TICK_NS)


def test_it_tells_how_long_data_have_waited() -> None:
    pace = FusionPace(0.1, 2.0)
    assert pace.waited_s(T0_NS) == 0.0
    pace.begin(0.0, T0_NS)
    assert pace.waited_s(T0_NS + 4 * TICK_NS) == pytest.approx(0.2)
    assert pace.waited_s(T0_NS - TICK_NS) == 0.0
