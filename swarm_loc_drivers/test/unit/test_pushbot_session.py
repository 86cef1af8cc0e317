"""Conversations with emulated PushBots: handshake, streams, stalls, and wheels that must not run away."""

import numpy as np
import pytest
from pushbot_rig import PushbotWire, pushbot_params

from swarm_loc_drivers.pushbot import protocol as commands
from swarm_loc_drivers.pushbot.driver import NO_STOP, PushbotDriver, PushbotListeners
from swarm_loc_drivers.pushbot.protocol import FIRST_FIRMWARE, SECOND_FIRMWARE, FirmwareGeneration
from swarm_loc_estimator.common.messages.event_encoding import ENCODING, decode_events

FORMATS = [(one, name) for one in (FIRST_FIRMWARE, SECOND_FIRMWARE) for name in ("", *one.formats)]


def streaming(
    params_of: dict[str, object] | None = None, generation: FirmwareGeneration = SECOND_FIRMWARE
) -> PushbotWire:
    """A robot that is connected."""
    wire = PushbotWire(pushbot_params(**(params_of or {})), generation)
    wire.run(0.5)
    assert wire.session.connected
    return wire


def driving(
    velocities: tuple[int, int],
    params_of: dict[str, object] | None = None,
    generation: FirmwareGeneration = SECOND_FIRMWARE,
) -> PushbotWire:
    """A robot that is connected and has driven for half a second."""
    wire = streaming(params_of, generation)
    wire.velocities = velocities
    wire.run(0.5)
    return wire


@pytest.mark.parametrize(
    ("generation", "timestamps"), FORMATS, ids=lambda one: getattr(one, "name", one or "off")
)
def test_every_format_of_every_firmware_streams(generation: FirmwareGeneration, timestamps: str) -> None:
    wire = driving((20, 30), {"timestamps": timestamps} if timestamps else {"events": False}, generation)
    wire.velocities = (0, 0)
    wire.run(0.3)
    assert not wire.errors
    assert wire.session.generation is generation
    assert bool(wire.packets) == bool(timestamps)
    assert len(wire.ticks) == pytest.approx(0.8 / 0.02 + 0.5 / 0.02, abs=5)
    distance, angle = wire.odometry_error()
    assert distance < 2e-4
    assert angle < 2 * 1e-4 / 0.085
    assert not {"corrupt_events", "skipped_bytes", "refused_commands", "other_lines"} & set(wire.counts)


def test_events_carry_the_time_at_which_they_were_made() -> None:
    """The laser is switched at known instants, which the stamps must show."""
    wire = streaming()
    wire.run(0.5)
    packet = wire.packets[-10]
    events = decode_events(packet.data, ENCODING, (128, 128))
    near = (np.abs(events.x - 64) < 6) & (events.y > 64) & events.is_on
    phase_ns = (packet.stamp_ns + events.time_ns[near]) % 2_222_000
    # latency of the pixel, bursts of six, and the wire: nothing of it lasts a millisecond
    assert np.percentile(phase_ns, 10) < 300_000
    assert np.percentile(phase_ns, 90) < 1_000_000


def test_ticks_among_events_are_stamped_by_the_boards_clock() -> None:
    """Steps of the world are 5 ms; the ticks come every 20 ms of the board's own."""
    wire = streaming()
    wire.run(1.0)
    stamps = np.diff([one.stamp_ns for one in wire.ticks[5:]])
    assert stamps.mean() == pytest.approx(20e6, rel=0.01)


def test_a_firmware_without_such_timestamps_is_named() -> None:
    wire = PushbotWire(pushbot_params(timestamps="32bit"), FIRST_FIRMWARE)
    wire.run(0.5)
    assert "has no timestamps '32bit', only none, 16bit, 24bit, delta" in wire.errors[0]


def test_a_board_that_is_no_pushbot_is_named() -> None:
    wire = PushbotWire(pushbot_params())
    say = wire.firmware.board.say
    wire.firmware.board.say = lambda text: say(text.replace(" 28  268435456 MOTOR SENSORS   2\n", ""))  # type: ignore[method-assign]
    wire.run(0.5)
    assert "no wheels" in wire.errors[0]


def test_a_robot_that_does_not_answer_is_named() -> None:
    wire = PushbotWire(pushbot_params())
    wire.hears = False
    wire.run(8.0)
    assert wire.errors == ["the robot does not answer R"]


