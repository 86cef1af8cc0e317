"""Calibration of infrared from recordings, and the import of recordings of Droplets."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ir_world import droplet, random_poses, readings_of
from scipy.stats import chi2

from swarm_loc_estimator.cli import calibrate_ir
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import BRIGHTNESS, POSE_STAMPED
from swarm_loc_estimator.common.messages.detections import encode_brightness
from swarm_loc_estimator.common.messages.poses import encode_pose_stamped
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.offline.calibration.infrared.board import read_board
from swarm_loc_estimator.offline.calibration.infrared.gains import MIN_EXCHANGES
from swarm_loc_estimator.offline.calibration.recording import read_recording
from swarm_loc_estimator.offline.datasets.droplets import (
    METRES_PER_PIXEL,
    DropletRecordingError,
    Exchange,
    ImportSettings,
    Sighting,
    clean,
    find_fiducials,
    import_recording,
    parse_line,
)
from swarm_loc_estimator.swarm.ir_board import IrGains, IrPlatform, PairGains, RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm

BEGIN_NS, STEP_NS = 1_700_000_000_000_000_000, 1_000_000_000
SPREAD = 0.1
Told = Callable[[FloatArray], FloatArray]
UNKNOWN_ID = 99


def described(names: str, first_id: int = 1, source: str = "droplet") -> list[Robot]:
    """Robots of one letter each."""
    platform = droplet(SPREAD) if source == "droplet" else load_ir_platform(source)
    return [Robot(n, camera=None, ir=RobotIr(first_id + k, platform, source)) for k, n in enumerate(names)]


def write_exchanges(
    bag: BagWriter,
    robots: list[Robot],
    count: int,
    seed: int,
    told: Told | None = None,
    truly: IrPlatform | None = None,
) -> FloatArray:
    """Robots that are somewhere else at every exchange, and the ground truth `told` of where they are.

    Their boards may be `truly` others than described.

    Returns:
        The true log-gains (2, robots, n).
    """
    rng = np.random.default_rng(seed)
    board = robots[0].ir
    assert board is not None
    platform, ids = board.platform, [robot.ir.id for robot in robots if robot.ir]
    logs = SPREAD * rng.standard_normal((2, len(robots), platform.n))
    receiver = rng.integers(0, len(robots), count)
    transmitter = (receiver + rng.integers(1, len(robots), count)) % len(robots)
    relative = random_poses(count, seed, 0.08, 0.28)
    gains = PairGains(np.exp(logs[0, receiver]), np.exp(logs[1, transmitter]), np.zeros((count, 4)))
    readings = np.rint(readings_of(truly or platform, relative, seed, gains))
    seen = np.column_stack(
        [relative[:, 0] * np.cos(relative[:, 1]), relative[:, 0] * np.sin(relative[:, 1]), relative[:, 2]]
    )
    places = rng.uniform(-1.0, 1.0, (count, 3))
    for k in range(count):
        stamp_ns = BEGIN_NS + k * STEP_NS
        name = robots[receiver[k]].name
        for power, matrix in enumerate(readings[k]):
            pair = (ids[receiver[k]], ids[transmitter[k]])
            data = encode_brightness(f"{name}/base_link", stamp_ns, pair, matrix, power)
            bag.write(f"{name}/brightness", stamp_ns, data)
        poses = ((receiver[k], places[k]), (transmitter[k], se2.compose(places[k], seen[k])))
        for robot, pose in poses:
            data = encode_pose_stamped(
                "map", np.array([stamp_ns]), np.atleast_2d(told(pose) if told else pose)
            )[0]
            bag.write(f"{robots[robot].name}/ground_truth", stamp_ns, data)
    return logs


def add_topics(bag: BagWriter, robots: list[Robot]) -> None:
    for robot in robots:
        bag.add_topic(f"{robot.name}/brightness", BRIGHTNESS)
        bag.add_topic(f"{robot.name}/ground_truth", POSE_STAMPED)


def recorded(folder: Path, robots: list[Robot], count: int, seed: int, **others: Any) -> FloatArray:
    """A bag with its swarm.yaml; returns the true log-gains."""
    with BagWriter(folder) as bag:
        add_topics(bag, robots)
        logs = write_exchanges(bag, robots, count, seed, **others)
    save_swarm(Swarm(tuple(robots)), folder / "swarm.yaml")
    return logs


def gains_of(file: Path) -> list[IrGains | None]:
    return [robot.ir.gains if robot.ir else None for robot in load_swarm(file).robots]


def error_of(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert calibrate_ir.main([str(argument) for argument in arguments]) == 1
    shown = capsys.readouterr()
    assert not shown.out
    assert shown.err.count("\n") == 1
    assert shown.err.endswith(".\n")
    return shown.err


@pytest.mark.parametrize("options", [(), ("--without-truth",)])
@pytest.mark.parametrize("seed", [1, 2])
def test_gains_come_out_within_their_sigmas_and_are_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], seed: int
) -> None:
    robots = described("abc")
    logs = recorded(tmp_path / "bag", robots, 300, seed)
    out = tmp_path / "made" / "calibrated.yaml"
    assert calibrate_ir.main([str(tmp_path / "bag"), "--out", str(out), *options]) == 0
    shown = capsys.readouterr().out
    assert out.with_suffix(".png").stat().st_size > 5_000
    assert f"{out} written" in shown
    assert all(f"\n{name} " in shown for name in "abc")
    assert "of 300 exchanges used" in shown
    assert re.search(r"\na, by sensor: saturation \[count\] \[((255|-) ?){6}\]\n", shown)
    saturated = re.search(r"\nsaturation determined for (\d+) of 18 sensors, noise for 0\n", shown)
    assert saturated
    assert int(saturated[1]) >= 6
    assert "saturate lower" not in shown
    assert (", 0 of them with ground truth" in shown) == bool(options)
    found = [gains for gains in gains_of(out) if gains is not None]
    error = np.log([[gains.sensor for gains in found], [gains.emitter for gains in found]]) - logs
    own = error - error.mean(axis=-1, keepdims=True)
    common = (error.mean(axis=-1)[0][:, None] + error.mean(axis=-1)[1])[~np.eye(3, dtype=bool)]
    sigma, common_sigma = (
        np.array([getattr(gains, name) for gains in found]) for name in ("sigma", "common_sigma")
    )
    assert sigma.max() < 0.4 * SPREAD
    assert np.sum((own / sigma[:, None]) ** 2) < chi2.ppf(1.0 - 1e-4, own.size - 6)
    both = np.hypot(common_sigma[:, None], common_sigma)[~np.eye(3, dtype=bool)]
    assert np.abs(common / both).max() < 4.0
    assert {robot.ir.source for robot in load_swarm(out).robots if robot.ir} == {"droplet"}


def test_each_kind_of_board_is_calibrated_by_itself_and_what_is_wrong_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A pair of Droplets, a pair of other boards, a robot that nobody heard, and a stranger."""
    droplets = described("abx")
    others = described("cd", 10, "epuck_twelve")
    earlier = IrGains((1.1,) * 6, (1.0,) * 6, 0.02)
    assert droplets[2].ir is not None
    droplets[2] = replace(droplets[2], ir=replace(droplets[2].ir, gains=earlier))
    folder = tmp_path / "bag"
    with BagWriter(folder) as bag:
        add_topics(bag, [*droplets, *others, Robot("stranger")])
        write_exchanges(bag, droplets[:2], 120, 3)
        write_exchanges(bag, others, 120, 4)
        dark = np.zeros((6, 6))
        for pair in ((1, UNKNOWN_ID), (1, 1), (2, 1), (1, 10)):
            bag.write("a/brightness", BEGIN_NS, encode_brightness("a/base_link", BEGIN_NS, pair, dark))
    save_swarm(Swarm((*droplets, *others)), folder / "swarm.yaml")
    assert calibrate_ir.main([str(folder), "--out", str(tmp_path / "out.yaml")]) == 0
    shown = capsys.readouterr().out
    wrong = "1 ir_hears_itself, 1 ir_other_board, 1 ir_unknown_id, 1 ir_wrong_receiver"
    assert f"Matrices not used: {wrong}." in shown
    assert "No robot of the swarm description has the topics stranger/brightness." in shown
    assert "as they were: x." in shown
    assert "platform droplet: " in shown
    assert "platform epuck_twelve: " in shown
    a, _, alone, c, _ = gains_of(tmp_path / "out.yaml")
    assert alone == earlier
    assert a is not None
    assert c is not None
    assert (len(a.sensor), len(c.sensor)) == (6, 12)
    assert 0.003 <= max(a.sigma, c.sigma) < 0.05


