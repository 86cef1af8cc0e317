"""The mapper: one robot and two in a small room, whatever the messages' sizes, and what it says of itself."""

import math
from collections.abc import Sequence
from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from core_messages import odometry_bytes
from mapping_world import ROOM, RoomRobot, distance_in_room

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.messages.cdr import LASER, encode
from swarm_loc_estimator.common.se2 import between, compose, wrap_angle
from swarm_loc_estimator.mapping import localization
from swarm_loc_estimator.mapping.mapper import SCAN_TURN, CooperativeMapper
from swarm_loc_estimator.mapping.mapper_feed import MapperFeed, MapperInput
from swarm_loc_estimator.mapping.relocation import Search
from swarm_loc_estimator.mapping.scans import LightSightings, MotionTracker, Readings, ScanStop
from swarm_loc_estimator.mapping.settings import MapperSettings
from swarm_loc_estimator.swarm.swarm import Robot

START = (1.0, 1.0, 0.3)
KNOWN = np.full(3, 1e-3)
MIDDLE = (1.7, 1.3)
FIRST_TURNS = ((0.5 * math.pi, 0.25), (4.0 * math.pi, 0.6))


def look_around(robot: RoomRobot) -> list[Readings]:
    return [robot.turn(angle, rate) for angle, rate in FIRST_TURNS]


def feed(mapper: CooperativeMapper, number: int, parts: Sequence[Readings]) -> None:
    for part in parts:
        mapper.add_readings(number, part)


def to_goal(mapper: CooperativeMapper, number: int, robot: RoomRobot) -> list[Readings]:
    """What a robot reads on the way to its goal and around there."""
    goal = mapper.goal(number)
    assert goal is not None
    return [*robot.go_to(goal.odometry), robot.turn(SCAN_TURN)]


def explore(mapper: CooperativeMapper, number: int, robot: RoomRobot, hops: int) -> None:
    feed(mapper, number, look_around(robot))
    for _ in range(hops):
        feed(mapper, number, to_goal(mapper, number, robot))


def error_of(mapper: CooperativeMapper, number: int, robot: RoomRobot) -> tuple[float, float]:
    """Of position [m] and heading [rad]."""
    pose = mapper.pose(number)
    assert pose is not None
    return math.dist(pose[:2], robot.pose[:2]), abs(float(wrap_angle(pose[2] - robot.pose[2])))


def assert_near(
    mapper: CooperativeMapper, number: int, robot: RoomRobot, metres: float = 0.03, degrees: float = 2.0
) -> None:
    position, heading = error_of(mapper, number, robot)
    assert position < metres
    assert heading < math.radians(degrees)


def mapped(seed: int, hops: int, slip: float = 0.02) -> tuple[CooperativeMapper, RoomRobot]:
    """A robot alone that has gone to so many goals; a test may change what it gets."""
    found = _mapped(seed, hops, slip)
    factor = found[0].graph._factor  # which never changes, and SciPy does not copy
    return deepcopy(found, {id(factor): factor})


@cache
def _mapped(seed: int, hops: int, slip: float) -> tuple[CooperativeMapper, RoomRobot]:
    mapper, robot = CooperativeMapper(), RoomRobot(START, slip, np.random.default_rng(seed))
    explore(mapper, mapper.join(np.array(START), KNOWN), robot, hops)
    return mapper, robot


@pytest.mark.parametrize(("slip", "seed"), [(0.0, 1), (0.02, 2), (0.05, 3)])
def test_a_robot_that_slips_knows_where_it_is_and_draws_the_walls(slip: float, seed: int) -> None:
    mapper, robot = mapped(seed, 5, slip)
    mapper.finish()
    position, heading = error_of(mapper, 0, robot)
    assert position < 0.02
    assert heading < 3.0 * mapper.settings.turn_noise * 2.0 * math.pi  # of the last turn
    assert abs(mapper.graph.slip[0] - slip) < 0.002
    occupancy = mapper.occupancy()
    walls = occupancy.centres(occupancy.occupied)
    assert len(walls) > 200
    off = [min(abs(x - ROOM[0]), abs(x - ROOM[2]), abs(y - ROOM[1]), abs(y - ROOM[3])) for x, y in walls]
    assert np.median(off) < 0.02
    middle = occupancy.index(np.array([[1.7, 1.3]]))[0]
    assert occupancy.free[tuple(middle)]


