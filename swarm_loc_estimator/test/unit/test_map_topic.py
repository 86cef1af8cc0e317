"""Matching of scans to known maps, and maps that come by topic."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core_geometry import slopes_of, wrapped
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping_world import LidarRobot, distance_in_room, room_map
from test_lidar_in_map import CELL, hand_in, sent, swarm_at

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import LASER_SCAN, OCCUPANCY_GRID, ODOMETRY, encode
from swarm_loc_estimator.common.se2 import compose, inverse, transform_points, wrap_angle
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.map_file import MapFileError, load_map, map_of_message, save_map
from swarm_loc_estimator.mapping.messages import decode_occupancy_grid
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_estimator.timeline.estimator import Estimator, Status
from swarm_loc_estimator.timeline.map_scans import (
    BLOCKED,
    FAR,
    FITS,
    OFF_MAP,
    UNDETERMINED_SIGMA,
    Match,
    WallMap,
    match,
    normal_equations,
    wall_map,
)

SECOND, MOVED = 1_000_000_000, np.array([1.0, 0.0])


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_map(room_map(CELL), tmp_path_factory.mktemp("maps") / "room")[0]


def map_bytes(drawn: OccupancyMap, yaw: float = 0.0, frame: str = "map", **others: Any) -> bytes:
    """A map as map_server publishes it; `others` replaces fields of its metadata, and `data`."""
    cells = np.where(drawn.occupied, 100, np.where(drawn.free, 0, -1)).astype(np.int8).T
    x, y = drawn.corner.tolist()
    turn = {"z": math.sin(0.5 * yaw), "w": math.cos(0.5 * yaw)}
    about = {"resolution": drawn.cell, "width": cells.shape[1], "height": cells.shape[0]}
    about["origin"] = {"position": {"x": x, "y": y}, "orientation": turn}
    data = others.pop("data", cells.reshape(-1))
    message = {"header": {"frame_id": frame}, "info": {**about, **others}, "data": data}
    return encode(message, OCCUPANCY_GRID)


def by_topic(start: Any = LidarRobot.start) -> Swarm:
    """A robot whose map comes by topic; without a start if it is None."""
    swarm = swarm_at(None, LidarRobot.start if start is None else start)
    robot = swarm.robots[0] if start is not None else replace(swarm.robots[0], start=None)
    return replace(swarm, robots=(robot,), map="topic")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("has_start", [True, False])
def test_poses_are_those_of_the_same_map_as_a_file(room: Path, seed: int, has_start: bool) -> None:
    start = LidarRobot.start + np.random.default_rng(seed).standard_normal(3) * 0.03
    by_message = by_topic(start if has_start else None)
    messages = sent((3 if has_start else 9) * SECOND, seed, blocked=60)
    file, topic = Estimator(replace(by_message, map=room)), Estimator(by_message)
    expected = hand_in(file, messages)[-1]
    found = hand_in(topic, [("map", 0, map_bytes(load_map(room))), *messages])[-1]
    assert found.status[0] == Status.TRACKED
    assert found.poses.tobytes() == expected.poses.tobytes()
    assert found.covariances.tobytes() == expected.covariances.tobytes()


@pytest.mark.parametrize("yaw", [0.3, -2.0, 0.5 * math.pi])
def test_a_turned_map_is_turned_back(yaw: float) -> None:
    """Its walls are within a cell of where they were, and all robots are within their covariance."""
    drawn = room_map(CELL)
    cos, sin = math.cos(-yaw), math.sin(-yaw)
    # the same room, drawn along axes that are turned: corner and axes turn back by yaw
    middle = drawn.corner + 0.5 * CELL * np.array(drawn.log_odds.shape)
    size = 2 * math.ceil(math.hypot(*drawn.log_odds.shape) / 2.0) + 4
    grid = (np.indices((size, size)).reshape(2, -1).T + 0.5 - 0.5 * size) * CELL
    cells = drawn.index(grid @ np.array([[cos, -sin], [sin, cos]]) + middle)
    inside = ((cells >= 0) & (cells < drawn.log_odds.shape)).all(axis=1)
    odds = np.zeros(size * size)
    odds[inside] = drawn.log_odds[tuple(cells[inside].T)]
    half = 0.5 * size * CELL
    corner = middle - np.array([cos * half + sin * half, -sin * half + cos * half])
    turned = OccupancyMap(corner, CELL, odds.reshape(size, size))
    back = map_of_message(decode_occupancy_grid(map_bytes(turned, yaw)))
    walls, again = drawn.centres(drawn.occupied), back.centres(back.occupied)
    apart = np.hypot(*(walls[:, None] - again[None]).transpose(2, 0, 1))
    assert max(apart.min(axis=0).max(), apart.min(axis=1).max()) < 1.5 * CELL
    estimate = hand_in(Estimator(by_topic()), [("map", 0, map_bytes(turned, yaw)), *sent(3 * SECOND, 1)])[-1]
    assert estimate.status[0] == Status.TRACKED
    assert np.abs(wrapped(estimate.poses[0] - LidarRobot().pose(3 * SECOND))).max() < CELL


def test_cells_count_by_the_thresholds_of_map_server() -> None:
    drawn = OccupancyMap(np.zeros(2), 0.5, np.zeros((8, 1)))
    cells = np.array([-1, 0, 19, 20, 65, 66, 100, -2], dtype=np.int8)
    found = map_of_message(decode_occupancy_grid(map_bytes(drawn, data=cells)))
    assert found.occupied[:, 0].tolist() == [False] * 5 + [True, True, False]
    assert found.free[:, 0].tolist() == [False, True, True, *[False] * 5]


@pytest.mark.parametrize("seed", range(3))
def test_a_located_robot_stays_and_one_that_is_searched_begins_anew(seed: int) -> None:
    """The first map has a place too many; in the second one there is only one."""
    first, second = (
        ("map", at, map_bytes(one)) for at, one in ((0, room_map(CELL, has_niche=False)), (1, room_map(CELL)))
    )
    messages = sent(12 * SECOND, seed)
    late = (second[0], 5 * SECOND, second[2])
    changed = sorted([first, *messages, late], key=lambda one: one[1])
    searched = Estimator(by_topic(None))
    estimates = hand_in(searched, changed)
    assert {int(one.status[0]) for one in estimates if one.stamp_ns < 5 * SECOND} == {Status.WAITING}
    assert estimates[-1].status[0] == Status.TRACKED
    assert np.abs(wrapped(estimates[-1].poses[0] - LidarRobot().pose(12 * SECOND))).max() < 2.0 * CELL
    located = hand_in(Estimator(by_topic()), changed)
    before, after = [one for one in located if one.stamp_ns == 5 * SECOND][-2:]
    assert before.status[0] == after.status[0] == Status.TRACKED
    assert before.poses.tobytes() == after.poses.tobytes()
    assert all(one.status[0] == Status.TRACKED for one in located if one.stamp_ns > 5 * SECOND)


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_in_a_map_that_has_moved_is_soon_lost_or_found_in_the_new_one(seed: int) -> None:
    drawn = room_map(CELL)
    moved = ("map", 3 * SECOND, map_bytes(replace(drawn, corner=drawn.corner + MOVED)))
    messages = [("map", 0, map_bytes(drawn)), *sent(16 * SECOND, seed), moved]
    estimates = hand_in(Estimator(by_topic()), sorted(messages, key=lambda one: one[1]))
    tracked = [one for one in estimates if one.stamp_ns > 3.5 * SECOND and one.status[0] == Status.TRACKED]
    assert tracked[-1] is estimates[-1]
    for one in tracked:
        error = wrapped(one.poses[0] - LidarRobot().pose(one.stamp_ns) - [*MOVED, 0.0])
        assert np.abs(error).max() < 2.0 * CELL


def test_scans_that_come_late_are_matched_in_the_map_of_their_time() -> None:
    """A map that is changed does not change what was before it."""
    drawn, until_ns = room_map(CELL), 2 * SECOND
    first, *others = [("map", 0, map_bytes(drawn)), *sent(until_ns, 1)]
    moved = ("map", until_ns, map_bytes(replace(drawn, corner=drawn.corner + MOVED)))
    late = [others[0], moved, *((topic, until_ns, data) for topic, _, data in others[1:])]
    found = hand_in(Estimator(by_topic()), [first, *late])[-1]
    assert found.status[0] == Status.TRACKED
    assert found.poses == pytest.approx(hand_in(Estimator(by_topic()), [first, *others, moved])[-1].poses)


def test_a_reset_keeps_the_newest_map_and_another_description_as_well() -> None:
    messages = sent(3 * SECOND, 1)
    for begin_anew in (Estimator.reset, lambda estimator: estimator.describe(estimator.swarm)):
        estimator = Estimator(by_topic())
        hand_in(estimator, [("map", 0, map_bytes(room_map(CELL)))])
        begin_anew(estimator)
        assert hand_in(estimator, messages)[-1].status[0] == Status.TRACKED
        assert estimator.used >= 14


def test_a_map_far_away_tells_the_local_origin() -> None:
    """UTM coordinates: poses are as right as near the origin."""
    drawn, far = room_map(CELL), np.array([691_003.0, 5_334_765.0])
    messages = [("map", 0, map_bytes(replace(drawn, corner=drawn.corner + far))), *sent(9 * SECOND, 1)]
    estimate = hand_in(Estimator(by_topic(None)), messages)[-1]
    assert estimate.status[0] == Status.TRACKED
    error = wrapped(estimate.poses[0] - LidarRobot().pose(9 * SECOND) - [*far, 0.0])
    assert np.abs(error).max() < 2.0 * CELL


FAULTS: dict[str, list[dict[str, Any]]] = {
    "map_frame": [{"frame": "odom"}, {"frame": ""}],
    "map_size": [{"width": 3}, {"height": 0}, {"data": np.zeros(0, dtype=np.int8)}, {"width": 2**32 - 1}],
    "map_resolution": [{"resolution": one} for one in (0.0, math.nan, -0.05, math.inf)],
    "map_origin": [{"origin": {"position": {"x": math.nan}, "orientation": {"w": 1.0}}}, {"origin": {}}],
    "map_too_large": [{"data": np.zeros(51_000_000, dtype=np.int8), "width": 51_000, "height": 1000}],
    "map_unusable": [{"data": np.zeros(1, dtype=np.int8), "width": 1, "height": 1}],
}


@pytest.mark.parametrize("reason", FAULTS)
def test_a_map_that_cannot_be_used_is_dropped_and_counted(reason: str) -> None:
    """The one before it stays."""
    drawn = room_map(CELL)
    bad = [("map", 0, map_bytes(drawn, **fault)) for fault in FAULTS[reason]]
    estimator = Estimator(by_topic())
    estimate = hand_in(estimator, [("map", 0, map_bytes(drawn)), *bad, *sent(3 * SECOND, 1)])[-1]
    assert estimator.drops[reason] == len(bad)
    assert estimate.status[0] == Status.TRACKED
    assert estimator.used >= 14


def test_a_bag_with_a_map_gives_the_same_poses_twice_byte_for_byte(room: Path, tmp_path: Path) -> None:
    """It is shown, too; without it, the remarks say so."""
    messages = sent(9 * SECOND, seed=2)
    for name, maps in (("with", [("map", 0, map_bytes(load_map(room)))]), ("without", [])):
        with BagWriter(tmp_path / name) as bag:
            for topic, message_type in (
                ("a/odom", ODOMETRY),
                ("a/scan", LASER_SCAN),
                ("map", OCCUPANCY_GRID),
            ):
                bag.add_topic(topic, message_type)
            for topic, at_ns, data in [*maps, *messages]:
                bag.write(topic, at_ns, data)
    first, second = (replay(tmp_path / "with", by_topic(None)) for _ in range(2))
    assert first.poses.tobytes() == second.poses.tobytes()
    assert first.covariances.tobytes() == second.covariances.tobytes()
    assert first.status[-1, 0] == Status.TRACKED
    assert len(first.maps) == 1
    file = replay(tmp_path / "with", replace(by_topic(None), map=room))
    assert file.poses.tobytes() == first.poses.tobytes()
    assert len(file.maps) == 1
    without = replay(tmp_path / "without", by_topic(None))
    assert "The bag holds no message on map." in without.remarks
    assert (without.status[:, 0] == Status.WAITING).all()


def test_the_description_says_that_the_map_comes_by_topic(tmp_path: Path) -> None:
    save_swarm(by_topic(), tmp_path / "swarm.yaml")
    assert "map: topic\n" in (tmp_path / "swarm.yaml").read_text()
    assert load_swarm(tmp_path / "swarm.yaml") == by_topic()


PRIOR = np.diag([0.1**2, 0.1**2, 0.1**2])
ORIGIN = np.zeros(2)
HERE = np.array([1.5, 1.1, 0.4])


def beams(pose: FloatArray, count: int = 360) -> FloatArray:
    """Exact ends (count, 2) of a sweep in the room, in the frame of the robot."""
    angles = 2.0 * math.pi / count * np.arange(count)
    ranges = np.array([distance_in_room(pose[0], pose[1], pose[2] + angle) for angle in angles])
    ends: FloatArray = ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return ends


def matched(walls: WallMap, ends: FloatArray, predicted: FloatArray) -> Match:
    return match(walls, ends, ORIGIN, np.full(len(ends), 0.02**2), predicted, PRIOR)


@settings(deadline=None, max_examples=30)
@given(st.tuples(*[st.floats(-0.15, 0.15)] * 3), st.floats(-math.pi, math.pi))
def test_a_match_finds_the_pose(shift: tuple[float, float, float], heading: float) -> None:
    pose = np.array([1.5, 1.1, heading])
    found = matched(wall_map(room_map(CELL), Path("room.yaml")), beams(pose), pose + shift)
    assert (found.outcome, found.determined) == (FITS, 3)
    assert found.pose[:2] == pytest.approx(pose[:2], abs=0.5 * CELL)
    assert float(wrap_angle(found.pose[2] - heading)) == pytest.approx(0.0, abs=0.01)
    assert found.fitting > 0.95
    assert found.through == 0.0


@given(st.integers(0, 3), st.integers(-40, 40), st.integers(-40, 40))
def test_matching_commutes_with_transforms(quarters: int, right: int, up: int) -> None:
    room = room_map(CELL)
    turn = np.array([right * CELL, up * CELL, quarters * 0.5 * math.pi])
    extent = np.array(room.log_odds.shape) * CELL
    corners = transform_points(turn, np.array([room.corner, room.corner + extent]))
    moved = OccupancyMap(corners.min(axis=0), CELL, np.ascontiguousarray(np.rot90(room.log_odds, quarters)))
    ends, start = beams(HERE), HERE + np.array([0.06, -0.08, 0.05])
    one = matched(wall_map(room, Path("a")), ends, start)
    other = matched(wall_map(moved, Path("a")), ends, compose(turn, start))
    assert compose(inverse(turn), other.pose) == pytest.approx(one.pose, abs=2e-3)
    rotation = np.eye(3)
    rotation[:2, :2] = [[math.cos(turn[2]), -math.sin(turn[2])], [math.sin(turn[2]), math.cos(turn[2])]]
    assert other.covariance == pytest.approx(rotation @ one.covariance @ rotation.T, rel=0.2, abs=1e-5)


@pytest.mark.parametrize("beam", range(3, 360, 31))
def test_the_jacobian_is_that_of_finite_differences(beam: int) -> None:
    """One beam: the gradient is w J r and the information w J J^T, so J r = gradient / w."""
    walls, end, variance = wall_map(room_map(CELL), Path("a")), beams(HERE)[beam : beam + 1], np.array([1e-4])
    pose = HERE + np.array([0.03, 0.02, 0.01])

    def equations(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        information, _, gradient = normal_equations(walls, end, ORIGIN, variance, at, 0.3)
        return information, gradient

    information, gradient = equations(pose)
    weight = information[0, 0] + information[1, 1]
    main = int(np.argmax(np.diag(information)[:2]))
    normal = math.sqrt(information[main, main] / weight)  # its sign is that of this component
    jacobian = information[main] / (weight * normal)

    def residual(at: FloatArray) -> float:
        now, slope = equations(at)
        return float(slope[main] / (now[main, main] / normal))

    numeric = slopes_of(lambda change: residual(pose - change), 3, 1e-5)
    assert numeric == pytest.approx(jacobian, abs=1e-6)
    assert abs(gradient[main]) > 0.0


@pytest.mark.parametrize("angle", [0.0, 0.5, math.pi / 4.0, 2.0])
def test_a_corridor_tells_nothing_along(angle: float) -> None:
    """Two walls, longer than the lidar reaches, in any direction."""
    along, across = (
        np.array([math.cos(angle), math.sin(angle)]),
        np.array([-math.sin(angle), math.cos(angle)]),
    )
    x, y = np.meshgrid(*[np.arange(-8.0, 8.0, CELL) + 0.5 * CELL] * 2, indexing="ij")
    aside = np.abs(x * across[0] + y * across[1])
    log_odds = np.where(np.abs(aside - 1.0) < 0.5 * CELL, 5.0, np.where(aside < 1.0, -5.0, 0.0))
    walls = wall_map(OccupancyMap(np.array([-8.0, -8.0]), CELL, log_odds), Path("corridor.yaml"))
    bearings = angle + np.concatenate([np.linspace(0.3, 2.8, 100), np.linspace(-2.8, -0.3, 100)])
    ranges = 1.0 / np.abs(np.sin(bearings - angle))
    ends = ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
    predicted = np.array([*(0.2 * along + 0.05 * across), 0.02])
    found = matched(walls, ends, predicted)
    assert (found.outcome, found.determined) == (FITS, 2)
    assert math.sqrt(along @ found.covariance[:2, :2] @ along) > 0.99 * UNDETERMINED_SIGMA
    assert math.sqrt(across @ found.covariance[:2, :2] @ across) < 0.05
    assert along @ found.pose[:2] == pytest.approx(0.2, abs=0.02)
    assert across @ found.pose[:2] == pytest.approx(0.0, abs=0.6 * CELL)


def test_more_beams_do_not_make_a_map_exact() -> None:
    walls = wall_map(room_map(CELL), Path("a"))
    sigmas = [
        np.sqrt(np.diag(matched(walls, beams(HERE, count), HERE).covariance)) for count in (360, 36_000)
    ]
    assert (sigmas[1] > 0.5 * sigmas[0]).all()
    assert sigmas[1][0] > CELL / math.sqrt(12.0) / 2.0


def test_beams_on_people_do_not_move_the_match() -> None:
    ends, pose = beams(HERE), HERE + np.array([0.05, -0.04, 0.03])
    ends[100:190] *= (0.6 / np.hypot(*ends[100:190].T))[:, None]
    found = matched(wall_map(room_map(CELL), Path("a")), ends, pose)
    assert found.outcome == FITS
    assert found.fitting == pytest.approx(0.75, abs=0.03)
    assert found.pose == pytest.approx(HERE, abs=0.02)


def test_a_crowd_is_not_used() -> None:
    ends = beams(HERE)
    ends[:300] *= (0.5 / np.hypot(*ends[:300].T))[:, None]
    assert matched(wall_map(room_map(CELL), Path("a")), ends, HERE).outcome == BLOCKED


@pytest.mark.parametrize("shift", [(1.0, 0.0, 0.0), (-0.9, 0.0, 0.0), (0.0, -0.8, 0.0), (0.0, 0.0, 1.0)])
def test_beams_through_walls_contradict_the_map(shift: tuple[float, float, float]) -> None:
    found = matched(wall_map(room_map(CELL), Path("a")), beams(HERE), HERE + shift)
    assert found.outcome in (OFF_MAP, FAR)


@pytest.mark.parametrize(("log_odds", "what"), [(0.0, "occupied"), (-5.0, "occupied"), (5.0, "free")])
def test_a_map_without_walls_or_space_is_refused(log_odds: float, what: str) -> None:
    empty = OccupancyMap(np.zeros(2), CELL, np.full((4, 5), log_odds))
    with pytest.raises(MapFileError) as error:
        wall_map(empty, Path("hall.yaml"))
    assert str(error.value) == f"The map 'hall.yaml' has 20 cells but none that is {what}."
