"""Recordings of Droplets under a camera: parsing, cleaning, fiducials, and the bag that comes of them."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.offline.calibration.infrared.board import read_board
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
from swarm_loc_estimator.swarm.ir_board import load_ir_platform
from swarm_loc_estimator.swarm.swarm_file import load_swarm

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


def exchanges(seed: int = 0, count: int = 60) -> list[Exchange]:
    """Robots that stand; heading is the fiducial's orientation and a quarter turn, of the root a half."""
    rng = np.random.default_rng(seed)
    platform = replace(load_ir_platform("droplet_2016"), noise=1.0)
    done = []
    for k in range(count):
        transmitter = (0xA, 0xB, 0xC)[k % 3]
        poses = {
            robot: np.array(
                [METRES_PER_PIXEL * x, METRES_PER_PIXEL * y, o + (2 if robot == ROOT else 1) * QUARTER]
            )
            for robot, (x, y, o) in PLACES.items()
        }
        x, y, heading = se2.between(poses[ROOT][None], poses[transmitter][None])[0]
        light = expected_brightness(platform, [[math.hypot(x, y), math.atan2(y, x), heading]])[0, 0]
        readings = np.rint(np.minimum(light + 15.0 * rng.standard_normal(light.shape), 2400.0))
        seen = tuple(Sighting(robot, *place) for robot, place in PLACES.items())
        done.append(Exchange(transmitter, ROOT, readings, 100.0 + k, seen))
    return done


def test_a_line_that_is_written_is_read_back() -> None:
    (one,) = exchanges(count=1)
    read = parse_line(line(one))
    assert isinstance(read, Exchange)
    assert (read.transmitter, read.receiver, read.time_s) == (one.transmitter, one.receiver, one.time_s)
    np.testing.assert_array_equal(read.readings, one.readings)
    assert [s.id for s in read.sightings] == [s.id for s in one.sightings]


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
        x, y, o = PLACES[ROOT]
        other = PLACES[robot]
        there = np.array([[METRES_PER_PIXEL * other[0], METRES_PER_PIXEL * other[1], other[2] + QUARTER]])
        here = np.array([[METRES_PER_PIXEL * x, METRES_PER_PIXEL * y, o + 2 * QUARTER]])
        dx, dy, heading = se2.between(here, there)[0]
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
            expected = PLACES[name][2] + (2 if name == ROOT else 1) * QUARTER
            assert abs(float(se2.wrap_angle(heading - expected))) < 1e-6


def test_a_file_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.txt"
    path.write_text("hello\n", encoding="ascii")
    with pytest.raises(DropletRecordingError, match="holds no exchange"):
        import_recording(path, tmp_path / "bag", ImportSettings(), lambda *_: None)
