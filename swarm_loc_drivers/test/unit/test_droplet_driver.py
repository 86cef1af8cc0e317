"""Droplets: what their consoles print, infrared of exchanges, and calibration."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from droplet_rig import IDEAL, LINK, SECOND, TRIANGLE, read_by, world_of
from hypothesis import given
from hypothesis import strategies as st

from bench.scenarios.bags import write_droplet_bag
from bench.scenarios.droplets_run import DropletRunSettings, simulate_droplets
from swarm_loc_drivers.droplet import protocol as console
from swarm_loc_drivers.droplet.hardware import (
    DIRECTIONS,
    ELEMENTS,
    EXCHANGE_NS,
    FULL_POWER,
    TURN_CLOCKWISE,
    TURN_COUNTERCLOCKWISE,
    gait,
    message_ns,
)
from swarm_loc_drivers.droplet.protocol import (
    BROKEN,
    UNKNOWN,
    ConsoleParser,
    Echo,
    Event,
    Identity,
    Matrix,
    MotorTrims,
    MoveStarted,
    Noted,
    Said,
    SendAborted,
    StepLength,
)
from swarm_loc_drivers.sim.droplet.infrared import ExchangeReadings, InfraredCommand
from swarm_loc_drivers.sim.droplet.world import NEAR_POWER, STEP_NS, DropletErrors, DropletWorld
from swarm_loc_estimator.cli import calibrate_ir
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm

ROWS = tuple(tuple(range(10 * emitter, 10 * emitter + 6)) for emitter in range(6))
SIGNED = ((-29, 13, -44, -31, 31, 44), *ROWS[1:])


def in_braces(rows: Sequence[Sequence[int]]) -> str:
    return "{" + ",".join("{" + ",".join(map(str, row)) + "}" for row in rows) + "}"


def named(rows: Sequence[Sequence[int]]) -> str:
    return f'{{"6B6F", "DF64", {in_braces(rows)}}},\r\n'


def of_2014(rows: Sequence[Sequence[int]]) -> str:
    return f"{in_braces(rows)};\r\n"


def of_2016(rows: Sequence[Sequence[int]]) -> str:
    lines = ["\t{" + ",".join(f"{cell:4d}" for cell in row) + "}" for row in rows]
    return "{\r\n" + ",\r\n".join(lines) + f"\r\n}}; sum={sum(map(sum, rows))}\r\n"


def of_july_2016(rows: Sequence[Sequence[int]]) -> str:
    return of_2016(rows).partition(" sum=")[0] + "\r\n"


NOTED = [
    ('Broadcasting command to 0029: "rnb_b", of length 5.', ""),
    ('Broadcasting command: "reset", of length 5.', ""),
    ('Broadcasting command: "res", of length 5.', UNKNOWN),
    ("RNB Broadcast failed [ 4C ]", "failed_emissions"),
    ("\t(RNB) ID: 6B6F | R:  173 B:  -90 H:   45", "range_bearings"),
    ("!!!\tGot 15 consecutive nothings from sensor 3.\t!!!", "silent_sensors"),
    ("!!! something else !!!", "firmware_errors"),
    ("\tCommand ( dance ) not recognized.", "unknown_commands"),
    ("ERROR: Serial input buffer capacity of 64 characters exceeded.", "overflows"),
    ("ERROR! Should NOT be.", "firmware_errors"),
    ("Motor Values", ""),
    ("Dist (mm) per kilostep", ""),
    ("hello", UNKNOWN),
]
PRINTED: list[tuple[str, Event]] = [
    ("get_id\r\n", Echo("get_id")),
    ("My ID is: DF64\r\n", Identity(0xDF64)),
    ("My ID is: 29\r\n", Identity(0x29)),
    ("move_steps 0 50\r\n", Echo("move_steps 0 50")),
    ("walk 0 50\r\n", Echo("walk 0 50")),
    ("walk direction 0, num_steps 50\r\n", MoveStarted(0, 50)),
    ("Aborting IR send [0a] while trying: rnb_b\r\n", SendAborted(10)),
    (named(SIGNED), Matrix(0x6B6F, 0xDF64, SIGNED)),
    (of_2014(ROWS), Matrix(None, None, ROWS)),
    (of_2016(ROWS), Matrix(None, None, ROWS)),
    (of_july_2016(ROWS), Matrix(None, None, ROWS)),
    ("\tdir: 7\t-25\t0\t31\t\r\n", MotorTrims(7, (-25, 0, 31))),
    ("\t7\t65535\r\n", StepLength(7, 65535)),
    *((f"{text}\r\n", Noted(reason, text)) for text, reason in NOTED),
]
WHOLE = "".join(text for text, _ in PRINTED).encode()


def events(data: bytes, parser: ConsoleParser | None = None) -> list[Event]:
    return [said.event for said in (parser or ConsoleParser()).feed(data, 0)]


@pytest.mark.parametrize(("text", "event"), PRINTED, ids=[text.split("\r")[0].strip() for text, _ in PRINTED])
def test_every_line_is_understood(text: str, event: Event) -> None:
    assert events(text.encode()) == [event]


@given(cuts=st.lists(st.integers(0, len(WHOLE)), max_size=30))
def test_bytes_may_come_in_pieces_of_any_size(cuts: list[int]) -> None:
    parser = ConsoleParser()
    ends = [*sorted(cuts), len(WHOLE)]
    pieces = [WHOLE[begin:end] for begin, end in zip([0, *ends], ends, strict=False)]
    assert [one for piece in pieces for one in events(piece, parser)] == [event for _, event in PRINTED]


@st.composite
def corrupted(draw: st.DrawFn) -> bytes:
    """The print-outs with bytes lost, changed and added."""
    data = bytearray(WHOLE)
    for _ in range(draw(st.integers(1, 8))):
        begin = draw(st.integers(0, len(data)))
        end = min(len(data), begin + draw(st.integers(0, 120)))
        data[begin:end] = draw(st.binary(max_size=12))
    return bytes(data)


@given(data=corrupted())
def test_garbage_never_makes_a_matrix_of_another_size_and_is_forgotten(data: bytes) -> None:
    parser = ConsoleParser()
    for event in events(data, parser):
        if isinstance(event, Matrix):
            assert [len(row) for row in event.brightness] == [ELEMENTS] * ELEMENTS
    events(b"\r\n\r\n", parser)
    assert events(WHOLE, parser)[1:] == [event for _, event in PRINTED][1:]


@pytest.mark.parametrize("layout", [named, of_2014, of_2016])
def test_a_matrix_that_is_not_whole_is_broken_and_the_next_is_read(layout: object) -> None:
    assert callable(layout)
    text: str = layout(ROWS)
    for cut in (text.replace(",13", "", 1).replace(",  13", "", 1), text.replace("2", "x", 1)):
        found = events((cut + text).encode())
        assert any(isinstance(event, Noted) and event.reason == BROKEN for event in found), cut
        assert isinstance(found[-1], Matrix)
        assert sum(isinstance(event, Matrix) for event in found) == 1


@pytest.mark.parametrize("layout", [named, of_2014, of_2016])
def test_a_matrix_of_another_platform_has_its_size(layout: object) -> None:
    assert callable(layout)
    rows = np.arange(64).reshape(8, 8).tolist()
    (event,) = events(layout(rows).encode(), ConsoleParser(8))
    assert isinstance(event, Matrix)
    assert np.array(event.brightness).tolist() == rows
    assert not any(isinstance(event, Matrix) for event in events(layout(rows).encode()))


def test_a_line_is_stamped_with_its_first_character() -> None:
    parser = ConsoleParser()
    assert parser.feed(b"\r\n", 1) == []
    assert parser.feed(b"My ID", 2) == []
    assert parser.feed(b" is: DF64", 3) == []
    assert parser.feed(b"\r\nget", 4) == [Said(2, Identity(0xDF64))]
    assert parser.feed(b"_id\r\n", 5) == [Said(4, Echo("get_id"))]
    text = of_2016(ROWS).encode()
    assert parser.feed(text[:20], 6) == []
    assert parser.feed(text[20:], 7) == [Said(6, Matrix(None, None, ROWS))]


def test_what_is_taken_back_disappears() -> None:
    parser = ConsoleParser()
    parser.feed(b"stop" + 6 * b"\b \b" + b"get_i", 0)
    assert parser.partial == "get_i"
    assert events(b"d\r\n", parser) == [Echo("get_id")]


def test_an_endless_line_does_not_fill_the_memory() -> None:
    parser = ConsoleParser()
    for _ in range(100):
        parser.feed(b"{1234567890" * 10, 0)
    assert len(parser.partial) < 1000
    (event,) = events(b"\r\n", parser)
    assert isinstance(event, Noted)
    assert event.reason == BROKEN


@pytest.mark.parametrize("line", ["", "x" * 64, "get_id\r", "get\nid", "get_id\x00", "gét_id"])
def test_what_no_line_may_hold_is_refused(line: str) -> None:
    with pytest.raises(console.CommandError, match="1 to 63 printable"):
        console.typed(line)


def test_what_the_firmware_has_no_room_for_is_refused() -> None:
    console.for_robot(1, "x" * 31)
    with pytest.raises(console.CommandError, match="31"):
        console.for_robot(1, "x" * 32)
    with pytest.raises(console.CommandError, match="power 257"):
        console.set_power(257)


def test_directions_go_clockwise_from_the_front() -> None:
    steps = [gait(direction, (1, -1, 0), 300) for direction in DIRECTIONS]
    walks = np.array([[step.forward, step.left] for step in steps[:6] if step])
    angles = np.rad2deg(np.arctan2(walks[:, 1], walks[:, 0]))
    assert np.mod(angles, 360.0) == pytest.approx([0, 300, 240, 180, 120, 60], abs=1e-9)
    assert np.hypot(*walks.T) == pytest.approx(300e-6)
    clockwise, counter = steps[TURN_CLOCKWISE], steps[TURN_COUNTERCLOCKWISE]
    assert clockwise is not None
    assert counter is not None
    assert (clockwise.turn, counter.turn) == pytest.approx((-math.radians(0.3), math.radians(0.3)))


def test_a_step_lasts_as_long_as_its_motors_take() -> None:
    one, two = gait(0, (0, 0, 32), 300), gait(0, (-64, 0, 32), 300)
    assert one is not None
    assert two is not None
    assert one.step_s == pytest.approx(61 * 1.024e-3)
    assert two.step_s == pytest.approx((62 + 61) * 1.024e-3)
    assert gait(0, (0, 0, 0), 300) is None


def test_an_uncalibrated_direction_has_the_firmwares_own_guess() -> None:
    walk, turn = gait(3, (-1, -1, -1), 0xFFFF), gait(7, (-1, -1, -1), 0xFFFF)
    assert walk is not None
    assert turn is not None
    assert walk.forward == pytest.approx(-600e-6)
    assert turn.turn == pytest.approx(math.radians(2.0))


def with_link(**changes: float) -> DropletErrors:
    return replace(IDEAL, infrared=replace(LINK, **changes))


def run(world: DropletWorld, duration_ns: int) -> None:
    for _ in range(-(-duration_ns // STEP_NS)):
        world.step()


def exchange(world: DropletWorld, emitter: int = 0, power: int = FULL_POWER) -> dict[int, FloatArray]:
    """Robot -> what it read (n, n), emitters by sensors."""
    world.infrared.emit(emitter, power, world.poses)
    run(world, EXCHANGE_NS)
    found: dict[int, FloatArray] = {}
    for robot, heard in enumerate(world.infrared.heard):
        for one in heard:
            if isinstance(one, ExchangeReadings):
                found[robot] = one.readings.astype(float)
        heard.clear()
    return found


@pytest.mark.parametrize(("power", "mode"), [(FULL_POWER, 0), (NEAR_POWER, 1)])
def test_sensors_read_what_the_board_makes_of_the_poses(power: int, mode: int) -> None:
    world = world_of()
    found = exchange(world, power=power)
    assert set(found) == {1, 2}
    for robot, readings in found.items():
        exact = np.clip(np.rint(read_by(world, robot, 0)[mode].T), 0.0, 255.0)
        assert (readings == exact).all()


def test_power_in_between_shines_in_between() -> None:
    world = world_of(np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.5]]))
    totals = [exchange(world, power=power)[1].sum() for power in (0, NEAR_POWER, 150, FULL_POWER)]
    assert totals[0] == 0.0
    assert totals == sorted(totals)


def test_elements_differ_by_their_gains() -> None:
    world = world_of(np.array([[0.0, 0.0, 0.0], [0.18, 0.0, 0.5]]), replace(IDEAL, gain_sigma=0.1))
    bright = read_by(world, 1, 0)[0].T
    shares = exchange(world)[1] / np.where(bright > 8.0, bright, np.nan)
    gains = world.gains[1, 0][:, None] * world.gains[0, 1][None]
    shown = ~np.isnan(shares)
    assert np.abs(shares - gains)[shown].max() < 0.07
    assert np.abs(shares - 1.0)[shown].max() > 0.08


def test_counts_end_where_the_converter_does_and_ambient_light_is_taken_off() -> None:
    start = np.array([[0.0, 0.0, 0.0], [0.07, 0.0, 0.5]])
    world = world_of(start, with_link(ambient=8.0), noise=1.0)
    run(world, 6 * SECOND)
    readings = exchange(world)[1]
    assert 247 <= readings.max() <= 255
    assert (readings == 255).sum() < (readings > 245).sum()
    dim = read_by(world, 1, 0)[0].T < 0.5
    assert np.abs(readings[dim]).max() <= 6
    assert abs(readings[dim].mean()) < 2.0


def test_a_robot_in_between_casts_a_shadow() -> None:
    line = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.5]])
    free = exchange(world_of(line))[1]
    next_to_it = np.vstack([line, [0.1, 0.03, 0.0]])
    partly = exchange(world_of(next_to_it))[1]
    hidden = partly == 0.0
    assert hidden[free > 5.0].any()
    assert (partly[~hidden] == free[~hidden]).all()
    between = np.vstack([line, [0.1, 0.0, 0.0]])
    assert set(exchange(world_of(between))) == {2}


def test_messages_reach_so_far() -> None:
    world = world_of(np.array([[0.0, 0.0, 0.0], [0.0, 0.29, 0.0], [0.31, 0.0, 0.0]]))
    world.infrared.send(0, "get_id", 0, world.poses)
    run(world, message_ns(6))
    assert [len(heard) for heard in world.infrared.heard] == [0, 1, 0]


def test_as_many_get_lost_as_described() -> None:
    share, count = 0.2, 500
    world = world_of(errors=with_link(loss=share))
    for _ in range(count):
        world.infrared.send(0, "x", 0, world.poses)
        run(world, message_ns(1))
    heard = sum(len(one) for one in world.infrared.heard)
    expected_count, sigma = 2 * count * (1.0 - share), np.sqrt(2 * count * share * (1.0 - share))
    assert abs(heard - expected_count) < 5.0 * sigma


def test_who_speaks_at_the_same_time_is_not_understood() -> None:
    world = world_of()
    world.infrared.send(0, "get_id", 0, world.poses)
    run(world, STEP_NS)
    world.infrared.send(1, "get_id", 0, world.poses)
    run(world, SECOND)
    assert not any(world.infrared.heard)
    assert world.infrared.counts["collided"] == 4


def test_who_measured_when_a_message_began_does_not_understand_it() -> None:
    far = np.vstack([TRIANGLE[:2], [0.35, 0.02, 0.0]])  # hears the second, and not the first
    world = world_of(far)
    world.infrared.emit(0, FULL_POWER, world.poses)
    run(world, EXCHANGE_NS - 2 * STEP_NS)
    world.infrared.send(2, "get_id", 0, world.poses)
    run(world, 2 * STEP_NS)
    assert not world.infrared.status(0)
    run(world, message_ns(6))
    assert [type(one) for one in world.infrared.heard[1]] == [ExchangeReadings]
    assert world.infrared.counts["exchanges"] == 1
    world.infrared.send(2, "get_id", 0, world.poses)
    run(world, message_ns(6))
    assert [type(one) for one in world.infrared.heard[1]] == [ExchangeReadings, InfraredCommand]


def test_light_of_two_at_once_adds_up() -> None:
    row = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.4, 0.0, 0.0]])
    alone = exchange(world_of(row), power=FULL_POWER)[1]
    world = world_of(row)
    world.infrared.emit(0, FULL_POWER, world.poses)
    run(world, 30_000_000)
    world.infrared.emit(2, FULL_POWER, world.poses)
    run(world, EXCHANGE_NS)
    (both,) = (one.readings for one in world.infrared.heard[1] if isinstance(one, ExchangeReadings))
    assert (both >= alone).all()
    assert both.sum() > 1.2 * alone.sum()


SETTINGS = DropletRunSettings(seed=1, duration_s=40.0, robots=8, start_known=True, boards=1)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two recordings of robots that have the same elements and move differently."""
    folder = tmp_path_factory.mktemp("bags")
    for seed in (1, 51):
        write_droplet_bag(simulate_droplets(replace(SETTINGS, seed=seed)), folder / f"{seed}", "", seed)
    return [folder / "1", folder / "51"]