def test_a_board_that_cannot_be_calibrated_does_not_keep_others_from_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    droplets = described("ab")
    others = described("cd", 10, "epuck_twelve")
    with BagWriter(tmp_path / "bag") as bag:
        add_topics(bag, [*droplets, *others])
        write_exchanges(bag, droplets, 100, 5)
    save_swarm(Swarm((*droplets, *others)), tmp_path / "bag" / "swarm.yaml")
    assert calibrate_ir.main([str(tmp_path / "bag"), "--out", str(tmp_path / "out.yaml")]) == 0
    assert "Platform epuck_twelve: 0 exchanges are too few" in capsys.readouterr().out
    assert [gains is None for gains in gains_of(tmp_path / "out.yaml")] == [False, False, True, True]


def test_what_cannot_be_calibrated_is_said_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, swarm = tmp_path / "bag", tmp_path / "other.yaml"
    robots = described("ab")
    recorded(bag, robots, MIN_EXCHANGES - 1, 6)
    few = f"{MIN_EXCHANGES - 1} exchanges are too few, {MIN_EXCHANGES} are the least"
    assert f"recording 'bag': Platform droplet: {few}." in error_of(capsys, bag)
    assert "There is no bag" in error_of(capsys, tmp_path / "nowhere", "--swarm", bag / "swarm.yaml")
    assert "missing.yaml" in error_of(capsys, bag, "--swarm", tmp_path / "missing.yaml")
    save_swarm(Swarm((Robot("a"), Robot("b"))), swarm)
    assert "no robot of the swarm description has an infrared" in error_of(capsys, bag, "--swarm", swarm)
    save_swarm(Swarm(tuple(described("ab", 50))), swarm)
    unknown = error_of(capsys, bag, "--swarm", swarm)
    assert f"can be used: {2 * MIN_EXCHANGES - 2} ir_unknown_id." in unknown
    save_swarm(Swarm(tuple(described("xy"))), swarm)
    sentence = "recording 'bag' holds no <robot>/brightness of this swarm that can be used."
    strangers = "No robot of the swarm description has the topics a/brightness, b/brightness."
    assert f"{sentence} {strangers}" in error_of(capsys, bag, "--swarm", swarm)
    assert not (tmp_path / "out").exists()


