"""The emulated Droplet answers its console as the published firmware does."""

import numpy as np
import pytest
from droplet_rig import IDS, TRIANGLE, print_2014, print_2016, world_of
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_drivers.droplet.hardware import (
    EMITTED_AFTER_NS,
    EXCHANGE_NS,
    HANDLING_NS,
    LEAD_NS,
    PRINT_DELAY_NS,
    message_ns,
)
from swarm_loc_drivers.droplet.protocol import ConsoleParser, Matrix
from swarm_loc_drivers.sim.droplet.firmware import DropletFirmware, Print, print_named
from swarm_loc_drivers.sim.droplet.world import STEP_NS, DropletWorld, SimulatedDroplet, nominal_gait


class Robots:
    """Some robots whose consoles are watched."""

    def __init__(self, world: DropletWorld | None = None, print_matrix: Print = print_named) -> None:
        self.world = world or world_of()
        bodies = [SimulatedDroplet(self.world, robot) for robot in range(len(self.world.ids))]
        self.firmware = [DropletFirmware(body, print_matrix) for body in bodies]
        self.printed = ["" for _ in bodies]

    def type(self, robot: int, line: str) -> str:
        """Type a line; what is printed at once."""
        printed = self.firmware[robot].receive(line.encode() + b"\r").decode()
        self.printed[robot] += printed
        return printed

    def run(self, duration_ns: int) -> None:
        """Let time pass."""
        for _ in range(-(-duration_ns // STEP_NS)):
            self.world.step()
            for robot, firmware in enumerate(self.firmware):
                self.printed[robot] += firmware.stream().decode()


@pytest.fixture
def robots() -> Robots:
    return Robots()


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("get_id", "My ID is: 0029\r\n"),
        ("move_steps 0 50", "walk direction 0, num_steps 50\r\n"),
        ("move_steps 0 0", ""),
        ("stop_walk", ""),
        ("set_ir 40", ""),
        ("rnb_b", ""),
        ("cmd stop_walk", 'Broadcasting command: "stop_walk", of length 9.\r\n'),
        ("tgt_cmd 6b6f rnb_b", 'Broadcasting command to 6B6F: "rnb_b", of length 5.\r\n'),
        ("dance now", "\tCommand ( dance ) not recognized.\r\n"),
        ("", ""),
    ],
)
def test_lines_are_echoed_and_answered(robots: Robots, line: str, answer: str) -> None:
    assert robots.type(0, line) == f"{line}\r\n{answer}"


def test_both_ends_of_a_line_count(robots: Robots) -> None:
    assert robots.firmware[0].receive(b"get_id\r\n") == b"get_id\r\nMy ID is: 0029\r\n\r\n"


def test_a_line_that_is_too_long_is_forgotten(robots: Robots) -> None:
    printed = robots.firmware[0].receive(b"x" * 65 + b"get_id\n")
    assert printed.startswith(
        b"x" * 64 + b"\r\nERROR: Serial input buffer capacity of 64 characters exceeded.\r\n"
    )
    assert printed.endswith(b"get_id\r\nMy ID is: 0029\r\n")


def test_characters_can_be_taken_back(robots: Robots) -> None:
    assert robots.firmware[0].receive(b"\bgex\bt_id\r") == b"\b \bgex\b \bt_id\r\nMy ID is: 0029\r\n"


def test_a_move_lasts_its_steps_and_another_one_is_acknowledged_but_ignored(robots: Robots) -> None:
    gait = nominal_gait(0)
    robots.type(0, "move_steps 0 20")
    robots.run(round(10 * gait.step_s * 1e9))
    assert robots.type(0, "move_steps 3 20") == "move_steps 3 20\r\nwalk direction 3, num_steps 20\r\n"
    robots.run(round(30 * gait.step_s * 1e9))
    moved = robots.world.poses[0] - TRIANGLE[0]
    ahead = 20 * gait.forward * np.array([np.cos(TRIANGLE[0, 2]), np.sin(TRIANGLE[0, 2]), 0.0])
    assert moved == pytest.approx(ahead, abs=2 * STEP_NS * 1e-9 * gait.velocity[0])


