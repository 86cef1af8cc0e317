"""Floor plans: files, built-in halls, and drives along walls."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.pushbot.runs import wall_points
from swarm_loc_drivers.sim.pushbot.floor_plan import (
    FLOOR_PLANS,
    FloorPlan,
    FloorPlanError,
    clearance,
    floor_plan,
    is_visible,
    outline,
    polygon,
    ray_distance,
)
from swarm_loc_drivers.sim.pushbot.optics import assembled
from swarm_loc_drivers.sim.pushbot.wall_drive import WallDriveSettings, drive_at_wall
from swarm_loc_drivers.sim.pushbot.world import PushbotWorldParameters, make_pushbot_world
from swarm_loc_drivers.sim.simulation import SimulationOptions, simulated_swarm
from swarm_loc_drivers.sim.worlds import WorldError
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import ParameterError, UserError
from swarm_loc_vision.laser.calibration import RowBias, fit_hyperbola

SWARM = """
fileversion: 1
types: {pushbot: {odometry: {wheel_separation: 0.085}, camera: null}}
robots: {a: {type: pushbot, start: {x: 1.0, y: 1.0, theta: 0.0}}}
"""
MAP = """
image: room.png
resolution: 0.05
origin: [-1.013, -0.5, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def written(folder: Path, text: str, name: str = "plan.yaml") -> str:
    """The path of a file with a text."""
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


def free_way(plan: FloorPlan, x: float, y: float, angle: float) -> float:
    """Distance to the first wall [m]."""
    return float(ray_distance(plan.walls, np.zeros((0, 2)), 0.06, x, y, angle))


@pytest.mark.parametrize("name", ["plan.yaml", "plan.json"])
def test_walls_come_from_a_file(tmp_path: Path, name: str) -> None:
    content = {
        "free": [[0, 0, 4, 3]],
        "solid": [[3, 2, 4, 3]],
        "columns": [[1.8, 1.2, 2.1, 1.5]],
        "polygons": [[[0.5, 2.0], [0.9, 2.0], [0.5, 2.4], [0.5, 2.0]]],
        "segments": [[0, 0.5, 1, 0.5]],
        "starts": [[1, 1]],
    }
    plan = floor_plan(written(tmp_path, json.dumps(content), name))
    assert free_way(plan, 1.0, 1.3, 0.0) == pytest.approx(0.8)
    assert free_way(plan, 2.5, 2.5, 0.0) == pytest.approx(0.5)
    assert free_way(plan, 0.6, 1.0, -math.pi / 2) == pytest.approx(0.5)
    assert free_way(plan, 0.6, 1.0, math.pi / 2) == pytest.approx(1.0)
    assert plan.starts.tolist() == [[1.0, 1.0]]


@pytest.mark.parametrize(
    ("ending", "text"),
    [
        ("png", MAP),
        ("pgm", MAP),
        ("png", "\n".join(MAP.splitlines()[:4])),
        ("png", MAP + "mode: scale\n"),
        ("png", MAP + "mode: raw\n"),
    ],
)
def test_walls_come_from_a_map(tmp_path: Path, ending: str, text: str) -> None:
    """A room of 40 x 20 pixels with a block in it; its first row is the uppermost."""
    pixels = np.full((20, 40), 254, np.uint8)
    pixels[[0, -1], :], pixels[:, [0, -1]] = 0, 0
    pixels[4:8, 30:34] = 0
    pixels[10, 10] = 205
    if "raw" in text:  # percent
        pixels = np.where(pixels == 0, 100, 0).astype(np.uint8)
    cv2.imwrite(str(tmp_path / f"room.{ending}"), pixels)
    plan = floor_plan(written(tmp_path, text.replace("png", ending)))
    assert len(plan.walls) == 8
    x, y = -1.013, -0.5
    assert free_way(plan, x + 0.5, y + 0.3, 0.0) == pytest.approx(1.95 - 0.5)
    assert free_way(plan, x + 0.5, y + 0.3, -math.pi / 2) == pytest.approx(0.25)
    assert free_way(plan, x + 0.5, y + 0.7, 0.0) == pytest.approx(1.5 - 0.5)
    assert free_way(plan, x + 1.6, y + 0.3, math.pi / 2) == pytest.approx(0.6 - 0.3)


def test_the_hall_ends_where_a_map_ends(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "room.png"), np.full((20, 40), 254, np.uint8))
    plan = floor_plan(written(tmp_path, MAP.replace("0.0]", "1.0e-9]")))
    assert len(plan.walls) == 4
    assert free_way(plan, 0.0, 0.0, math.pi) == pytest.approx(1.013)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("walls: []", "'walls' is not a known key"),
        ("free: [[0, 0, 4]]", r"free\[0\] is \[0.0, 0.0, 4.0\] but must have 4 numbers"),
        ("free: [[4, 0, 0, 3]]", r"free\[0\] is .* but must be \[left, lower, right, upper\]"),
        ("free: 3", "free is 3 but must be a list"),
        ("segments: [[0, 0, 1, .nan]]", r"segments\[0\]\[3\] is nan but must be a number"),
        ("polygons: [[1, 2]]", r"polygons\[0\]\[0\] is 1 but must be a list"),
        ("{}", "the plan has 0 walls but must have 1 to 2000"),
        ("segments: [[1, 1, 1, 1]]", "the plan has 0 walls"),
        (f"segments: {[[0, k, 1, k] for k in range(2001)]}", "the plan has 2001 walls"),
        (f"free: {[[0, k, 1, k + 1] for k in range(201)]}", "free has 201 rectangles but may have 200"),
        ("[1, 2]", "must be a mapping"),
        ("free: [", "is not YAML"),
        ("image: room.png", "lacks origin"),
        (MAP.replace("0.05", "0"), "resolution is 0 but must lie in"),
        (MAP.replace("0.0]", "1.0e-5]"), "origin is .* but must be x, y and a yaw of 0"),
        (MAP + "mode: shaded", "mode is 'shaded' but must be one of trinary, scale, raw"),
        (MAP, "room.png cannot be read"),
        (MAP.replace("room.png", "plan.yaml"), "The image '.*plan.yaml' of a map cannot be decoded"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_in_one_sentence(
    tmp_path: Path, text: str, sentence: str
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(UserError, match=sentence) as caught:
        floor_plan(path)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_simulation_and_world_take_a_file(tmp_path: Path) -> None:
    swarm_file = written(tmp_path, SWARM, "swarm.yaml")
    plan = written(tmp_path, "free: [[0, 0, 2, 2]]\n")
    assert len(simulated_swarm(SimulationOptions(swarm_file, plan=plan)).robots) == 1
    _, world = make_pushbot_world(PushbotWorldParameters(swarm_file=swarm_file, plan=plan))
    assert world.sight.distance(0, world.poses) == pytest.approx(1.0, abs=0.1)
    missing = str(tmp_path / "missing.yaml")
    with pytest.raises(UserError, match=r"missing\.yaml cannot be read"):
        simulated_swarm(SimulationOptions(swarm_file, plan=missing))


def test_a_robot_in_a_wall_of_a_file_is_named(tmp_path: Path) -> None:
    swarm_file = written(tmp_path, SWARM, "swarm.yaml")
    plan = written(tmp_path, "free: [[0, 0, 2, 2]]\ncolumns: [[0.9, 0.9, 1.02, 1.02]]\n")
    with pytest.raises((ParameterError, WorldError), match="robot 1 of the swarm begins within a wall"):
        make_pushbot_world(PushbotWorldParameters(swarm_file=swarm_file, plan=plan))


ROOM = FloorPlan("room", outline([(0, 0, 4, 3)], [(2, 1, 2.5, 2)]), np.array([[1.0, 1.5], [3.5, 1.5]]))


def test_rays_end_at_walls_and_robots() -> None:
    discs = np.array([[1.0, 2.5]])
    assert ray_distance(ROOM.walls, discs, 0.06, 1.0, 1.5, 0.0) == pytest.approx(1.0)
    assert ray_distance(ROOM.walls, discs, 0.06, 1.0, 1.5, math.pi / 2) == pytest.approx(0.94)
    assert ray_distance(ROOM.walls, discs, 0.06, 1.0, 1.5, math.pi) == pytest.approx(1.0)
    assert clearance(ROOM.walls, discs, 0.06, 1.8, 1.5) == pytest.approx(0.2)
    assert clearance(ROOM.walls, discs, 0.06, 1.0, 2.3) == pytest.approx(0.14)
    assert is_visible(ROOM.walls, 1.0, 2.5, 3.5, 2.5)
    assert not is_visible(ROOM.walls, 1.0, 1.5, 3.5, 1.5)


def test_rays_end_at_slanted_walls() -> None:
    walls = polygon([(0, 0), (2, 0), (0, 2)])
    assert ray_distance(walls, np.zeros((0, 2)), 0.06, 0.5, 0.5, math.pi / 4) == pytest.approx(math.sqrt(0.5))


@pytest.mark.parametrize("name", sorted(FLOOR_PLANS))
def test_robots_start_inside_closed_halls(name: str) -> None:
    plan = floor_plan(name)
    nobody = np.zeros((0, 2))
    for x, y in plan.starts:
        assert clearance(plan.walls, nobody, 0.0, x, y) > 0.3
        assert all(
            math.isfinite(ray_distance(plan.walls, nobody, 0.0, x, y, a)) for a in np.linspace(0, 6, 50)
        )
    lengths = np.hypot(*(plan.walls[:, 2:] - plan.walls[:, :2]).T)
    assert len(wall_points(plan, 0.1)) >= lengths.sum() / 0.1


def test_an_unknown_hall_is_told() -> None:
    with pytest.raises(FloorPlanError, match="no floor plan 'cave': it must be one of corridor,"):
        floor_plan("cave")


HALF_A_SECOND = 25  # Windows of the tracker


@pytest.mark.parametrize("seed", range(6))
def test_errors_of_rows_do_not_last(seed: int) -> None:
    """What is left of them averages out over half a second; without the bias more lasts."""
    built = assembled(np.random.default_rng(seed))
    first, _ = drive_at_wall(np.random.default_rng([seed, 1]), built, WallDriveSettings(speed=0.25))
    far_away = WallDriveSettings(start=2.4, stop=0.8)
    other, depths = drive_at_wall(np.random.default_rng([seed, 2]), built, far_away)
    found = fit_hyperbola(first)
    far = (depths > 0.8) & (depths < 2.3)
    rows, true_rows = other.rows[far], found.row_at_infinity + found.focal_base / depths[far]
    left = rows - found.row_bias.at_each(rows) - true_rows
    assert found.row_bias != RowBias()
    assert lasting(left) < 0.6 * lasting(rows - true_rows)
    assert lasting(left) < 0.03
    assert 0.5 < np.std(left) / found.row_sigma < 1.5


def lasting(errors: FloatArray) -> float:
    """Standard deviation of errors averaged over half a second; one that all share is the hyperbola's."""
    means = np.convolve(errors, np.full(HALF_A_SECOND, 1.0 / HALF_A_SECOND), mode="valid")
    return float(np.std(means))