def test_ground_truth_that_contradicts_what_was_read_calibrates_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of another run, say: gains less sure than before would come out of it."""
    robots = described("abc")
    rng = np.random.default_rng(8)
    recorded(tmp_path / "bag", robots, 60, 8, told=lambda _: rng.uniform(-0.15, 0.15, 3))
    said = error_of(capsys, tmp_path / "bag", "--out", tmp_path / "out.yaml")
    assert "What they read contradicts itself or the ground truth, and as they were: a, b, c." in said
    assert not (tmp_path / "out.yaml").exists()


@pytest.mark.parametrize("options", [(), ("--without-truth",)])
@pytest.mark.parametrize("seed", [11, 12, 13])
def test_robots_are_not_blamed_where_the_curves_of_their_board_are_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], seed: int
) -> None:
    """Lobes as wide as those of real Droplets, described as the paper has them."""
    robots, real = described("abc"), load_ir_platform("droplet_2016")
    truly = replace(droplet(SPREAD), sensor=real.sensor, emitter=real.emitter)
    recorded(tmp_path / "bag", robots, 100, seed, truly=truly)
    said = error_of(capsys, tmp_path / "bag", "--out", tmp_path / "out.yaml", *options)
    assert "Platform droplet: its curves do not hold" in said
    assert "`calibrate_ir --board`." in said
    assert not (tmp_path / "out.yaml").exists()


def test_a_saturation_that_is_lower_than_described_is_told_where_gains_fail_by_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robots = described("abc")
    recorded(tmp_path / "bag", robots, 300, 14, truly=replace(droplet(SPREAD), saturation=180.0))
    said = error_of(capsys, tmp_path / "bag", "--out", tmp_path / "out.yaml", "--without-truth")
    assert "Platform droplet: Sensors saturate lower than board and matrices say: a [0, " in said
    assert " at 180 of 255 counts" in said


QUARTER = 0.5 * math.pi
PLACES = {
    0x29: (300.0, 300.0, 0.3),
    0xA: (400.0, 310.0, 1.0),
    0xB: (320.0, 210.0, -2.0),
    0xC: (220.0, 380.0, 2.5),
}
ROOT = 0x29


def line(exchange: Exchange) -> str:
    rows = ",".join("{" + ",".join(f"{v:.0f}" for v in row) + "}" for row in exchange.readings.T)
    seen = ", ".join(
        f'"{s.id:04X}"->{{{s.x:.0f}, {s.y:.0f}, {math.degrees(s.orientation):.1f}}}'
        for s in exchange.sightings
    )
    ids = f'"{exchange.transmitter:04X}", "{exchange.receiver:04X}"'
    return f"{{{ids}, {{{rows}}}, {exchange.time_s:.3f}, {{{seen}}}}},"


def pose_at(robot: int) -> FloatArray:
    """Heading is the fiducial's orientation and a quarter turn, of the root a half."""
    x, y, orientation = PLACES[robot]
    turned = orientation + (2 if robot == ROOT else 1) * QUARTER
    return np.array([METRES_PER_PIXEL * x, METRES_PER_PIXEL * y, turned])


