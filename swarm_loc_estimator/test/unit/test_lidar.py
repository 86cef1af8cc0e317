"""Scans of a lidar: what is used of them, what moves during them, other robots in them, and maps of them."""

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core_geometry import wrapped
from core_messages import odometry_bytes
from mapping_world import BEAMS, LIDAR, ROOM, SWEEP_NS, LidarRobot, scan_bytes, static
from numpy.typing import NDArray

from swarm_loc_estimator.cli.replay_map import main
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import LASER_SCAN, ODOMETRY, TRANSFORMS
from swarm_loc_estimator.common.se2 import between, compose, transform_points
from swarm_loc_estimator.mapping.map_file import load_map
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.mapper_feed import MapperFeed, MapperInput, SweepPairer
from swarm_loc_estimator.mapping.messages import LidarSweep, ScanMessage, read_sweep
from swarm_loc_estimator.mapping.scans import ScanStop
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.lidar import ScanRows
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.error_models import LidarModel
from swarm_loc_estimator.swarm.swarm import Robot, StartSigma, Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.robots_in_scans import Discs, discs

ODOMETRY_NS = 40_000_000
TURTLE = Robot(
    "a", start=tuple(LidarRobot.start.tolist()), start_sigma=StartSigma(1e-3, 1e-3, 1e-3), lidar=LIDAR
)


def messages(until_ns: int, seed: int) -> list[tuple[MapperInput, int, bytes]]:
    """What the robot sends: odometry, and each sweep when it is over."""
    robot = LidarRobot(np.random.default_rng(seed))
    sent = [
        (MapperInput.ODOMETRY, at_ns, odometry_bytes("a", at_ns, robot.odometry(np.array([at_ns]))[0]))
        for at_ns in range(0, until_ns + 1, ODOMETRY_NS)
    ]
    sweeps = range(0, until_ns - SWEEP_NS + 1, SWEEP_NS)
    sent += [(MapperInput.SCAN, at_ns + SWEEP_NS, scan_bytes(robot.scan(at_ns))) for at_ns in sweeps]
    return sorted(sent, key=lambda one: one[1])


def changed(ranges: list[float], **fields: Any) -> ScanMessage:
    last = 0.1 * (len(ranges) - 1)
    return ScanMessage(5, 0.0, last, 0.1, 0.0, 0.2, 4.0, np.array(ranges))._replace(**fields)


def swept(scan: ScanMessage, lidar: LidarModel = LidarModel(range_sigma=0.01)) -> LidarSweep:
    drops: Counter[str] = Counter()
    sweep = read_sweep(scan, lidar, drops, Counter())
    assert sweep is not None
    assert not drops
    return sweep


def one_stop(pairer: SweepPairer, scan: ScanMessage) -> ScanStop:
    pairer.add_odometry(0, np.zeros(3))
    pairer.add_scan(scan)
    pairer.add_odometry(10, np.zeros(3))
    (stop,) = pairer.ready()
    return stop


def test_beams_that_say_nothing_are_counted_by_reason_and_the_others_are_used() -> None:
    pairer = SweepPairer(LidarModel(range_sigma=0.01, range_sigma_per_m=0.01, min_range=0.3))
    ranges = [1.0, math.nan, math.inf, -math.inf, 0.0, 0.1, 0.25, 4.5, 3.0, -1.0]
    stop = one_stop(pairer, changed(ranges))
    assert dict(pairer.dropped_beams) == {"beam_not_a_number": 1, "beam_too_near": 5, "beam_too_far": 1}
    assert not pairer.drops
    assert stop.bearing == pytest.approx([0.0, 0.2, 0.8])
    assert stop.inverse == pytest.approx([1.0, 0.0, 1.0 / 3.0])
    assert stop.reach == 4.0
    sigma = stop.sigma / np.sqrt(stop.weight)
    assert sigma == pytest.approx([0.02, 0.05 / 16.0, 0.04 / 9.0])


@pytest.mark.parametrize("range_max", [0.0, math.inf, math.nan, 50.0])
def test_a_range_beyond_what_is_described_is_free_space(range_max: float) -> None:
    pairer = SweepPairer(LidarModel(range_sigma=0.01, max_range=2.0))
    stop = one_stop(pairer, changed([1.0, 3.0, math.inf], range_max=range_max))
    assert stop.inverse == pytest.approx([1.0, 0.0, 0.0])
    assert stop.reach == 2.0
    assert not any(pairer.dropped_beams.values())