def cut(readings: Readings, size: int) -> list[Readings]:
    """The same in messages of another size."""
    bounds = range(0, len(readings.stamp_ns), size)
    return [
        Readings(readings.stamp_ns[part], readings.odometry[part], readings.inverse[part], readings.sigma)
        for part in (slice(k, k + size) for k in bounds)
    ]


def test_the_size_of_messages_does_not_matter() -> None:
    recorded, whole = [], CooperativeMapper()
    robot = RoomRobot(START, 0.02, np.random.default_rng(4))
    whole.join(np.array(START), KNOWN)
    recorded += look_around(robot)
    feed(whole, 0, recorded)
    for _ in range(2):
        parts = to_goal(whole, 0, robot)
        feed(whole, 0, parts)
        recorded += parts
    for size in (1, 37):
        other = CooperativeMapper()
        other.join(np.array(START), KNOWN)
        feed(other, 0, [piece for part in recorded for piece in cut(part, size)])
        assert np.array_equal(whole.graph.states, other.graph.states)
        assert np.array_equal(whole.occupancy().log_odds, other.occupancy().log_odds)
        assert whole.visits.on(whole.occupancy()).sum() == other.visits.on(other.occupancy()).sum()


def test_two_robots_share_a_map_and_one_may_leave() -> None:
    mapper = CooperativeMapper()
    first = RoomRobot(START, 0.0, np.random.default_rng(5))
    start = (2.2, 1.4, -1.0)
    second = RoomRobot(start, 0.03, np.random.default_rng(6))
    mapper.join(np.array(START), KNOWN)
    explore(mapper, 0, first, 1)
    told = np.add(start, [0.08, -0.07, math.radians(4.0)])
    number = mapper.join(told, np.array([0.1, 0.1, math.radians(5.0)]))
    assert mapper.goal(number) is None
    assert mapper.pose(number) is None
    explore(mapper, number, second, 2)
    assert_near(mapper, number, second, degrees=1.0)
    assert abs(mapper.graph.slip[number] - 0.03) < 0.004
    count = mapper.graph.count
    mapper.leave(number)
    feed(mapper, 0, to_goal(mapper, 0, first))
    assert mapper.graph.count == count + 1


def test_odometry_that_begins_anew_is_no_drive() -> None:
    mapper, robot = mapped(10, 2)
    robot.odometry = np.array([40.0, -7.0, 2.0])
    robot.pose[:2] += [0.04, -0.03]  # somebody has pushed it a little, too
    seek(mapper, robot)
    assert mapper.counters["odometry_restarts"] == 1
    assert_near(mapper, 0, robot)


def restart(robot: RoomRobot, turn: float, drive: float, pause_s: float = 3.0) -> None:
    """Its driver restarts; unheard it turns and drives."""
    robot.turn(turn)
    robot.drive(drive)
    robot.pass_time(pause_s)
    robot.odometry = np.zeros(3)


def seek(mapper: CooperativeMapper, robot: RoomRobot) -> None:
    """Look around, and at more places until it is found."""
    feed(mapper, 0, look_around(robot))
    for _ in range(8):
        if mapper.goal(0) is not None:
            return
        while distance_in_room(*robot.pose) < 0.6:
            feed(mapper, 0, [robot.turn(1.0)])
        feed(mapper, 0, [robot.drive(0.4), robot.turn(SCAN_TURN)])
        feed(mapper, 0, [robot.rest(1.2)])


@pytest.mark.parametrize(
    ("turn", "drive", "times"), [(2.1, 0.0, 1), (-0.7, 0.0, 2), (0.3, 0.4, 1), (0.0, 0.0, 2)]
)
@pytest.mark.parametrize("seed", [20, 21])
def test_a_robot_that_moves_unheard_while_its_driver_restarts_is_found_by_its_scan(
    turn: float, drive: float, times: int, seed: int
) -> None:
    mapper, robot = mapped(seed, 3)
    before = mapper.graph.poses.copy()
    for _ in range(times):
        restart(robot, turn, drive)
        seek(mapper, robot)
    assert mapper.counters["odometry_restarts"] == times
    assert mapper.counters["places_taken_back"] == 0
    assert_near(mapper, 0, robot)
    assert np.abs((mapper.graph.poses[: len(before)] - before)[:, :2]).max() < 0.03