@pytest.mark.parametrize("generation", [FIRST_FIRMWARE, SECOND_FIRMWARE], ids=lambda one: one.name)
def test_wheels_stand_at_the_end(generation: FirmwareGeneration) -> None:
    wire = driving((60, 60), generation=generation)
    assert wire.speed > 0.3
    wire.session.ending = True
    wire.run(0.1)
    assert wire.speed == 0.0
    wire.run(0.3)
    assert wire.session.ended
    assert wire.speed == 0.0
    assert wire.ticks[-1].left == wire.ticks[-4].left
    assert wire.world.lights[0][0].period_us == 0
    assert not wire.firmware.board.is_streaming


@pytest.mark.parametrize("generation", [FIRST_FIRMWARE, SECOND_FIRMWARE], ids=lambda one: one.name)
@pytest.mark.parametrize("ends", [False, True])
def test_a_stop_that_the_firmware_loses_is_repeated_until_the_wheels_stand(
    generation: FirmwareGeneration, ends: bool
) -> None:
    """Parsed just after a tick of the clock, the stop is overwritten by the controllers' pending update."""
    wire = driving((60, 60), generation=generation)
    wire.firmware.late_share = 1.0
    before = wire.sent.count(commands.BRAKE)
    wire.velocities, wire.session.ending = (0, 0), ends
    wire.run(0.03)
    assert wire.sent.count(commands.BRAKE) == before + 1
    assert wire.speed > 0.3
    wire.run(0.2)
    assert wire.speed == 0.0
    assert 1 <= wire.counts["repeated_stops"] <= 2  # it coasts a moment
    wire.run(1.0)
    assert wire.session.ended is ends
    assert wire.ticks[-1].left == wire.ticks[-4].left
    assert wire.sent.count(commands.BRAKE) == before + 1 + wire.counts["repeated_stops"] + ends
    assert wire.counts["ignored_stops"] == 0
    assert not wire.errors


def test_a_robot_that_does_not_stop_is_reported_and_reset_at_the_end() -> None:
    wire = driving((30, 30), generation=FIRST_FIRMWARE)
    driver = PushbotDriver(pushbot_params(), PushbotListeners(print, print), lambda: 0)
    wire.firmware.board.set_duty = lambda _motor, _percent: True  # type: ignore[assignment, method-assign]
    wire.velocities = (0, 0)
    wire.run(0.9)
    assert wire.counts["ignored_stops"] == 0
    wire.run(0.5)
    assert wire.session.does_not_stop
    assert wire.counts["ignored_stops"] == 1
    wire.run(1.5)
    assert 20 < wire.counts["repeated_stops"] <= 30
    driver._serve(wire.session)
    assert driver.warning == NO_STOP
    wire.session.ending = True
    wire.run(1.5)
    assert wire.errors == [NO_STOP]
    assert wire.session.ended
    assert wire.speed == 0.0


def test_a_robot_that_is_held_is_stopped_before_the_session_ends() -> None:
    wire = streaming()
    ticks = wire.firmware.board.ticks()
    wire.firmware.board.ticks = lambda: ticks  # type: ignore[method-assign]
    wire.velocities = (30, 30)
    wire.run(0.3)
    before = wire.sent.count(commands.BRAKE)
    wire.session.ending = True
    wire.run(0.05)
    assert wire.sent.count(commands.BRAKE) == before + 1
    assert wire.speed == 0.0
    wire.run(0.2)
    assert wire.session.ended
    assert wire.sent.count(commands.BRAKE) == before + 2


def test_wheels_that_are_turned_by_hand_are_reported_until_they_stand() -> None:
    wire = streaming()
    for _ in range(400):
        wire.world.drivetrain.ticks += 2.0
        wire.step()
    was_reported = wire.session.does_not_stop
    wire.run(0.3)
    assert (was_reported, wire.session.does_not_stop) == (True, False)
    assert wire.counts["ignored_stops"] == 1


def test_a_robot_that_hears_and_is_not_heard_is_stopped() -> None:
    wire = driving((60, 60))
    wire.hears = False
    wire.run(0.5)
    assert wire.errors == ["the robot has stopped sending wheel ticks"]
    assert wire.speed == 0.0


def test_a_robot_that_hears_nothing_stops_by_itself() -> None:
    """The velocity holds a second and then decays by a unit each tenth of a second."""
    wire = driving((20, 20))
    wire.is_heard = False
    wire.run(1.2 + 2.0 + 0.3)
    assert wire.speed < 0.02