def position_rmse(bag: Path, swarm: Swarm) -> float:
    return replay(bag, swarm).overall.position_rmse


@pytest.fixture(scope="module")
def plain_rmse(bags: list[Path]) -> float:
    """Of the second recording, not calibrated."""
    return position_rmse(bags[1], load_swarm(bags[1] / "swarm.yaml"))


@pytest.mark.parametrize("options", [(), ("--without-truth",)])
def test_a_calibration_helps_in_another_recording(
    bags: list[Path], plain_rmse: float, tmp_path: Path, options: tuple[str, ...]
) -> None:
    out = tmp_path / "calibrated.yaml"
    assert calibrate_ir.main([str(bags[0]), "--out", str(out), *options]) == 0
    plain = load_swarm(bags[1] / "swarm.yaml")
    boards = {robot.name: robot.ir for robot in load_swarm(out).robots}
    known = replace(plain, robots=tuple(replace(robot, ir=boards[robot.name]) for robot in plain.robots))
    assert position_rmse(bags[1], known) < 0.8 * plain_rmse


def test_boards_fix_the_gains_of_elements_and_nothing_else() -> None:
    short = replace(SETTINGS, duration_s=4.0, robots=4, calibrated=True)
    first, moved, other = (
        simulate_droplets(one) for one in (short, replace(short, seed=2), replace(short, boards=2))
    )
    gains = [
        np.array([robot.ir.gains.sensor for robot in run.swarm.robots if robot.ir and robot.ir.gains])
        for run in (first, moved, other)
    ]
    np.testing.assert_allclose(gains[0], gains[1], rtol=0.2)  # told to 2 %
    assert np.abs(gains[0] / gains[2] - 1.0).max() > 0.2
    assert np.abs(first.truth.poses[0] - moved.truth.poses[0]).max() > 0.01
    np.testing.assert_array_equal(first.truth.poses[0], other.truth.poses[0])