def test_a_command_reaches_one_robot_or_all_by_infrared(robots: Robots) -> None:
    robots.type(0, "tgt_cmd 6B6F get_id")
    robots.run(message_ns(6) + HANDLING_NS + STEP_NS)
    assert robots.printed[1:] == ["My ID is: 6B6F\r\n", ""]
    robots.type(1, "cmd get_id")
    robots.run(message_ns(6) + HANDLING_NS + STEP_NS)
    assert "My ID is: 0029" in robots.printed[0]
    assert "My ID is: DF64" in robots.printed[2]


def test_messages_longer_than_the_buffer_are_not_sent(robots: Robots) -> None:
    longest = "x" * 40
    printed = robots.type(0, f"cmd {longest}x")
    assert printed.endswith("of length 41.\r\nERROR: Message exceeds IR_BUFFER_SIZE.\r\n")
    assert "ERROR" not in robots.type(0, f"cmd {longest}")
    robots.run(message_ns(40) + HANDLING_NS + STEP_NS)
    assert robots.printed[1:] == [f"\tCommand ( {longest} ) not recognized.\r\n"] * 2


def test_who_is_sending_sends_nothing_else(robots: Robots) -> None:
    robots.type(0, "cmd get_id")
    assert robots.type(0, "cmd stop_walk").endswith("Aborting IR send [02] while trying: stop_walk\r\n")


def test_who_has_not_read_an_exchange_yet_does_not_emit(robots: Robots) -> None:
    robots.type(0, "rnb_b")
    robots.run(EMITTED_AFTER_NS - PRINT_DELAY_NS)
    robots.type(1, "rnb_b")
    robots.run(EXCHANGE_NS)
    assert robots.printed[1].startswith("rnb_b\r\nRNB Broadcast failed [ 40 ]\r\n{")
    assert robots.printed[1].count("{") == 8


@pytest.mark.parametrize("layout", [print_named, print_2014, print_2016])
def test_all_others_print_what_they_measured(layout: Print) -> None:
    robots = Robots(print_matrix=layout)
    robots.type(0, "rnb_b")
    robots.run(EMITTED_AFTER_NS + 2 * STEP_NS)
    assert robots.printed[0] == "rnb_b\r\n"
    for robot in (1, 2):
        (said,) = ConsoleParser().feed(robots.printed[robot].encode(), 0)
        assert isinstance(said.event, Matrix)
        who = (IDS[0], IDS[robot]) if layout is print_named else (None, None)
        assert (said.event.emitter, said.event.receiver) == who
        assert np.max(said.event.brightness) > 20


def test_in_an_exchange_a_robot_is_deaf_to_its_console(robots: Robots) -> None:
    robots.type(0, "rnb_b")
    robots.run(LEAD_NS + 10 * STEP_NS)
    for robot in (0, 1):
        assert robots.firmware[robot].receive(b"get_id\r") == b""
    robots.run(EXCHANGE_NS)
    assert robots.printed[0].endswith("ge")
    assert robots.printed[1].startswith("ge")


@given(noise=st.binary(max_size=200))
def test_whatever_was_typed_it_goes_on_answering(noise: bytes) -> None:
    firmware = DropletFirmware(SimulatedDroplet(world_of(), 0))
    firmware.receive(noise)
    firmware.stream()
    firmware.receive(b"\r\b\r")
    assert firmware.receive(b"get_id\r").endswith(b"get_id\r\nMy ID is: 0029\r\n")


def test_the_settings_are_printed_and_read(robots: Robots) -> None:
    printed = robots.type(0, "print_motor_settings")
    lines = [said.event for said in ConsoleParser().feed(printed.encode(), 0)]
    assert len(lines) == 1 + 1 + 8 + 1 + 8
    assert lines[2] == (0, SimulatedDroplet.trims[0])
    assert lines[-1] == (7, SimulatedDroplet.lengths[7])
