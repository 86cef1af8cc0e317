"""Stamps of events, packets, and odometry of PushBots."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_drivers.common.odometry import WheelGeometry
from swarm_loc_drivers.pushbot.driver import EventClock, PushbotOdometry, TickClock, WheelTicks
from swarm_loc_drivers.pushbot.event_parser import MAX_EVENTS, EventPackets
from swarm_loc_drivers.pushbot.protocol import tick_difference, wheel_velocities
from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.messages.event_encoding import ENCODING, decode_events

MS = 1_000_000
GEOMETRY = WheelGeometry(metres_per_step=1e-4, wheel_separation=0.085)


def run(clock: EventClock, made_us: IntArray, late_ns: IntArray) -> IntArray:
    """Stamps of single events made at some times of the board, each late by something."""
    came_ns = np.maximum.accumulate(10**9 + 1000 * made_us + late_ns)
    pairs = zip(made_us.tolist(), came_ns.tolist(), strict=True)
    return np.array([int(clock.stamps(np.array([made]), came)[0]) for made, came in pairs])


@given(seed=st.integers(0, 2**31))
def test_the_shortest_way_counts(seed: int) -> None:
    """Bytes late by 2 to 30 ms: after a while all stamps are late by 2 ms."""
    rng = np.random.default_rng(seed)
    made = np.cumsum(rng.integers(1000, 9000, 600))
    late = 2 * MS + rng.exponential(5 * MS, 600).astype(int)
    stamps = run(EventClock(0), made, late)
    error = stamps - (10**9 + 1000 * made)
    assert (error >= 2 * MS).all()
    assert (error[200:] <= 3 * MS).all()


def test_time_lost_with_differences_is_learnt_again() -> None:
    """Of events that were lost a format of differences loses the time, too."""
    made = np.arange(0, 10_000_000, 5000)
    clock = EventClock(0)
    run(clock, made[:1000], np.zeros(1000, int))
    stamps = [int(clock.stamps(np.array([one - 30_000]), 10**9 + 1000 * int(one))[0]) for one in made[1000:]]
    assert abs(stamps[-1] - (10**9 + 1000 * int(made[-1]))) < MS


def test_a_silence_longer_than_the_timestamps_is_seen_by_the_computers_clock() -> None:
    """Of 16 bits, which begin again every 65.5 ms, as the parser unwraps them."""
    clock = EventClock(1 << 16)
    clock.stamps(np.array([1000]), 10**9)
    silence_us = 5 * 65_536 + 2_000
    stamp = clock.stamps(np.array([1000 + 2_000]), 10**9 + 1000 * silence_us)[0]
    assert stamp == 10**9 + 1000 * silence_us


def test_a_clock_that_was_set_back_is_followed() -> None:
    clock = EventClock(0)
    clock.stamps(np.array([1000]), 10**9)
    assert clock.stamps(np.array([2000]), 10**6)[0] == 10**6


@given(seed=st.integers(0, 2**31), count=st.integers(1, 300))
def test_packets_hold_all_events_in_order(seed: int, count: int) -> None:
    """Whatever the times: also those that step back, or are far apart."""
    rng = np.random.default_rng(seed)
    stamps = 10**9 + np.cumsum(rng.choice([0, 1000, 10**6, -(10**5), 6 * 10**9], count))
    x, y, p = rng.integers(0, 128, (3, count)).astype(np.uint8)
    packets = EventPackets(0.005, 1)
    cut = int(rng.integers(0, count))
    for part in (slice(0, cut), slice(cut, count)):
        if part.stop > part.start:
            packets.add(x[part], y[part], p[part] & 1, stamps[part], stamps[part] // 1000)
    packets.flush()
    decoded = [decode_events(one.data, ENCODING, (128, 128)) for one in packets.ready]
    np.testing.assert_array_equal(np.concatenate([one.x for one in decoded]), x)
    np.testing.assert_array_equal(np.concatenate([one.is_on for one in decoded]), (p & 1).astype(bool))
    times = [packet.stamp_ns + one.time_ns for packet, one in zip(packets.ready, decoded, strict=True)]
    np.testing.assert_array_equal(np.concatenate(times), stamps)
    assert [one.number for one in packets.ready] == list(range(len(packets.ready)))
    assert all(one.time_ns[-1] <= 15 * MS for one in decoded)


def test_packets_are_bounded() -> None:
    packets = EventPackets(10.0, 0)
    zeros = np.zeros(3 * MAX_EVENTS, np.uint8)
    packets.add(zeros, zeros, zeros, np.full(len(zeros), 10**9), np.zeros(len(zeros), np.int64))
    packets.flush()
    assert [one.count for one in packets.ready] == [MAX_EVENTS] * 3


def test_events_do_not_wait_for_others() -> None:
    packets = EventPackets(0.005, 0)
    one = np.zeros(1, np.uint8)
    packets.add(one, one, one, np.array([10**9]), np.array([0]))
    packets.flush_late(10**9 + 5 * MS)
    assert not packets.ready
    packets.flush_late(10**9 + 11 * MS)
    assert len(packets.ready) == 1


@given(before=st.integers(-(2**31), 2**31 - 1), step=st.integers(-(2**31), 2**31 - 1))
def test_ticks_wrap(before: int, step: int) -> None:
    after = (before + step + 2**31) % 2**32 - 2**31
    assert tick_difference(before, after) == step


def odometry() -> tuple[PushbotOdometry, Counter[str]]:
    counts: Counter[str] = Counter()
    return PushbotOdometry(GEOMETRY, 2e-5, counts), counts


def test_a_quarter_turn_and_a_metre() -> None:
    reckoning, counts = odometry()
    turn = round(0.25 * np.pi * GEOMETRY.wheel_separation / GEOMETRY.metres_per_step)
    readings = [(0, 0), (-turn, turn), (10_000 - turn, 10_000 + turn)]
    for k, (left, right) in enumerate(readings):
        state = reckoning.update(WheelTicks(10**9 + k * 3 * 10**9, left, right))
    assert state is not None
    assert state.pose == pytest.approx([0.0, 1.0, np.pi / 2], abs=2e-3)
    assert (np.linalg.eigvalsh(state.covariance) > 0.0).all()
    assert not counts


def test_ticks_that_no_motor_can_make_are_refused_once_and_believed_the_second_time() -> None:
    reckoning, counts = odometry()
    reckoning.update(WheelTicks(10**9, 0, 0))
    assert reckoning.update(WheelTicks(10**9 + 20 * MS, 500_000, 0)) is None
    assert reckoning.update(WheelTicks(10**9 + 40 * MS, 20, 20)) is not None
    assert counts == {"implausible_counters": 1}
    reckoning.update(WheelTicks(10**9 + 60 * MS, -900_000, 0))
    state = reckoning.update(WheelTicks(10**9 + 80 * MS, -900_000, 0))
    assert state is not None
    assert state.pose == pytest.approx([0.002, 0.0, 0.0])
    assert counts == {"implausible_counters": 2, "counter_restarts": 1}


def test_a_stamp_that_is_corrected_backwards_is_no_jump_of_time() -> None:
    reckoning, counts = odometry()
    reckoning.update(WheelTicks(10**9, 0, 0))
    assert reckoning.update(WheelTicks(10**9 - 30 * MS, 20, 20)) is None
    state = reckoning.update(WheelTicks(10**9 + 10 * MS, 50, 50))
    assert state is not None
    assert state.pose == pytest.approx([0.005, 0.0, 0.0])
    assert counts == {"corrected_times": 1}
    assert reckoning.update(WheelTicks(10**9 - 800 * MS, 60, 60)) is not None
    assert counts == {"corrected_times": 1, "time_jumps": 1}


@pytest.mark.parametrize(("pause_s", "x"), [(0.7, 0.03), (3.0, 0.01)])
def test_a_robot_that_was_not_heard_for_long_before_a_reset_begins_anew(pause_s: float, x: float) -> None:
    reckoning, _ = odometry()
    for k, ticks in enumerate((0, 100, 200)):
        reckoning.update(WheelTicks(10**9 + 100 * k * MS, ticks, ticks))
    again_ns = 10**9 + 200 * MS + round(1e9 * pause_s)
    reckoning.restart()
    reckoning.restart()
    reckoning.update(WheelTicks(again_ns, 0, 0))
    state = reckoning.update(WheelTicks(again_ns + 100 * MS, 100, 100))
    assert state is not None
    assert state.pose == pytest.approx([x, 0.0, 0.0])


def test_commands_keep_the_curve_at_the_limit() -> None:
    left, right = wheel_velocities(GEOMETRY, 1.0, 2.0)
    assert max(left, right) == 100
    assert left / right == pytest.approx((1.0 - 0.085) / (1.0 + 0.085), rel=0.02)


def test_readings_keep_their_period_while_events_wait_for_the_wire() -> None:
    """Events come up to 50 ms late for a while; one reading is lost."""
    clock, offset_ns = TickClock(20), 7 * 10**9
    stamps = {}
    for k in range(1, 400):
        read_us = 20_000 * k
        waited_us = 200 if k < 100 or k > 250 else min(50_000, 600 * (k - 99))
        event_us = read_us - waited_us
        if k != 150:
            clock.pass_event(event_us, offset_ns + 1000 * event_us)
            stamps[k] = clock.stamp_ns(offset_ns + 1000 * read_us + 30 * MS)
    wrong_ns = {k: stamp - offset_ns - 20 * MS * k for k, stamp in stamps.items()}
    assert max(abs(wrong) for k, wrong in wrong_ns.items() if k < 150 or k > 255) < MS
    assert max(abs(wrong) for wrong in wrong_ns.values()) < 21 * MS


def test_a_reading_without_events_is_stamped_as_it_comes() -> None:
    assert TickClock(20).stamp_ns(5 * MS) == 5 * MS


def test_no_reading_is_from_the_future() -> None:
    clock = TickClock(20)
    for k in range(10):  # twice as many as there should be
        clock.pass_event(10_000 * k, 10 * MS * k)
        assert clock.stamp_ns(10 * MS * k + MS) <= 10 * MS * k + MS