@pytest.mark.parametrize(
    ("ranges", "fields", "reason"),
    [
        ([1.0, 1.0], {"angle_increment": 0.0}, "scan_bad_geometry"),
        ([1.0, 1.0], {"angle_min": math.nan}, "scan_bad_geometry"),
        ([1.0, 1.0], {"time_increment": math.inf}, "scan_bad_times"),
        ([1.0, 1.0], {"time_increment": -2.1}, "scan_bad_times"),
        ([1.0, 1.0], {"time_increment": 2.1}, "scan_bad_times"),
        ([1.0] * 72, {}, "scan_bad_geometry"),
        ([], {}, "scan_without_beams"),
        ([math.nan, 0.0], {}, "scan_without_beams"),
        ([1.0, 1.0], {"stamp_ns": -1}, "scan_too_old"),
    ],
)
def test_a_scan_that_cannot_be_used_is_dropped_with_a_reason(
    ranges: list[float], fields: dict[str, Any], reason: str
) -> None:
    pairer = SweepPairer(LIDAR)
    pairer.add_scan(changed([1.0], stamp_ns=0))
    pairer.add_scan(changed(ranges, **fields))
    assert dict(pairer.drops) == {reason: 1}
    assert [one.inverse.size for one in pairer.ready()] == []  # there is no odometry yet


@pytest.mark.parametrize("angle_max", [0.2, 9.0, -1.0, math.nan])
def test_a_beam_is_where_its_number_says_however_many_there_are(angle_max: float) -> None:
    for step in (0.1, -0.1):
        sweep = swept(changed([1.0] * 5, angle_min=1.0, angle_max=angle_max, angle_increment=step))
        assert sweep.angle == pytest.approx(1.0 + step * np.arange(5))


def test_what_met_nothing_is_no_wall() -> None:
    """Range_max, also rounded, 0, NaN and infinities; a wall just before range_max is one."""
    nothing = [4.0, 4.0 - 1e-6, 4.0 + 1e-6, 0.0, math.nan, math.inf, -math.inf]
    sweep = swept(changed([*nothing, 3.9]))
    assert sweep.distance[sweep.seen] == pytest.approx([3.9])


def test_times_of_beams_go_with_time_increment() -> None:
    forwards, backwards = (swept(changed([1.0, math.nan, 1.0], time_increment=dt)) for dt in (0.5, -0.5))
    assert (forwards.beam_ns - 5).tolist() == [0, 1_000_000_000]
    assert (backwards.beam_ns - 5).tolist() == [0, -1_000_000_000]
    assert (forwards.backwards().beam_ns - 5).tolist() == [1_000_000_000, 0]


def test_a_lidar_upside_down_sees_mirrored() -> None:
    scan = changed([1.0, 2.0, 3.0], angle_increment=0.5)
    upright, mounted = LidarModel(yaw=0.3, x=0.1), LidarModel(yaw=0.3, x=0.1, roll=math.pi)
    mirrored = swept(scan._replace(angle_increment=-0.5), upright).ends(np.zeros((3, 3)))
    assert swept(scan, mounted).ends(np.zeros((3, 3))) == pytest.approx(mirrored)


def test_scans_without_odometry_do_not_wait_for_ever() -> None:
    pairer = SweepPairer(LIDAR)
    for k in range(60):
        pairer.add_scan(changed([1.0], stamp_ns=k))
    assert pairer.drops["scan_without_odometry"] == 10
    pairer.add_odometry(70, np.zeros(3))
    assert not list(pairer.ready())
    assert pairer.drops["scan_without_odometry"] == 60


