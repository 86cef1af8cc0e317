"""Conversations with emulated Droplets in simulated time: exchanges, turns, losses, and what is not right."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from bad_wire import BadWire
from droplet_rig import (
    IDEAL,
    IDS,
    LINK,
    SECOND,
    START_NS,
    TRIANGLE,
    Lab,
    asking,
    print_2014,
    print_2016,
    read_by,
    taking_turns,
    world_of,
)
from numpy.typing import NDArray

from swarm_loc_drivers.common.robot_driver import SessionError
from swarm_loc_drivers.droplet.exchange import Brightness, Power
from swarm_loc_drivers.droplet.hardware import FULL_POWER
from swarm_loc_drivers.sim.droplet.firmware import DropletFirmware, Print
from swarm_loc_drivers.sim.droplet.world import NEAR_POWER, DropletErrors, SimulatedDroplet
from swarm_loc_estimator.common.arrays import FloatArray


def assert_shows(lab: Lab, one: Brightness, receiver: int) -> None:
    """The matrix is what the receiver must have read."""
    exact = read_by(lab.world, receiver, IDS.index(one.transmitter))[one.power]
    assert np.abs(one.readings - np.clip(exact, 0.0, 255.0)).max() <= 0.5 + 1e-6


def test_a_partner_is_asked_at_both_powers() -> None:
    lab = Lab(world_of(), asking(IDS[1], IDS[2])).connected()
    assert lab.cables[0].session.robot == IDS[0]
    lab.cables[0].session.request_exchanges()
    begin_ns = lab.world.now_ns
    lab.until(lambda: len(lab.found[0]) == 4)
    (near, far, *others), counts = lab.found[0], lab.cables[0].counts
    assert [one.power for one in (near, far, *others)] == [Power.NEAR, Power.FAR] * 2
    assert {one.transmitter for one in others} == {IDS[1], IDS[2]} - {near.transmitter}
    assert near.stamp_ns == far.stamp_ns
    assert begin_ns < near.stamp_ns < others[0].stamp_ns < lab.world.now_ns
    for one in lab.found[0]:
        assert_shows(lab, one, 0)
    assert counts["exchanges"] == 2
    assert not counts["retries"] + counts["unknown_lines"] + counts["broken_matrices"] + counts["bad_echoes"]


def test_the_stamp_is_the_middle_of_the_exchange() -> None:
    """While a robot walks the matrices show where it was in the middle, of both powers."""
    start = np.array([[0.0, 0.0, 0.0], [0.10, 0.0, 0.0]])
    lab = Lab(world_of(start), asking(IDS[1])).connected()
    lab.cables[0].session.request_exchanges()
    lab.until(lambda: lab.cables[0].counts["lines"] > 4)
    emissions: list[int] = []
    infrared, emit = lab.world.infrared, lab.world.infrared.emit

    def noting(emitter: int, power: int, poses: FloatArray) -> None:
        emissions.append(lab.world.now_ns)
        emit(emitter, power, poses)

    infrared.emit = noting  # type: ignore[method-assign]
    lab.until(lambda: lab.found[0])
    middle_ns = np.mean(emissions) + 105e6  # flashes from 40 to 170 ms after the call
    assert lab.found[0][0].stamp_ns == pytest.approx(middle_ns, abs=12e6)


def test_exchanges_come_as_often_as_wanted() -> None:
    lab = Lab(world_of(), asking(IDS[1], IDS[2], period_s=2.0)).connected()
    lab.run(20.0)
    assert 18 <= len(lab.found[0]) <= 22
    assert {one.transmitter for one in lab.found[0]} == {IDS[1], IDS[2]}


def test_with_one_power_only_it_is_left_as_it_is() -> None:
    lab = Lab(world_of(), asking(IDS[1], powers=(FULL_POWER,))).connected()
    lab.cables[0].session.request_exchanges()
    lab.until(lambda: lab.found[0])
    (far,) = lab.found[0]
    assert far.power is Power.FAR
    assert_shows(lab, far, 0)


@pytest.mark.parametrize("layout", [print_2014, print_2016])
def test_formats_without_ids_show_whom_was_asked(layout: Print) -> None:
    lab = Lab(world_of(), asking(IDS[1])).connected()
    lab.cables[0].firmware = DropletFirmware(SimulatedDroplet(lab.world, 0), layout)
    lab.cables[0].session.request_exchanges()
    lab.until(lambda: lab.found[0])
    for one in lab.found[0]:
        assert one.transmitter == IDS[1]
        assert_shows(lab, one, 0)


def test_what_was_lost_is_asked_for_anew() -> None:
    errors = replace(IDEAL, infrared=replace(LINK, loss=0.25))
    lab = Lab(world_of(errors=errors), asking(IDS[1], IDS[2], period_s=1.0)).connected()
    lab.run(120.0)
    counts = lab.cables[0].counts
    assert counts["retries"] > 20
    assert counts["exchanges"] > 20
    assert counts["equal_powers"] > 3  # the command to change the power was lost
    for one in lab.found[0]:
        assert_shows(lab, one, 0)


def test_after_five_retries_a_partner_is_given_up_and_asked_less_often() -> None:
    far = np.array([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0], [0.0, 0.12, 0.0]])
    lab = Lab(world_of(far), asking(IDS[1], IDS[2], period_s=0.5)).connected()
    lab.until(lambda: lab.cables[0].counts["failed_exchanges"] == 1)
    counts = lab.cables[0].counts
    assert counts["retries"] == 5
    lab.run(40.0)
    assert counts["failed_exchanges"] <= 5
    assert counts["exchanges"] > 25


def test_a_robot_that_ignores_the_power_gives_no_pairs() -> None:
    lab = Lab(world_of(), asking(IDS[1], powers=(FULL_POWER, FULL_POWER - 1))).connected()
    lab.cables[0].session.request_exchanges()
    lab.until(lambda: lab.cables[0].counts["equal_powers"])
    assert not lab.found[0]


def test_what_others_asked_for_is_not_used() -> None:
    lab = Lab(world_of(), asking(IDS[1], IDS[2]), asking(IDS[2])).connected()
    lab.cables[1].session.request_exchanges()
    lab.until(lambda: lab.found[1])
    assert lab.cables[0].counts["overheard"] == 2
    assert not lab.found[0]


@pytest.mark.parametrize(
    ("emitter", "receiver", "reason"),
    [(IDS[0], IDS[0], "self_heard"), (0x1234, IDS[0], "unknown_ids"), (IDS[1], IDS[2], "foreign_receiver")],
)
def test_impossible_matrices_are_counted(emitter: int, receiver: int, reason: str) -> None:
    lab = Lab(world_of(), asking(IDS[1], retries=0)).connected()

    def lying(_emitter: int, _receiver: int, readings: NDArray[np.int64]) -> str:
        rows = ",".join("{" + ",".join(map(str, row)) + "}" for row in readings.tolist())
        return f'{{"{emitter:04X}", "{receiver:04X}", {{{rows}}}}},\r\n'

    lab.cables[0].firmware = DropletFirmware(SimulatedDroplet(lab.world, 0), lying)
    lab.cables[0].session.request_exchanges()
    lab.until(lambda: lab.cables[0].counts["failed_exchanges"])
    assert lab.cables[0].counts[reason] == 1
    assert not lab.found[0]


def test_turns_serve_all_robots_around() -> None:
    lab = Lab(world_of(), *(taking_turns(turn) for turn in range(3))).connected()
    lab.run(12.0)
    for receiver, found in enumerate(lab.found):
        assert len(found) == pytest.approx(2 * 2 * 4, abs=4)
        assert {one.transmitter for one in found} == set(IDS) - {IDS[receiver]}
        for one in found:
            assert_shows(lab, one, receiver)
        stamps = {power: [one.stamp_ns for one in found if one.power is power] for power in Power}
        assert stamps[Power.NEAR] == stamps[Power.FAR]
        assert lab.cables[receiver].counts["emissions"] == pytest.approx(2 * 4, abs=2)
    assert not lab.world.infrared.counts["collided"]


def test_half_an_exchange_is_published_when_the_turn_is_over() -> None:
    errors = replace(IDEAL, infrared=replace(LINK, loss=0.3))
    lab = Lab(world_of(errors=errors), *(taking_turns(turn) for turn in range(3))).connected()
    late: list[float] = []
    lab.control = lambda: late.extend(
        (lab.world.now_ns - one.stamp_ns) / SECOND for one in lab.found[0][len(late) :]
    )
    lab.run(60.0)
    counts = lab.cables[0].counts
    assert counts["half_exchanges"] > 5
    assert counts["exchanges"] > 5
    assert len(lab.found[0]) == 2 * counts["exchanges"] + counts["half_exchanges"]
    assert max(late) < 2.0
    for one in lab.found[0]:
        assert_shows(lab, one, 0)


def test_turns_with_one_power_use_their_second_half() -> None:
    lab = Lab(world_of(), *(taking_turns(turn, powers=(FULL_POWER,)) for turn in range(3))).connected()
    lab.run(9.0)
    assert {one.power for one in lab.found[0]} == {Power.FAR}
    assert lab.cables[0].counts["half_exchanges"] == len(lab.found[0]) == pytest.approx(6, abs=2)


def noted_commands(firmware: DropletFirmware) -> list[str]:
    """The lines that are executed from now on."""
    executed: list[str] = []
    execute = firmware._execute

    def noting(line: str) -> None:
        executed.append(line)
        execute(line)

    firmware._execute = noting  # type: ignore[method-assign]
    return executed


@pytest.mark.parametrize("seed", range(3))
def test_over_a_bad_wire_no_other_command_arrives_than_was_meant(seed: int) -> None:
    lab = Lab(world_of(), asking(IDS[1], period_s=1.0))
    (cable,) = lab.cables
    firmware = cable.firmware
    cable.firmware = BadWire(firmware, 0.002, seed)
    assert isinstance(firmware, DropletFirmware)
    executed = noted_commands(firmware)
    lab.connected()
    lab.control = lambda: cable.set_velocity((0.01, 0.0, 0.0))
    lab.run(30.0)
    meant = {
        *("", "get_id", "stop_walk", "print_motor_settings", "move_steps 0 16"),
        *(f"tgt_cmd {IDS[1]:04X} {line}" for line in ("rnb_b", "set_ir 256", f"set_ir {NEAR_POWER}")),
    }
    assert set(executed) <= meant
    assert cable.counts["bad_echoes"] > 0
    assert cable.counts["exchanges"] > 5


def test_what_a_deaf_robot_kept_of_a_line_is_not_executed_with_the_next_one() -> None:
    lab = Lab(world_of(), asking()).connected()
    (cable,) = lab.cables
    firmware = cable.firmware
    assert isinstance(firmware, DropletFirmware)
    executed = noted_commands(firmware)
    deaf_until_ns = lab.world.now_ns + SECOND // 2
    firmware._body.deaf_until_ns = lambda: deaf_until_ns  # type: ignore[method-assign]
    cable.set_velocity((0.01, 0.0, 0.0))
    lab.run(0.52)
    cable.session.step(b"\r\n\t(RNB) ID: 6B6F | R: 173 B: -90 H: 45\r\n", lab.world.now_ns)
    lab.until(lambda: executed)
    assert cable.counts["bad_echoes"] > 0
    assert executed[0] == "stop_walk"


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (lambda _: b"", "does not echo 'stop_walk'"),
        (lambda data: data.replace(b"\r", b"\r\n"), "does not answer 'get_id'"),
    ],
)
def test_who_does_not_speak_the_language_is_told(answer: Callable[[bytes], bytes], sentence: str) -> None:
    class Stranger:
        def receive(self, data: bytes) -> bytes:
            return answer(data)

        def stream(self) -> bytes:
            return b""

    lab = Lab(world_of(), asking())
    lab.cables[0].firmware = Stranger()
    with pytest.raises(SessionError, match=sentence):
        lab.run(60.0)


def test_a_clock_that_jumps_back_keeps_nobody_waiting() -> None:
    session = Lab(world_of(), asking()).cables[0].session
    session.step(b"", START_NS)

    def wait(seconds: int) -> None:
        for second in range(1, seconds):
            session.step(b"", second * SECOND)

    with pytest.raises(SessionError, match="does not echo 'stop_walk'"):  # as of every silent robot
        wait(60)


def test_without_a_clock_nothing_is_stamped() -> None:
    lab = Lab(world_of(), asking(IDS[1], period_s=1.0))
    session = lab.cables[0].session
    firmware = lab.cables[0].firmware
    data = b""
    for _ in range(20):
        data = firmware.receive(session.step(data, 0))
    assert session.connected
    text = '{"6B6F", "0029", {' + ",".join(["{1,2,3,4,5,60}"] * 6) + "}},\r\n"
    session.step(text.encode(), 0)
    assert lab.cables[0].counts["no_clock"] == 1


def test_the_errors_of_the_named_worlds_leave_most_exchanges_whole() -> None:
    errors = DropletErrors(0.08, 0.5, 1e-4, 0.02, 1e-3, 0.1, replace(LINK, loss=0.05, ambient=6.0))
    lab = Lab(world_of(TRIANGLE, errors, noise=1.0), *(taking_turns(turn) for turn in range(3)))
    lab.connected().run(30.0)
    counts = lab.cables[0].counts
    assert counts["exchanges"] > 4 * counts["half_exchanges"]
    assert lab.found[0][0].stamp_ns > START_NS


def test_a_droplet_that_has_nothing_to_do_and_says_nothing_is_found_out() -> None:
    """One that still answers is asked for its id again and again, without any trouble."""
    lab = Lab(world_of(), asking()).connected()
    cable = lab.cables[0]
    lines = cable.counts["lines"]
    lab.run(10.0)
    assert 5 <= cable.counts["lines"] - lines <= 10
    assert not cable.counts["bad_echoes"]
    cable.firmware.receive = lambda _: b""  # type: ignore[method-assign, assignment]
    with pytest.raises(SessionError):
        lab.run(3.0)