def test_a_velocity_is_told_again_before_it_decays() -> None:
    wire = streaming()
    wire.velocities = (30, 30)
    wire.run(4.0)
    rates = np.diff([one.left for one in wire.ticks[-20:]]) / 0.02
    assert rates.mean() == pytest.approx(30 / 0.021, rel=0.02)


def test_a_robot_that_was_reset_is_set_up_anew() -> None:
    wire = driving((40, 40))
    before = wire.states[-1].pose
    wire.firmware.receive(commands.RESET)
    wire.step()
    assert wire.errors == ["the robot has been reset"]
    assert wire.speed == 0.0
    wire.velocities = (0, 0)
    wire.run(1.0)
    assert wire.session.connected
    # what it rolled out while its ticks began again is all that is missing
    assert np.linalg.norm(wire.states[-1].pose - before) < 0.03


def test_a_stall_of_the_link_loses_events_and_nothing_else() -> None:
    """Nobody takes its bytes for a while: its ring overflows, its ticks and its clock go on."""
    wire = driving((20, 20), {"reply_timeout_s": 1.0, "led_frequency": 0.0})
    for _ in range(100):
        wire.world.step()
    wire.run(0.5)
    wire.velocities = (0, 0)
    wire.run(0.3)
    assert not wire.errors
    assert wire.firmware.board.ring.dropped > 1000
    assert wire.odometry_error()[0] < 2e-4
    last = wire.packets[-1]
    assert abs(wire.world.now_ns - last.stamp_ns) < 20_000_000
    assert "corrupt_events" not in wire.counts


def test_a_long_stall_blocks_the_robot_and_the_driver_resets_it() -> None:
    """When its text has no room the main loop waits: motors keep their duty, and no command is obeyed."""
    wire = driving((40, 40))
    for _ in range(1000):
        wire.world.step()
        if not wire.firmware.board.is_blocked:
            wire.firmware.board.say("-S0 7400\n" * 20)
    assert wire.firmware.board.is_blocked
    wire.firmware.receive(commands.BRAKE)
    assert wire.speed > 0.1
    wire.velocities = (0, 0)
    wire.run(1.0)
    assert wire.speed == 0.0


@pytest.mark.parametrize("timestamps", ["16bit", "24bit", "delta"])
@pytest.mark.parametrize("pause_s", [3.0, 30.0])
def test_a_driver_that_is_stopped_for_a_while_misses_no_motion(pause_s: float, timestamps: str) -> None:
    """Its robot turns on; the oldest bytes wait in the buffers meanwhile, and are no news afterwards."""
    wire = driving((-9, 9), {"timestamps": timestamps}, FIRST_FIRMWARE)
    before, waiting = len(wire.states), b""
    end_ns = wire.world.now_ns + round(1e9 * pause_s)
    while wire.world.now_ns < end_ns:
        wire.world.step()
        waiting += wire.firmware.stream() if len(waiting) < 4096 else b""
    wire.velocities = (0, 0)
    stream = wire.firmware.stream
    wire.firmware.stream = lambda: waiting + stream()  # type: ignore[method-assign]
    wire.step()
    wire.firmware.stream = stream  # type: ignore[method-assign]
    wire.run(1.0)
    assert not wire.errors
    assert not wire.counts["ignored_stops"] + wire.counts["counter_restarts"]
    assert wire.odometry_error()[1] < 0.01
    stamps = np.array([one.stamp_ns for one in wire.states[before:]])
    assert stamps[0] > end_ns
    assert (np.diff(stamps) > 0).all()
    assert wire.world.now_ns - stamps[-1] < 30_000_000


def test_lines_that_are_no_ticks_are_counted() -> None:
    wire = streaming()
    wire.firmware.receive(b"!X\nx\n")
    wire.firmware.board.say("-S0 7400\n")
    wire.run(0.1)
    assert wire.counts["refused_commands"] == 2
    assert wire.counts["other_lines"] == 1


def test_polarity_is_a_choice() -> None:
    is_on = []
    for bit in (0, 1):
        wire = streaming({"on_bit": bit})
        wire.run(0.2)
        is_on.append(decode_events(wire.packets[-1].data, ENCODING, (128, 128)).is_on)
    np.testing.assert_array_equal(is_on[0], ~is_on[1])