@pytest.mark.parametrize("moves", [0.0, 0.5])
@pytest.mark.parametrize("seed", [20, 21, 22])
def test_a_robot_whose_wheels_turn_while_something_holds_it_is_where_its_scan_says(
    moves: float, seed: int
) -> None:
    mapper, robot = mapped(seed, 3)
    while distance_in_room(*robot.pose) < 1.0:
        feed(mapper, 0, [robot.turn(0.5)])
    for _ in range(2):
        before = robot.pose[:2].copy()
        feed(mapper, 0, [robot.drive(0.7, moves), robot.turn(SCAN_TURN)])
        assert math.dist(before, robot.pose[:2]) == pytest.approx(moves * 0.7)
        assert_near(mapper, 0, robot)
    assert mapper.counters["drives_held"] == 2


@pytest.mark.parametrize("seed", [20, 21, 22])
def test_a_lost_robot_that_something_holds_has_looked_from_one_place_only(seed: int) -> None:
    mapper, robot = mapped(seed, 3)
    restart(robot, 2.1, 0.0)
    feed(mapper, 0, look_around(robot))
    while distance_in_room(*robot.pose) < 0.6:
        feed(mapper, 0, [robot.turn(1.0)])
    arrival = np.append(robot.pose[:2], 0.0)
    feed(mapper, 0, [robot.drive(0.4, 0.0)])
    arrival[2] = robot.pose[2]
    feed(mapper, 0, [robot.turn(SCAN_TURN), robot.rest(1.2)])
    search = mapper.tracks[0].search
    assert search is not None
    assert search.poses.shape[1] == 1
    off = search.poses[:, -1] - arrival
    is_aligned = np.abs(wrap_angle(off[:, 2])) < math.radians(5.0)
    assert (is_aligned & (np.hypot(off[:, 0], off[:, 1]) < 0.03)).any()


@pytest.mark.parametrize(
    ("held", "other", "found"), [((0.0, 0.0), 0.6, 0), ((2.0, 0.0), 0.95, -1), ((0.0, 2.0), 0.6, 0)]
)
def test_a_place_is_not_ruled_out_because_something_held_the_robot_on_its_way(
    held: tuple[float, float], other: float, found: int
) -> None:
    poses = np.array([[[0.0, 0.0, 0.0]] * 3, [[0.5, 0.0, 0.0]] * 3])
    fits, known = np.array([[0.98] * 3, [other] * 3]), np.ones((2, 3))
    assert Search(np.zeros(3), 2.0, poses, fits, known, np.zeros(2), np.array(held)).verdict() == found


@pytest.mark.parametrize(("newest", "found"), [((0.95, 0.9), 0), ((0.84, 0.79), -1)])
def test_a_place_that_fits_less_and_less_is_not_found(newest: tuple[float, ...], found: int) -> None:
    """The true one has been ruled out before."""
    fits = np.array([[0.96, 0.97, 0.95, 0.92, *newest]])
    nothing = np.zeros(1)
    search = Search(np.zeros(3), 2.0, np.zeros((1, 6, 3)), fits, np.ones((1, 6)), nothing, nothing)
    assert search.verdict() == found


def test_a_robot_that_is_found_is_not_searched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """In halls whose parts look alike a second search may find another place, 26 cm away."""
    mapper, robot = mapped(20, 3)
    monkeypatch.delattr(localization, "search_offsets")
    restart(robot, 2.1, 0.0)
    seek(mapper, robot)
    assert_near(mapper, 0, robot)
    assert mapper.counters["places_taken_back"] == 0


def test_a_robot_whose_scan_fits_two_places_leaves_the_map_as_it_is() -> None:
    mapper, robot = CooperativeMapper(), RoomRobot((*MIDDLE, 0.3), 0.0, np.random.default_rng(22))
    robot.has_niche = False
    explore(mapper, mapper.join(np.array([*MIDDLE, 0.3]), KNOWN), robot, 2)
    located = mapper.tracks[0].located
    restart(robot, 2.0, 0.0)
    feed(mapper, 0, [robot.turn(0.1)])
    before, walls = mapper.graph.poses.copy(), mapper.occupancy().log_odds.copy()
    feed(mapper, 0, [*look_around(robot), robot.drive(0.3), robot.turn(SCAN_TURN)])
    assert mapper.counters["scans_not_located"] > 0
    assert mapper.pose(0) is None
    assert mapper.goal(0) is None
    assert mapper.tracks[0].located is located
    assert np.array_equal(mapper.graph.poses, before)
    assert np.array_equal(mapper.occupancy().log_odds, walls)