def exchanges(seed: int = 0, count: int = 60) -> list[Exchange]:
    """Robots that stand."""
    rng = np.random.default_rng(seed)
    platform = replace(load_ir_platform("droplet_2016"), noise=1.0)
    done = []
    for k in range(count):
        transmitter = (0xA, 0xB, 0xC)[k % 3]
        x, y, heading = se2.between(pose_at(ROOT), pose_at(transmitter))
        light = expected_brightness(platform, [[math.hypot(x, y), math.atan2(y, x), heading]])[0, 0]
        readings = np.rint(np.minimum(light + 15.0 * rng.standard_normal(light.shape), 2400.0))
        seen = tuple(Sighting(robot, *place) for robot, place in PLACES.items())
        done.append(Exchange(transmitter, ROOT, readings, 100.0 + k, seen))
    return done


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("nonsense", "not_an_exchange"),
        ('{"A", "B", {{1,2,3},{1,2,3}}, 1.0, {}},', "not_square"),
        ('{"A", "A", {{1,2,3},{1,2,3},{1,2,3}}, 1.0, {}},', "hears_itself"),
        ('{"A", "B", {{1,x,3},{1,2,3},{1,2,3}}, 1.0, {}},', "not_an_exchange"),
    ],
)
def test_what_is_no_exchange_is_dropped_with_its_reason(text: str, reason: str) -> None:
    assert parse_line(text) == reason


