"""How much an estimator that is kept busy uses, from times alone."""

import pytest

from swarm_loc_estimator.nodes.load import MIN_SHARE, Shedding

PERIOD_S = 0.05
HORIZON_S = 2.0


class Machine:
    """An estimator whose sightings take a while each to fuse, and that does other things, too."""

    def __init__(self, fusing: float, rest: float = 0.1) -> None:
        self.fusing, self.rest = fusing, rest
        self.shedding = Shedding(0.1, HORIZON_S)
        self.now_s = self.seen_s = 100.0
        self.shares: list[float] = []

    def run(self, seconds: float) -> float:
        """Tick for so long; how far the data lie behind at the end [s]."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.shedding.begin_tick(self.now_s, self.now_s - self.seen_s)
            self.shedding.begin_fusion()
            self.shares.append(self.shedding.share)
            come_s, self.seen_s = self.now_s - self.seen_s, self.now_s
            fusing_s = self.fusing * self.shedding.share * min(come_s, HORIZON_S)
            busy_s = fusing_s + self.rest * come_s
            self.shedding.note(busy_s, fusing_s)
            self.now_s = max(self.now_s + busy_s, self.seen_s + PERIOD_S)
        return self.now_s - self.seen_s


def test_an_estimator_that_keeps_up_uses_all() -> None:
    machine = Machine(fusing=0.7)
    machine.run(20.0)
    assert set(machine.shares) == {1.0}


@pytest.mark.parametrize("fusing", [1.2, 3.0, 30.0])
def test_with_too_much_to_do_the_ticks_soon_keep_to_their_period(fusing: float) -> None:
    machine = Machine(fusing)
    machine.run(60.0)
    late_s = machine.run(PERIOD_S)
    load = machine.rest + machine.fusing * machine.shedding.share
    assert late_s == pytest.approx(PERIOD_S, abs=1e-9)
    assert load < 0.9
    assert machine.shedding.share > 0.25 / fusing
    settled = machine.shares[-20:]
    assert max(settled) == min(settled), "it goes up and down"


def test_all_is_used_again_when_the_load_has_fallen() -> None:
    machine = Machine(fusing=10.0)
    machine.run(20.0)
    machine.fusing = 0.3
    machine.run(10.0)
    assert machine.shedding.share == 1.0


def test_what_would_not_help_is_not_shed() -> None:
    machine = Machine(fusing=0.09, rest=2.0)
    for _ in range(100):  # so far behind that a tick takes as long as what came before it, and more
        machine.shedding.begin_tick(machine.now_s, 1.0)
        machine.shedding.begin_fusion()
        machine.shedding.note(1.0, 0.04)
        machine.now_s += 1.0
    assert machine.shedding.share == 1.0


def test_what_was_shed_in_vain_is_used_again_though_the_node_stays_busy() -> None:
    shedding = Shedding(0.1, HORIZON_S)
    for second in range(20):
        shedding.begin_tick(float(second), 1.0)
        shedding.begin_fusion()
        shedding.note(1.0, 0.9)
    assert shedding.share == MIN_SHARE
    for second in range(20, 100):  # something else takes all the time, and fusing hardly any
        shedding.begin_tick(float(second), 1.0)
        shedding.begin_fusion()
        shedding.note(1.0, 0.02 * shedding.share)
    assert shedding.share == 1.0


def test_fusing_keeps_its_guaranteed_part_of_a_node_that_is_always_busy() -> None:
    shedding, taken = Shedding(0.1, HORIZON_S), []
    for second in range(400):
        shedding.begin_tick(float(second), 1.0)
        shedding.begin_fusion()
        taken.append(min(2.0 * shedding.share, 0.9))
        shedding.note(1.0, taken[-1])
    assert min(taken[100:]) > 0.03
    assert max(taken[100:]) < 0.15


def test_a_little_is_always_used() -> None:
    shedding = Shedding(0.1, HORIZON_S)
    for second in range(50):
        shedding.begin_tick(float(second), 1.0)
        shedding.begin_fusion()
        shedding.note(1.0, 1.0)
    assert shedding.share == MIN_SHARE


def test_a_node_that_is_busy_for_a_while_and_catches_up_again_leaves_nothing_out() -> None:
    """As at its start: all memory is written to for the first time, and all robots are placed."""
    machine = Machine(fusing=2.0)
    machine.run(0.5)
    machine.fusing = 0.5
    machine.run(10.0)
    assert set(machine.shares) == {1.0}
    assert machine.run(PERIOD_S) == pytest.approx(PERIOD_S, abs=1e-9)


def test_a_node_that_is_always_busy_but_does_not_fall_behind_leaves_nothing_out() -> None:
    shedding = Shedding(0.1, HORIZON_S)
    for tick in range(200):
        shedding.begin_tick(0.1 * tick, 0.4)
        shedding.begin_fusion()
        shedding.note(0.1, 0.08)
    assert shedding.share == 1.0


def test_it_waits_for_what_a_cut_brings() -> None:
    """A fusion that takes long is of what came before the cut."""
    shedding = Shedding(0.1, HORIZON_S)
    for tick in range(40):
        shedding.begin_tick(0.1 * tick, 0.1 * tick)
        shedding.note(0.1, 0.09)
    assert shedding.share == 0.5
    shedding.begin_fusion()
    for tick in range(40, 60):
        shedding.begin_tick(0.1 * tick, 0.1 * (tick - 39))
        shedding.note(0.1, 0.09)
    assert shedding.share == 0.25