def test_a_lost_robot_follows_its_odometry_where_the_map_tells_nothing() -> None:
    mapper, robot = mapped(22, 2, 0.0)
    restart(robot, 2.0, 0.0)
    arrivals = [robot.pose.copy()]
    feed(mapper, 0, look_around(robot))
    search = mapper.tracks[0].search
    assert search is not None
    search.poses = np.array([[compose([50.0, 0.0, 0.0], arrivals[0])]])
    search.fits, search.known = np.zeros((2, 1, 1))
    search.lit, search.held = np.zeros((2, 1))
    feed(mapper, 0, [robot.drive(0.3)])
    arrivals.append(robot.pose.copy())
    feed(mapper, 0, [robot.turn(SCAN_TURN), robot.rest(1.2)])
    assert search.poses.shape == (1, 2, 3)
    off = between(*search.poses[0]) - between(*arrivals)
    assert math.hypot(off[0], off[1]) < 0.03
    assert abs(wrap_angle(off[2])) < math.radians(2.0)


def at_a_wrong_place(patch: pytest.MonkeyPatch) -> tuple[CooperativeMapper, RoomRobot, FloatArray]:
    """A robot that is found, but not where it is; the poses of the stops before its restart, too."""
    mapper, robot = mapped(23, 3)
    before = mapper.graph.poses.copy()
    restart(robot, 2.1, 0.0)

    def wrong(search: Search) -> int:
        """The hypothesis that is furthest from the truth."""
        return int(np.hypot(*(search.poses[:, -1, :2] - robot.pose[:2]).T).argmax())

    with patch.context() as inside:
        inside.setattr(Search, "verdict", wrong)
        seek(mapper, robot)
    assert error_of(mapper, 0, robot)[0] > 0.3
    assert mapper.graph.count > len(before)
    return mapper, robot, before


def test_a_place_that_later_stops_contradict_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper, robot, before = at_a_wrong_place(monkeypatch)
    for _ in range(4):
        if mapper.goal(0) is None:
            seek(mapper, robot)
        else:
            feed(mapper, 0, to_goal(mapper, 0, robot))
    assert mapper.counters["places_taken_back"] > 0
    assert_near(mapper, 0, robot)
    assert np.abs((mapper.graph.poses[: len(before)] - before)[:, :2]).max() < 0.03
    assert len(mapper.begin_ns) < mapper.graph.count  # the stops at the wrong place count no more


def test_a_place_is_taken_back_where_a_robot_restarts_before_it_is_confirmed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapper, robot, before = at_a_wrong_place(monkeypatch)
    restart(robot, 0.7, 0.0)
    feed(mapper, 0, [robot.turn(0.1)])
    assert mapper.pose(0) is None
    assert len(mapper.begin_ns) == len(before)
    assert not mapper.graph.scans.beams.counts[len(before) : mapper.graph.count].any()
    seek(mapper, robot)
    assert error_of(mapper, 0, robot)[0] < 0.03


def lights_of(
    readings: Readings, heading: float, place: FloatArray, target: int, there: FloatArray
) -> LightSightings:
    """What a robot without slip that turns at a place (2,), at last to a heading, sees of one at another."""
    turned = wrap_angle(readings.odometry[:, 2] - readings.odometry[-1, 2])
    x, y = there - place
    bearing = wrap_angle(math.atan2(y, x) - heading - turned)
    seen = np.abs(bearing) < 0.5
    count = int(seen.sum())
    return LightSightings(
        readings.stamp_ns[seen], np.full(count, target), bearing[seen], np.full(count, 0.02)
    )


@pytest.mark.parametrize("sees", [True, False])
def test_lights_tell_at_which_of_two_places_that_look_alike_a_robot_is(sees: bool) -> None:
    """In a room without a niche, of two robots one is lost, which sees the other one or is seen by it."""
    mapper, starts = CooperativeMapper(), [(*MIDDLE, 0.3), (0.8, 0.8, 1.0)]
    lost, other = robots = [
        RoomRobot(one, 0.0, np.random.default_rng(22 + k)) for k, one in enumerate(starts)
    ]
    for number, robot in enumerate(robots):
        robot.has_niche = False
        mapper.join(np.array(starts[number]), KNOWN)
        explore(mapper, number, robot, 1)
    restart(lost, 2.0, 0.0)
    feed(mapper, 0, look_around(lost))
    assert mapper.pose(0) is None
    for _ in range(2):
        while distance_in_room(*lost.pose, has_niche=False) < 0.6:
            feed(mapper, 0, [lost.turn(1.0)])
        feed(mapper, 0, [lost.drive(0.4)])
        other.catch_up(lost)
        scans = [lost.turn(SCAN_TURN), other.turn(SCAN_TURN)]
        for number, scan in enumerate(scans):
            if (number == 0) == sees:
                to = robots[1 - number].pose[:2]
                seen = lights_of(scan, float(robots[number].pose[2]), robots[number].pose[:2], 1 - number, to)
                mapper.add_lights(number, seen)
            mapper.add_readings(number, scan)
        feed(mapper, 0, [lost.rest(1.2)])
        goal = mapper.goal(1)
        assert goal is not None
        feed(mapper, 1, other.go_to(goal.odometry))
    feed(mapper, 0, [lost.drive(0.1), lost.turn(SCAN_TURN), lost.rest(1.2)])
    assert_near(mapper, 0, lost)