@pytest.mark.parametrize("seed", range(3))
def test_misread_ids_and_flips_are_put_right(seed: int) -> None:
    rng = np.random.default_rng(seed)
    right = exchanges(seed)
    wrong = []
    for one in right:
        seen = list(one.sightings)
        k = int(rng.integers(0, 12))
        if k < len(seen):  # a robot read as the root, its fiducial then a quarter turn off
            seen[k] = replace(
                seen[k], id=ROOT, orientation=seen[k].orientation + QUARTER * rng.integers(1, 4)
            )
        wrong.append(replace(one, sightings=tuple(seen)))
    truth = clean(wrong)
    assert sum(truth.remarks.values()) > 5
    for where in truth.poses[1:-1]:
        for robot, pose in where.items():
            x, y, orientation = PLACES[robot]
            assert (pose.x, pose.y) == (x, y)
            assert abs(float(se2.wrap_angle(pose.orientation - orientation))) < 1e-6
    assert np.mean([len(where) for where in truth.poses]) > 3.8


def test_a_robot_seen_once_has_no_pose() -> None:
    ones = exchanges(count=20)
    ones[10] = replace(ones[10], sightings=(*ones[10].sightings, Sighting(0xD, 600.0, 600.0, 0.0)))
    assert all(0xD not in where for where in clean(ones).poses)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_bag_holds_the_truth_however_the_image_is_turned(tmp_path: Path, mirrored: bool) -> None:
    ones = exchanges()
    if mirrored:
        ones = [
            replace(
                one, sightings=tuple(replace(s, y=-s.y, orientation=-s.orientation) for s in one.sightings)
            )
            for one in ones
        ]
    path = tmp_path / "recording.txt"
    path.write_text("{\n" + "\n".join(map(line, ones)) + "\n}", encoding="ascii")
    done = import_recording(path, tmp_path / "bag", ImportSettings(), lambda *_: None)
    assert (done.exchanges, done.with_truth, done.fiducials.handedness) == (60, 60, -1 if mirrored else 1)
    swarm = load_swarm(tmp_path / "bag" / "swarm.yaml")
    board = read_board(read_recording(tmp_path / "bag", swarm), swarm)
    assert len(board.data.receiver) == 60
    names = [swarm.robots[index].name for index in board.robots]
    for place, pose in zip(board.data.transmitter, board.data.poses, strict=True):
        robot = int(names[place].removeprefix("droplet_"), 16)
        dx, dy, heading = se2.between(pose_at(ROOT), pose_at(robot))
        np.testing.assert_allclose(pose[0], math.hypot(dx, dy), atol=1e-6)
        off = se2.wrap_angle(pose[1:] - [math.atan2(dy, dx), heading])
        np.testing.assert_allclose(off, 0.0, atol=2e-3)  # orientations are printed to a tenth of a degree


@pytest.mark.parametrize(("seed", "robot"), [(0, ROOT), (1, ROOT), (2, 0xB)])
def test_a_fiducial_that_is_misread_while_its_robot_stands_at_one_place_is_corrected(
    seed: int, robot: int
) -> None:
    """All robots move aside every 30 s; at two of these stands the fiducial is read turned by a half."""
    ones = []
    for stand in range(6):
        for k, one in enumerate(exchanges(seed + 10 * stand, count=24)):
            turn = 2 * QUARTER if stand in (2, 4) else 0.0
            seen = tuple(
                replace(s, x=s.x + 8.0 * stand, orientation=s.orientation + (turn if s.id == robot else 0.0))
                for s in one.sightings
            )
            ones.append(replace(one, time_s=100.0 + 40.0 * stand + k, sightings=seen))
    truth = clean(ones)
    fiducials = find_fiducials(ones, truth.poses, np.array(load_ir_platform("droplet_2016").angles))
    assert len(fiducials.misread) == 2
    for where in truth.poses:
        for name, pose in where.items():
            heading = fiducials.pose(name, pose, METRES_PER_PIXEL)[2]
            assert abs(float(se2.wrap_angle(heading - pose_at(name)[2]))) < 1e-6


def test_a_file_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.txt"
    path.write_text("hello\n", encoding="ascii")
    with pytest.raises(DropletRecordingError, match="holds no exchange"):
        import_recording(path, tmp_path / "bag", ImportSettings(), lambda *_: None)