def test_the_motion_during_a_sweep_is_taken_out_of_it() -> None:
    """Walls are where they are, seen from where the robot was at the first beam, wherever the lidar sits."""
    robot, pairer, begin_ns = LidarRobot(), SweepPairer(LIDAR), 1_010_000_000
    for at_ns in range(1_000_000_000, 1_300_000_000, ODOMETRY_NS):
        pairer.add_odometry(at_ns, robot.odometry(np.array([at_ns]))[0])
    pairer.add_scan(robot.scan(begin_ns))
    (stop,) = pairer.ready()
    assert stop.stamp_ns[0] == begin_ns
    assert compose(robot.start, stop.arrival) == pytest.approx(robot.pose(begin_ns), abs=1e-9)
    angle = stop.bearing + stop.turn
    points = np.stack([np.cos(angle), np.sin(angle)], axis=-1) / stop.inverse[:, None]
    x, y = transform_points(robot.pose(begin_ns), points).T
    off = np.min(np.abs([x - ROOM[0], x - ROOM[2], y - ROOM[1], y - ROOM[3]]), axis=0)
    on_walls = (y < ROOM[3] + 1e-3) & ((x < 1.19) | (x > 2.01) | (y < 2.0))  # but for the niche
    assert on_walls.sum() > 300
    assert off[on_walls].max() < 1e-6
    moved = between(robot.pose(begin_ns), robot.pose(begin_ns + SWEEP_NS))
    assert stop.turn[-1] == pytest.approx(moved[2] * (BEAMS - 1) / BEAMS, abs=1e-6)


@pytest.mark.parametrize("late_ns", [300_000_000, -300_000_000])
def test_a_described_delay_puts_a_sweep_where_it_was_measured(late_ns: int) -> None:
    robot, begin_ns = LidarRobot(), 1_000_000_000
    pairer = SweepPairer(replace(LIDAR, delay_s=-1e-9 * late_ns))
    pairer.add_scan(robot.scan(begin_ns)._replace(stamp_ns=begin_ns + late_ns))
    for at_ns in range(0, 2_000_000_000, ODOMETRY_NS):
        pairer.add_odometry(at_ns, robot.odometry(np.array([at_ns]))[0])
    (stop,) = pairer.ready()
    assert stop.stamp_ns[0] == begin_ns
    assert stop.arrival == pytest.approx(robot.odometry(np.array([begin_ns]))[0], abs=1e-4)


def test_a_mount_that_comes_late_counts_for_sweeps_that_wait_for_odometry() -> None:
    robot = LidarRobot()
    late, known = SweepPairer(replace(LIDAR, x=0.0, y=0.0, yaw=0.0)), SweepPairer(LIDAR)
    for pairer in (late, known):
        pairer.add_scan(robot.scan(0))
    late.mount(LIDAR)
    for at_ns in range(0, 2 * SWEEP_NS, ODOMETRY_NS):
        for pairer in (late, known):
            pairer.add_odometry(at_ns, robot.odometry(np.array([at_ns]))[0])
    (stop,), (expected,) = late.ready(), known.ready()
    assert stop.ends == pytest.approx(expected.ends, abs=1e-9)