@pytest.mark.parametrize(
    ("pause_s", "odometry", "jumps"), [(1.0, 0.0, True), (1.0, 1.0, False), (0.1, 0.0, False)]
)
def test_odometry_near_zero_after_a_pause_is_a_restart(pause_s: float, odometry: float, jumps: bool) -> None:
    robot, tracker = RoomRobot(START, 0.0, None), MotionTracker()
    assert not any(run.jumps for part in (robot.drive(0.3), robot.turn(1.0)) for run in tracker.runs(part))
    robot.pass_time(pause_s)
    robot.odometry *= odometry
    assert any(run.jumps for run in tracker.runs(robot.turn(0.2))) == jumps


@pytest.mark.parametrize(
    ("turn", "drive", "times"), [(4.0 * SCAN_TURN, 0.0, 1), (2.0 * SCAN_TURN, 0.3, 1), (0.0, 0.0, 0)]
)
@pytest.mark.parametrize("seed", [20, 21])
def test_motion_of_which_only_the_end_is_heard_is_unknown(
    turn: float, drive: float, times: int, seed: int
) -> None:
    """Nothing is heard while a robot goes on; its odometry goes on, too, but tells no whole turns."""
    mapper, robot = mapped(seed, 3)
    robot.turn(turn)
    robot.drive(drive)
    robot.pass_time(3.0)
    seek(mapper, robot)
    assert mapper.counters["odometry_restarts"] == times
    assert_near(mapper, 0, robot, degrees=3.0)


def test_a_robot_that_cannot_leave_looks_again_and_gets_another_goal() -> None:
    mapper, robot = mapped(11, 1)
    count, first = mapper.graph.count, mapper.goal(0)
    feed(mapper, 0, [robot.turn(0.7), robot.turn(SCAN_TURN), robot.turn(-0.4), robot.turn(SCAN_TURN)])
    second = mapper.goal(0)
    assert mapper.graph.count == count + 2
    assert first is not None
    assert second is not None
    assert second.number == first.number + 2
    assert np.allclose(mapper.graph.poses[count:, :2], mapper.graph.poses[count - 1, :2], atol=0.01)
    assert_near(mapper, 0, robot, 0.02)


def test_a_full_map_still_locates_robots() -> None:
    mapper = CooperativeMapper(MapperSettings(max_stops=12))
    robot = RoomRobot(START, 0.02, np.random.default_rng(9))
    explore(mapper, mapper.join(np.array(START), KNOWN), robot, 7)
    assert mapper.graph.count == 13
    assert max(mapper.graph.targets) < 13
    assert_near(mapper, 0, robot)


def test_a_start_that_is_far_from_where_scans_put_it_stays_as_told() -> None:
    mapper = CooperativeMapper()
    first = RoomRobot(START, 0.0, np.random.default_rng(12))
    second = RoomRobot((2.2, 1.4, -1.0), 0.0, np.random.default_rng(13))
    mapper.join(np.array(START), KNOWN)
    explore(mapper, 0, first, 1)
    before = mapper.graph.poses.copy()
    told = np.array([2.0, 1.3, -0.9])  # 22 cm off, and said to be right to 1 cm
    explore(mapper, mapper.join(told, np.full(3, 0.01)), second, 0)
    pose = mapper.pose(1)
    assert pose is not None
    assert math.dist(pose[:2], told[:2]) < 0.06
    assert np.abs(mapper.graph.poses[: len(before)] - before).max() < 0.02  # and the map is not torn


