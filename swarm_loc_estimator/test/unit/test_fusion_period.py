"""When measurements are fused and in which parts, and which are left out where time is short."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from core_messages import SECOND, T0
from core_run import on_time, play, ticks
from core_world import Plan, simulate
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.filter.measurements import Measurements, concatenate
from swarm_loc_estimator.filter.models import CARTESIAN
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.nodes.load import MIN_SHARE, FusionPace, Shedding, Thinning
from swarm_loc_estimator.sensors.aerial import AerialRows
from swarm_loc_estimator.sensors.camera import DetectionRows
from swarm_loc_estimator.sensors.fix import FixRows, about_robots
from swarm_loc_estimator.sensors.infrared import BrightnessRows
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings
from swarm_loc_estimator.timeline.timeline import Timeline, end_of_period

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
    chosen = Settings(fusion_period_s=1.0, fusion_delay_s=1.0, horizon_s=1.0)
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


def test_what_is_to_be_fused_again_is_not_forgotten_while_fusing_takes_several_ticks() -> None:
    """Odometry changes what was measured, and until fusing ends this has grown too old."""
    stepped: list[int] = []

    def step(_state: SwarmState, rows: Measurements, *_: object) -> None:
        stepped.extend(rows.stamp_ns.tolist())

    state = SwarmState(ParameterTable.of((Robot("a"),), ()))
    timeline = Timeline(Settings(fusion_period_s=1e-9 * PERIOD_NS, horizon_s=1.0), step, state, 0)
    stamp_ns = T0 + PERIOD_NS * np.arange(1, 6, dtype=np.int64)
    timeline.add(fixes(stamp_ns))
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


def busy(
    shedding: Shedding,
    ticks: range,
    fusing_s: Callable[[float], float],
    tick_s: float = 1.0,
    come_s: float = 1.0,
) -> list[float]:
    """Ticks that take as long as they are apart; how long each fuses, given the share that is used [s]."""
    taken = []
    for tick in ticks:
        shedding.begin_tick(tick_s * tick, come_s)
        shedding.begin_fusion()
        taken.append(fusing_s(shedding.share))
        shedding.note(tick_s, taken[-1])
    return taken


def test_what_would_not_help_is_not_shed() -> None:
    """So far behind that a tick takes as long as what came before it, and more."""
    shedding = Shedding(0.1, HORIZON_S)
    busy(shedding, range(100, 200), lambda _: 0.04)
    assert shedding.share == 1.0


def test_what_was_shed_in_vain_is_used_again_though_the_node_stays_busy() -> None:
    shedding = Shedding(0.1, HORIZON_S)
    busy(shedding, range(20), lambda _: 0.9)
    assert shedding.share == MIN_SHARE
    busy(shedding, range(20, 100), lambda share: 0.02 * share)  # something else takes nearly all the time
    assert shedding.share == 1.0


def test_fusing_keeps_its_guaranteed_part_of_a_node_that_is_always_busy() -> None:
    taken = busy(Shedding(0.1, HORIZON_S), range(400), lambda share: min(2.0 * share, 0.9))
    assert min(taken[100:]) > 0.03
    assert max(taken[100:]) < 0.15


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
    busy(shedding, range(200), lambda _: 0.08, tick_s=0.1, come_s=0.4)
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


ROBOTS = 20
SEEN = 4


def sightings(robot: IntArray, stamp_ns: IntArray, marker: IntArray) -> DetectionRows:
    detection = np.zeros(robot.size, dtype=[("id", np.uint32)])
    detection["id"] = marker
    return DetectionRows(robot, stamp_ns, detection, stamp_ns)


def images(stamp_ns: int, robots: Any, seen: int = SEEN) -> Batch:
    """An image of each robot that shows the same markers in the same order every time."""
    robot = np.repeat(np.array(robots, dtype=np.int64), seen)
    stamps_ns = np.full(robot.size, stamp_ns)
    marker = np.tile(np.arange(seen), len(robots))
    drive = OdometryRows.without_twist(
        np.arange(3), np.full(3, stamp_ns), np.zeros((3, 3)), np.full(3, stamp_ns)
    )
    seen_now = sightings(robot, stamps_ns, marker)
    return Batch.of(stamp_ns, stamp_ns, odometry=drive, detections=seen_now)


@pytest.mark.parametrize("share", [0.75, 0.5, 0.25, 0.1, 1.0 / 3.0])
def test_all_robots_and_pairs_keep_the_same_share(share: float) -> None:
    thinning, kept = Thinning(ROBOTS), np.zeros((ROBOTS, SEEN))
    ticks = 400
    for tick in range(ticks):  # cameras take turns, so that each tick has the images of some
        messages = images(tick, np.arange(tick % 3, ROBOTS, 3))
        left = thinning.thin(messages, share).messages
        assert left["odometry"] is messages["odometry"]
        np.add.at(kept, (left["detections"].robot, left["detections"].detection["id"]), 1)
    sent = np.array([len(range(robot % 3, ticks, 3)) for robot in range(ROBOTS)])
    assert kept.sum(axis=1) == pytest.approx(share * SEEN * sent, abs=3.0)
    assert kept == pytest.approx(np.tile(share * sent[:, None], SEEN), abs=4.0)


def test_no_robot_goes_without_for_long() -> None:
    thinning, last = Thinning(ROBOTS), np.zeros(ROBOTS)
    for tick in range(300):
        left = thinning.thin(images(tick, range(ROBOTS)), 0.1).messages
        last[left["detections"].robot] = tick
        assert np.all(tick - last <= 8), "nothing for two images and a half is fair, for eight it is not"


def test_one_that_floods_is_the_first_to_lose() -> None:
    thinning, kept = Thinning(ROBOTS), np.zeros(ROBOTS)
    for tick in range(200):
        quiet, flood = images(tick, range(1, ROBOTS), 1), images(tick, [0], 200)
        both = Batch.of(tick, tick, detections=concatenate([quiet["detections"], flood["detections"]]))
        left = thinning.thin(both, 0.1).messages
        kept += np.bincount(left["detections"].robot, minlength=ROBOTS)
    assert set(kept[1:]) == {200.0}, "they sent less than everyone's part"
    assert kept[0] == pytest.approx(200 * (0.1 * 219 - 19), abs=3.0)


@given(st.lists(st.tuples(st.integers(0, 5), st.floats(0.01, 1.0)), max_size=30))
def test_the_same_backlog_leaves_the_same_behind(backlogs: list[tuple[int, float]]) -> None:
    one, other = Thinning(6), Thinning(6)
    for k, (robots, share) in enumerate(backlogs):
        first, second = (each.thin(images(k, range(robots)), share) for each in (one, other))
        assert first.shed == second.shed
        assert first.messages["detections"].robot.tolist() == second.messages["detections"].robot.tolist()
        assert sum(first.measurements.values()) == first.measurements["detections"] == robots * SEEN
        assert robots * SEEN - first.shed == first.messages["detections"].robot.size
        assert first.messages.dropped.get("shed_detections", 0) == first.shed


@pytest.mark.parametrize("share", [0.75, 0.5, 0.25, 0.1])
def test_of_a_large_swarm_whole_periods_are_left_out_in_whatever_order_they_come(share: float) -> None:
    period_ns, periods = 4, 1000
    thinning, kept = Thinning(ROBOTS, period_ns), np.zeros((periods, ROBOTS, SEEN))
    rng = np.random.default_rng(1)
    stamps_ns = 1 + rng.permutation(period_ns * periods)
    for stamp_ns in stamps_ns.tolist():  # late ones share the fate of their period
        left = thinning.thin(images(stamp_ns, range(ROBOTS)), share).messages
        seen = (
            end_of_period(stamp_ns, period_ns) // period_ns - 1,
            left["detections"].robot,
            left["detections"].detection["id"],
        )
        np.add.at(kept, seen, 1)
    assert set(kept.ravel().tolist()) == {0.0, float(period_ns)}
    used = np.all(kept == period_ns, axis=(1, 2))
    assert used.sum() == pytest.approx(share * periods, abs=3.0)
    gaps = np.diff(np.flatnonzero(used))
    assert gaps.max() <= 3.0 / share
    assert thinning.thin(images(0, range(ROBOTS)), 1.0).shed == 0


def test_all_matrices_of_an_exchange_share_its_fate() -> None:
    thinning = Thinning(2)

    def exchange(tick: int) -> BrightnessRows:
        stamps_ns = np.array([tick, tick + 1, tick, tick + 1])
        robot = np.array([0, 0, 1, 1])
        zero = np.zeros(4, dtype=np.int64)
        readings = np.empty(4, dtype=object)
        return BrightnessRows(robot, stamps_ns, robot, 1 - robot, zero, zero, zero, readings, stamps_ns)

    fate: dict[tuple[int, int], list[bool]] = {}
    shed = 0
    for tick in range(200):
        rows = exchange(tick)
        thinned = thinning.thin(Batch.of(tick, tick, brightness=rows), 0.5)
        shed += thinned.messages.dropped.get("shed_brightness", 0)
        left = thinned.messages["brightness"]
        pairs = zip(left.robot, left.stamp_ns, strict=True)
        kept = {(int(robot), int(stamp)) for robot, stamp in pairs}
        for key in zip(rows.robot.tolist(), rows.stamp_ns.tolist(), strict=True):
            fate.setdefault(key, []).append(key in kept)
    assert all(len(set(one)) == 1 for one in fate.values())
    assert np.mean([one[0] for one in fate.values()]) == pytest.approx(0.5, abs=0.05)
    assert shed == sum(not used for one in fate.values() for used in one)


def test_an_image_from_above_stays_whole_and_fixes_are_thinned() -> None:
    thinning, images_kept, fixes_kept = Thinning(2), 0, 0
    for tick in range(100):
        above = np.full(7, -1)
        stamps_ns = np.full(7, tick)
        aerial = AerialRows(above, stamps_ns, np.arange(7), np.zeros((7, 3)), np.zeros((7, 3, 3)), stamps_ns)
        robot, stamp = np.array([1]), np.array([tick])
        fixes = FixRows(robot, stamp, np.zeros((1, 3)), np.zeros((1, 3, 3)), stamp)
        left = thinning.thin(Batch.of(tick, tick, fixes=fixes, aerial=aerial), 0.5).messages
        assert left["aerial"].robot.size in (0, 7)
        images_kept += left["aerial"].robot.size // 7
        fixes_kept += left["fixes"].robot.size
    assert images_kept == pytest.approx(50, abs=2)
    assert fixes_kept == pytest.approx(50, abs=2)