class Wanderer(LidarRobot):
    """A robot that stands, and then drives to and fro and looks around."""

    def odometry(self, stamp_ns: NDArray[np.int64]) -> FloatArray:
        """Poses (n, 3) by odometry at times (n,)."""
        time_s = np.maximum(1e-9 * stamp_ns - 2.0, 0.0)
        return np.stack([0.4 * np.sin(0.7 * time_s), 0.0 * time_s, 0.8 * np.sin(1.1 * time_s)], axis=-1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("late_ns", [0, 200_000_000])
def test_the_mapper_finds_that_scans_are_stamped_late(late_ns: int, seed: int) -> None:
    mapper, robot = CooperativeMapper(), Wanderer(np.random.default_rng(seed))
    feed = MapperFeed([TURTLE], mapper, {})
    for at_ns in range(0, 25_000_000_000, ODOMETRY_NS):
        feed.add(0, MapperInput.ODOMETRY, odometry_bytes("a", at_ns, robot.odometry(np.array([at_ns]))[0]))
        if at_ns % SWEEP_NS == 0 and at_ns >= SWEEP_NS:
            scan = robot.scan(at_ns - late_ns)._replace(stamp_ns=at_ns)
            feed.add(0, MapperInput.SCAN, scan_bytes(scan))
    assert [("older" in one) for one in feed.late] == [True] * (late_ns > 0)
    located = mapper.tracks[0].located
    assert located is not None
    assert wrapped(located.pose - robot.pose(located.stamp_ns)) == pytest.approx(0.0, abs=0.04)


def test_a_robot_that_does_not_stop_makes_a_map() -> None:
    mapper = CooperativeMapper()
    feed = MapperFeed([TURTLE], mapper, {})
    assert list(feed.missing()) == ["a/odom", "a/scan"]
    for kind, _, data in messages(12_000_000_000, seed=3):
        feed.add(0, kind, data)
    mapper.finish()
    assert not feed.all_drops
    assert 10 <= mapper.graph.count <= 20
    robot = LidarRobot()
    truth = np.array([robot.pose(at_ns) for at_ns in mapper.begin_ns.values()])
    off = between(truth, mapper.graph.poses)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.02
    assert np.abs(off[:, 2]).max() < math.radians(0.6)
    located = mapper.tracks[0].located
    assert located is not None
    assert located.pose == pytest.approx(robot.pose(located.stamp_ns), abs=0.03)
    assert mapper.goal(0) is None
    occupancy = mapper.occupancy()
    x, y = occupancy.centres(occupancy.occupied).T
    outside = np.min(np.abs([x - ROOM[0], x - ROOM[2], y - ROOM[1], y - ROOM[3]]), axis=0)
    assert len(x) > 300
    assert np.median(outside) < 0.02
    assert occupancy.free[tuple(occupancy.index(LidarRobot.start[None, :2])[0])]


def test_a_robot_that_stands_adds_one_sweep() -> None:
    mapper, robot = CooperativeMapper(), LidarRobot()
    feed = MapperFeed([TURTLE], mapper, {})
    scan = robot.scan(0)._replace(time_increment=0.0)
    for k in range(20):
        feed.add(0, MapperInput.ODOMETRY, odometry_bytes("a", k * SWEEP_NS, np.zeros(3)))
        feed.add(0, MapperInput.SCAN, scan_bytes(scan._replace(stamp_ns=k * SWEEP_NS)))
    assert mapper.graph.count == mapper.counters["scans"] == 1


def test_odometry_that_restarts_does_not_move_the_robot_in_the_map() -> None:
    mapper, robot = CooperativeMapper(), LidarRobot(np.random.default_rng(1))
    feed = MapperFeed([TURTLE], mapper, {})
    for at_ns in range(0, 8_000_000_000, ODOMETRY_NS):
        pose = robot.odometry(np.array([at_ns]))[0]
        shift = [3.0, 0.0, 1.0] if at_ns >= 4_000_000_000 else np.zeros(3)
        feed.add(0, MapperInput.ODOMETRY, odometry_bytes("a", at_ns, compose(shift, pose)))
        if at_ns % SWEEP_NS == 0:
            feed.add(0, MapperInput.SCAN, scan_bytes(robot.scan(at_ns)))
    assert mapper.counters["odometry_restarts"] == 1
    located = mapper.tracks[0].located
    assert located is not None
    assert located.pose == pytest.approx(robot.pose(located.stamp_ns), abs=0.06)


@pytest.mark.parametrize(("start_error", "seed"), [(0.0, 1), (0.0, 2), (0.04, 3)])
def test_other_robots_are_no_walls_of_the_map(start_error: float, seed: int) -> None:
    """One drives past another that stands, with a pillar as wide beside it that stays in the map."""
    there, pillar, radius, maps = np.array([0.6, 0.5]), np.array([2.8, 0.6]), 0.15, []
    for described in (0.0, radius):
        rng, mapper = np.random.default_rng(seed), CooperativeMapper()
        lidar = replace(LIDAR, robot_radius=described)
        standing = replace(TURTLE, name="b", lidar=lidar, start=(there[0] + start_error, there[1], 0.0))
        feed = MapperFeed([replace(TURTLE, lidar=lidar), standing], mapper, {})
        robot, still = LidarRobot(rng), LidarRobot(rng)
        for at_ns in range(0, 12_000_000_000, ODOMETRY_NS):
            feed.add(
                0, MapperInput.ODOMETRY, odometry_bytes("a", at_ns, robot.odometry(np.array([at_ns]))[0])
            )
            feed.add(1, MapperInput.ODOMETRY, odometry_bytes("a", at_ns, np.zeros(3)))
            if at_ns % SWEEP_NS == 0:
                scan, beams = robot.scan(at_ns), np.arange(BEAMS)
                at = compose(robot.start, robot.odometry(at_ns + SWEEP_NS // BEAMS * beams))
                mount = compose(at, [LIDAR.x, LIDAR.y, LIDAR.yaw])
                angle = mount[:, 2] + scan.angle_increment * beams
                for disc in (there, pillar):
                    x, y = (disc - mount[:, :2]).T
                    along, across = (
                        x * np.cos(angle) + y * np.sin(angle),
                        y * np.cos(angle) - x * np.sin(angle),
                    )
                    met = (np.abs(across) < radius) & (along > 0.0)
                    near = along[met] - np.sqrt(radius**2 - across[met] ** 2)
                    scan.ranges[met] = np.minimum(scan.ranges[met], near)
                feed.add(0, MapperInput.SCAN, scan_bytes(scan))
                if at_ns == 0:
                    feed.add(
                        1,
                        MapperInput.SCAN,
                        scan_bytes(still.scan(at_ns)._replace(ranges=np.full(BEAMS, np.inf))),
                    )
        mapper.finish()
        cells = mapper.occupancy().centres(mapper.occupancy().occupied)
        maps.append([int((np.hypot(*(cells - disc).T) < radius + 0.05).sum()) for disc in (there, pillar)])
    assert maps[0][0] > 10
    assert maps[1][0] == 0
    assert maps[1][1] > 0.8 * maps[0][1] > 10


def test_a_bag_is_mapped_the_same_twice_and_by_other_topics_and_mounts_of_transforms(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As of a robot without a namespace, whose lidar only its URDF describes."""
    joint = static(("base_link", "a/base_scan", (LIDAR.x, LIDAR.y, 0.2), (LIDAR.yaw, 0.0, 0.0)))
    for name, space in (("described", "a/"), ("found", "")):
        with BagWriter(tmp_path / name) as bag:
            for topic, message_type in (
                ("tf_static", TRANSFORMS),
                (f"{space}odom", ODOMETRY),
                (f"{space}scan", LASER_SCAN),
            ):
                bag.add_topic(topic, message_type)
            bag.write("tf_static", 0, joint)
            for kind, at_ns, data in messages(5_000_000_000, seed=1):
                bag.write(f"{space}{kind.topic}", at_ns, data)
    bare = replace(TURTLE, lidar=replace(LIDAR, x=0.0, y=0.0, yaw=0.0))
    save_swarm(Swarm((TURTLE,)), tmp_path / "described" / "swarm.yaml")
    save_swarm(Swarm((bare,)), tmp_path / "found" / "swarm.yaml")
    assert main([str(tmp_path / "described"), "--out", str(tmp_path / "x")]) == 0
    shown = capsys.readouterr().out
    assert "tf_static" not in shown
    assert "beam_too_near" not in shown
    remap = [part for topic in ("odom", "scan") for part in ("--remap", f"a/{topic}:=/{topic}")]
    assert main([str(tmp_path / "found"), "--out", str(tmp_path / "y"), *remap]) == 0
    assert "Mount of a's lidar by tf_static: x 0.050, y -0.020, yaw 1.571." in capsys.readouterr().out
    described, found = (
        np.loadtxt(tmp_path / one / "stops.csv", skiprows=1, delimiter=",", usecols=(2, 3, 4)) for one in "xy"
    )
    assert found == pytest.approx(described, abs=1e-6)
    assert main([str(tmp_path / "described"), "--out", str(tmp_path / "again")]) == 0
    first, again = (
        {path.name: path.read_bytes() for path in (tmp_path / one).iterdir()} for one in ("x", "again")
    )
    assert first == again
    assert set(first) == {"map.yaml", "map.pgm", "map.png", "stops.csv"}
    assert load_map(tmp_path / "x" / "map.yaml", 0.02).occupied.sum() > 200


RADIUS, RAYS, PERIOD_NS, RANGE_SIGMA = 0.15, 360, 200_000_000, 0.01
ANGLES = 2.0 * math.pi / RAYS * np.arange(RAYS)
Circle = tuple[float, float, float]  # x [m], y [m], radius [m]


def ranges_to(circles: list[Circle], away: float, rng: np.random.Generator) -> FloatArray:
    """Ranges (RAYS,) from the origin to the first of circles, or to a round wall."""
    out = np.full(RAYS, away)
    for x, y, radius in circles:
        along, across = x * np.cos(ANGLES) + y * np.sin(ANGLES), y * np.cos(ANGLES) - x * np.sin(ANGLES)
        met = (np.abs(across) < radius) & (along > 0.0)
        out[met] = np.minimum(out[met], along[met] - np.sqrt(radius**2 - across[met] ** 2))
    return out + RANGE_SIGMA * rng.standard_normal(RAYS)


def found_in(ranges: FloatArray) -> Discs:
    ends = ranges[:, None] * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)
    return discs(ends, np.zeros(2), np.full(RAYS, RANGE_SIGMA**2), ANGLES.astype(np.float64), RADIUS)


@pytest.mark.parametrize("seed", range(6))
def test_a_robot_is_found_in_a_scan_wherever_it_stands(seed: int) -> None:
    """Also across the first beam."""
    rng = np.random.default_rng(seed)
    for bearing in (0.0, *rng.uniform(-math.pi, math.pi, 8).tolist()):
        away = float(rng.uniform(0.6, 3.0))
        centre = away * np.array([math.cos(bearing), math.sin(bearing)])
        found = found_in(ranges_to([(*centre, RADIUS)], 5.0, rng))
        assert len(found.centre) == 1
        sigma = np.sqrt(found.variance[0].max() + found.variance[0, 1] * away**2)
        assert np.hypot(*(found.centre[0] - centre)) < 4.0 * sigma
        assert sigma < 0.05


@pytest.mark.parametrize(
    "circles",
    [
        [(1.5, 0.0, 0.03)],  # a pole
        [(1.5, 0.0, 0.6)],  # a column
        [(2.0, 0.0, RADIUS), (1.0, 0.12, 0.08)],  # a robot that is half hidden, by something narrower
        [],
    ],
)
def test_what_is_no_robot_is_not_found(circles: list[Circle]) -> None:
    assert not len(found_in(ranges_to(circles, 5.0, np.random.default_rng(3))).centre)


def drive(radius: float, seed: int) -> Estimate:
    """Two robots, of which one drives around the other; it starts 15 cm from where it is believed to."""
    rng, until_ns = np.random.default_rng(seed), 6_000_000_000
    lidar = LidarModel(range_sigma=RANGE_SIGMA, range_sigma_per_m=0.0, robot_radius=radius)
    wide, narrow = StartSigma(0.2, 0.2, 0.05), StartSigma(0.001, 0.001, 0.001)
    b = Robot("b", start=(1.5, 0.15, 0.5 * math.pi), start_sigma=wide)
    estimator = Estimator(Swarm((Robot("a", start=(0.0, 0.0, 0.0), start_sigma=narrow, lidar=lidar), b)))
    for now_ns in range(PERIOD_NS, until_ns + 1, PERIOD_NS):
        stamps = np.arange(now_ns - PERIOD_NS, now_ns + 1, 20_000_000)
        turn = 0.1e-9 * stamps
        around = np.stack([1.5 * np.sin(turn), 1.5 * (1.0 - np.cos(turn)), turn], axis=-1)
        poses = np.concatenate([np.zeros((len(stamps), 3)), around])
        robots, both = np.repeat([0, 1], len(stamps)), np.tile(stamps, 2)
        begin_ns, scan = now_ns - PERIOD_NS, np.empty(1, dtype=object)
        bearing = 0.1e-9 * (begin_ns + 0.5 * PERIOD_NS)
        centre = 1.5 * math.cos(bearing), 1.5 * math.sin(bearing)
        ranges = ranges_to([(*centre, RADIUS)], 5.0, rng)
        step = 2.0 * math.pi / RAYS
        scan[0] = ScanMessage(begin_ns, 0.0, 2.0 * math.pi, step, 0.0, 0.1, 12.0, ranges)
        at_ns, arrival_ns = np.array([begin_ns]), np.array([now_ns])
        rows = OdometryRows(robots, both, poses, np.full_like(poses, np.nan), both)
        scans = ScanRows(np.zeros(1, dtype=np.int64), at_ns, scan, arrival_ns)
        estimator.receive(Batch.of(begin_ns, now_ns, odometry=rows, scans=scans))
        estimate = estimator.tick(now_ns)
    return estimate


@pytest.mark.parametrize("seed", range(3))
def test_scans_tell_where_another_robot_is_without_a_map(seed: int) -> None:
    seen, unseen = drive(RADIUS, seed), drive(0.0, seed)
    truth = 1.5 * np.array([math.cos(0.6), math.sin(0.6)])
    error = seen.poses[1, :2] - truth
    assert np.hypot(*error) < 0.04
    assert np.hypot(*(unseen.poses[1, :2] - truth)) == pytest.approx(0.15, abs=0.01)
    assert error @ np.linalg.solve(seen.covariances[1, :2, :2], error) < 14.0