def heading_by_lights(
    mapper: CooperativeMapper, start: FloatArray, turn: FloatArray, seen: BoolArray, bearing: FloatArray
) -> float:
    """The heading of a robot that turns like another one at the origin, whose light alone it sees (k,)."""
    sigma = np.array([0.01, 0.01, math.radians(8.0)])
    numbers = [mapper.join(np.zeros(3), KNOWN), mapper.join(start, sigma)]
    stamps, count = 20_000_000 * np.arange(1, len(turn) + 1), int(seen.sum())
    odometry = np.stack([0.0 * turn, 0.0 * turn, wrap_angle(turn)], axis=1)
    for number in numbers:
        mapper.add_readings(number, Readings(stamps, odometry, np.zeros(len(stamps)), 0.016))
    of_first, sigmas = np.zeros(count, dtype=np.int64), np.full(count, 0.02)
    mapper.add_lights(1, LightSightings(stamps[seen], of_first, bearing, sigmas))
    for number in numbers:
        mapper.leave(number)
    mapper.graph.solve(10)
    assert mapper.graph.constraints.bearings.count == 1
    begin = np.flatnonzero(mapper.graph.robot[: mapper.graph.count] == 1)[0]
    return float(mapper.graph.poses[begin, 2])


def test_a_light_turns_a_robot_that_sees_no_walls() -> None:
    """Both stand; the second sees nothing but the first one's light, and learns its heading."""
    bearing, turn = math.radians(6.0), np.minimum(0.02 * np.arange(199.0), 1.0)
    seen = (np.arange(199) >= 100) & (np.arange(199) < 150)
    angle = np.full(50, np.pi - bearing - 1.0)  # it has turned by one radian
    found = heading_by_lights(CooperativeMapper(), np.array([2.0, 0.0, 0.0]), turn, seen, angle)
    assert found == pytest.approx(bearing, abs=math.radians(2.0))


def test_a_light_seen_twice_in_one_scan_of_wheels_that_slip_is_in_one_direction() -> None:
    """By odometry the second time is a third of a radian more than a full turn after the first one."""
    slip, off, ahead = 0.05, math.radians(6.0), 4.0 * math.pi + 0.3
    mapper = CooperativeMapper(MapperSettings(usual_slip=slip, slip_sigma=1e-4))
    heading, turn = math.pi - (1.0 - slip) * ahead, 0.02 * np.arange(1.0, 1000.0)
    again = ahead + 2.0 * math.pi / (1.0 - slip)
    seen = (np.abs(turn - ahead) < 0.15) | (np.abs(turn - again) < 0.4)
    bearing = wrap_angle((1.0 - slip) * (ahead - turn[seen]))
    found = heading_by_lights(mapper, np.array([2.0, 0.0, heading - off]), turn, seen, bearing)
    assert wrap_angle(found - heading) == pytest.approx(0.0, abs=math.radians(2.0))


def test_a_stop_without_end_is_bounded() -> None:
    stop = ScanStop(np.zeros(3))
    for k in range(20):
        stop.extend(Readings(np.arange(1000) + 1000 * k, np.zeros((1000, 3)), np.ones(1000), 0.016))
    assert len(stop.turn) <= 4096
    assert stop.stamp_ns[-1] == 19_999


STEP_NS = 20_000_000
DISTANCE, SIGMA = 2.0, 0.05


def laser(stamp_ns: int) -> bytes:
    return encode({"header": {"stamp": stamp_ns}, "distance": DISTANCE, "sigma": SIGMA, "events": 1}, LASER)


def test_a_robot_joins_where_odometry_has_it_when_it_first_sees_something() -> None:
    """It had turned by a radian, and driven half a metre, before its first distance came."""
    mapper = CooperativeMapper()
    feed = MapperFeed([Robot("a", start=(1.0, 2.0, 0.5 * math.pi))], mapper, {})
    offset = np.array([7.0, -3.0, 0.0])  # odometry need not begin at zero
    way = [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, 0.0, 1.0)]
    way += [(0.5, 0.0, 1.0 + 0.1 * k) for k in range(1, 160)]
    for k, pose in enumerate(way):
        wrapped = np.array([*pose[:2], math.remainder(pose[2], 2.0 * math.pi)]) + offset
        feed.add(0, MapperInput.ODOMETRY, odometry_bytes("a", k * STEP_NS, wrapped))
        if k >= 3:
            feed.add(0, MapperInput.LASER, laser(k * STEP_NS))
    number = feed.number(0)
    assert number is not None
    found = mapper.graph.states[0]
    assert found[:2] == pytest.approx([1.0, 2.5], abs=0.02)
    assert found[2] == pytest.approx(0.5 * math.pi + 1.0, abs=0.05)
