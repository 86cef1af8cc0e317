"""Grids, planning, and map files."""

import io
import math
import os
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import EpsImagePlugin, Image

from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.mapping.exploration import goal_by_odometry, next_stop, paths_from
from swarm_loc_estimator.mapping.grid import CELL, OccupancyMap, VisitationMap, grid_around
from swarm_loc_estimator.mapping.map_file import load_map, save_map
from swarm_loc_estimator.mapping.settings import MapperSettings

SETTINGS = MapperSettings()
NOBODY = np.zeros((0, 2))


def hall() -> OccupancyMap:
    """Three metres by two, free inside its walls; a wall in the middle leaves a door at the top."""
    log_odds = np.zeros((160, 110))
    log_odds[5:155, 5:105] = -2.0
    for wall in (np.s_[5, 5:105], np.s_[155, 5:105], np.s_[5:156, 5], np.s_[5:156, 105], np.s_[80, 5:70]):
        log_odds[wall] = 3.0
    return OccupancyMap(np.zeros(2), CELL, log_odds)


def test_paths_go_around_walls() -> None:
    passable = np.ones((21, 11), dtype=bool)
    passable[10, :10] = False
    length, before = paths_from(passable, 5, 0)
    assert length[15, 0] == pytest.approx(2.0 * (10 + 0) - 2 * 5 + 10 * math.sqrt(2.0))
    cell, steps = (15, 0), [(15, 0)]
    while before[cell] >= 0:
        previous = divmod(int(before[cell]), 11)
        cell = (int(previous[0]), int(previous[1]))
        steps.append(cell)
    assert steps[-1] == (5, 0)
    assert (10, 10) in steps


def test_paths_do_not_lead_through_closed_doors() -> None:
    passable = np.ones((9, 9), dtype=bool)
    passable[4] = False
    length, _ = paths_from(passable, 0, 0)
    assert np.isinf(length[5:]).all()


def test_a_hop_is_straight_free_and_not_too_long() -> None:
    occupancy, position = hall(), np.array([0.8, 0.5])
    hop, goal = next_stop(
        occupancy, position, position[None], NOBODY, NOBODY, SETTINGS, home=np.array([2.6, 0.5])
    )
    assert goal[0] > 1.8  # through the door
    assert 0.1 < math.dist(hop, position) <= SETTINGS.max_hop + 1e-9
    for share in np.linspace(0.0, 1.0, 50):
        point = position + share * (hop - position)
        nearest = np.hypot(*(occupancy.centres(occupancy.occupied) - point).T).min()
        assert nearest > SETTINGS.robot_radius


def test_robots_spread_and_keep_off_each_other() -> None:
    occupancy, position = hall(), np.array([0.8, 1.2])
    free = next_stop(occupancy, position, position[None], NOBODY, NOBODY, SETTINGS)[1]
    apart = next_stop(occupancy, position, position[None], NOBODY, free[None], SETTINGS)[1]
    assert math.dist(free, apart) > 0.3
    blocked = next_stop(occupancy, position, position[None], free[None], NOBODY, SETTINGS)[1]
    assert math.dist(blocked, free) > 2.0 * SETTINGS.robot_radius


def test_where_no_wall_is_in_sight_a_robot_goes_straight_on() -> None:
    """Not about, since its heading gets lost with every scan; single false echoes are no walls."""
    evidence = np.full((400, 400), -2.0)
    evidence[150, 260] = evidence[260, 150] = 2.0
    occupancy = OccupancyMap(np.array([-4.0, -4.0]), CELL, evidence)
    stops = np.array([[-0.8, 0.0], [-0.4, 0.0], [0.0, 0.0]])
    hop, goal = next_stop(occupancy, stops[-1], stops, NOBODY, NOBODY, SETTINGS)
    assert goal[0] > 3.0
    assert hop[0] > 0.5


def test_a_robot_with_no_way_out_stays() -> None:
    occupancy = OccupancyMap(np.zeros(2), CELL, np.zeros((100, 100)))
    position = np.array([1.0, 1.0])
    hop, goal = next_stop(occupancy, position, position[None], NOBODY, NOBODY, SETTINGS)
    assert np.array_equal(hop, position)
    assert np.array_equal(goal, position)


def test_a_goal_by_odometry_counts_the_slip() -> None:
    there = goal_by_odometry(np.array([1.0, 1.0, 0.0]), np.zeros(3), np.array([1.0, 2.0]), 0.9)
    angle = 0.5 * math.pi / 0.9
    assert np.allclose(there, [math.cos(angle), math.sin(angle)])


@given(
    points=st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=20),
    limit=st.integers(10_000, 10_000_000),
)
def test_grids_are_bounded_and_hold_the_points_if_they_can(
    points: list[tuple[float, float]], limit: int
) -> None:
    corner, shape = grid_around(np.array(points), CELL, limit)
    assert 1 <= shape[0] * shape[1] <= limit
    assert np.allclose(corner / CELL, np.round(corner / CELL))
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    if np.prod((high - low) / CELL + 3) < limit:
        assert (corner <= low + 1e-9).all()
        assert (corner + np.array(shape) * CELL >= high - 1e-9).all()


def test_visits_are_counted_on_nine_cells() -> None:
    visits = VisitationMap()
    visits.add(np.array([[0.5, 0.5], [0.5, 0.5], [0.5, 0.9]]))
    counts = visits.on(hall())
    assert counts.sum() == 27
    assert counts[25, 25] == counts[24, 26] == 2


def test_maps_survive_a_file(tmp_path: Path) -> None:
    occupancy = hall()
    path, image = save_map(occupancy, tmp_path / "maps" / "hall.yaml")
    loaded = load_map(path, CELL)
    assert np.array_equal(loaded.occupied, occupancy.occupied)
    assert np.array_equal(loaded.free, occupancy.free)
    assert np.allclose(loaded.corner, occupancy.corner)
    assert image.read_bytes().startswith(b"P5\n160 110\n255\n")
    assert "resolution: 0.02" in path.read_text()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("resolution: 0.02", "resolution: 0", r"resolution is 0 but must lie in \[0.0001, 10\] m"),
        ("resolution: 0.02", "resolution: 1.0e-300", "resolution is 1e-300 but must lie in"),
        ("resolution: 0.02", "resolution: " + "9" * 400, "resolution is .* but must lie in"),
        ("resolution: 0.02", "resolution: 10.0", "may have 50000000"),
        ("resolution: 0.02", "other: 0.02", "the file lacks resolution"),
        ("image: hall.pgm", "image: other.pgm", "cannot be read: No such file"),
        ("image: hall.pgm", 'image: "a\\0b"', "cannot be read: embedded null byte"),
        ("image: hall.pgm", "image: /dev/zero", "cannot be read: it is no regular file"),
        ("image: hall.pgm", "image: pipe", "cannot be read: it is no regular file"),
        ("image: hall.pgm", "image: [1]", "image is .* but must be the path of a file"),
        ("image: hall.pgm", "image: sparse", "has more than the 200000000 bytes"),
        ("origin: [0.0, 0.0, 0.0]", "origin: [0.0, 0.0]", "must be x, y and a yaw of 0"),
        ("origin: [0.0, 0.0, 0.0]", "origin: [0.0, 0.0, 0.5]", "must be x, y and a yaw of 0"),
        ("origin: [0.0, 0.0, 0.0]", f"origin: [{'9' * 30}, 0.0, 0.0]", "must lie in"),
        ("occupied_thresh: 0.65", "occupied_thresh: " + "9" * 30, "occupied_thresh is .* but must lie in"),
        ("free_thresh: 0.196", "free_thresh: much", "free_thresh is 'much' but must be a number"),
        ("mode: trinary", "mode: binary", "mode is 'binary' but must be one of trinary, scale, raw"),
        ("negate: 0", "negate: 2", "negate is 2 but must be 0 or 1"),
    ],
)
def test_a_wrong_description_is_refused_in_a_sentence(tmp_path: Path, old: str, new: str, said: str) -> None:
    path, _ = save_map(hall(), tmp_path / "hall")
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(480_000_000)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(UserError, match=said):
        load_map(path, CELL)


@pytest.mark.parametrize("data", [b"P5\n160 110\n255\n" + bytes(99), b"\x89PNG\r\n\x1a\n", b""])
def test_a_broken_image_is_refused_in_a_sentence(tmp_path: Path, data: bytes) -> None:
    path, image = save_map(hall(), tmp_path / "hall")
    image.write_bytes(data)
    with pytest.raises(UserError, match=r"^The image '.*hall.pgm' of a map cannot be decoded"):
        load_map(path, CELL)


def test_a_program_of_postscript_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ghost = tmp_path / "bin" / "gs"
    ghost.parent.mkdir()
    ghost.write_text(f"#!/bin/sh\ntouch {tmp_path}/ran\n")
    ghost.chmod(0o755)
    monkeypatch.setenv("PATH", f"{ghost.parent}:{os.environ['PATH']}")
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)
    path, image = save_map(hall(), tmp_path / "hall")
    for suffix in ("EPS", "TIFF", "GIF", "JPEG", "WEBP"):
        Image.new("L", (160, 110)).save(image, suffix)
        with pytest.raises(UserError, match=r"^The image '.*hall.pgm' of a map cannot be decoded"):
            load_map(path, CELL)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("kind", ["PNG", "BMP", "PPM"])
def test_what_map_server_writes_is_read(tmp_path: Path, kind: str) -> None:
    path, image = save_map(hall(), tmp_path / "hall")
    expected = load_map(path, CELL)
    for colours in ("L", "RGB"):
        Image.open(io.BytesIO(image.read_bytes())).convert(colours).save(image, kind)
        assert np.array_equal(load_map(path, CELL).log_odds, expected.log_odds)


@pytest.mark.parametrize(
    "head", [b"P5\n# by hand\n160 110\n255\n", b"P5 #\r160#x\n#\n 110\t255\n", b"P6 160 110 255\n"]
)
def test_usual_comments_of_an_image_are_ignored(tmp_path: Path, head: bytes) -> None:
    path, image = save_map(hall(), tmp_path / "hall")
    expected = load_map(path, CELL)
    pixels = np.frombuffer(image.read_bytes()[-160 * 110 :], np.uint8)
    image.write_bytes(head + pixels.repeat(3 if head[1:2] == b"6" else 1).tobytes())
    assert np.array_equal(load_map(path, CELL).log_odds, expected.log_odds)


@pytest.mark.parametrize(
    "kind",
    [
        *("P5", "P2", "P1", "P4", "PNG", "P3 spaces", "P2 spaces"),
        *("one comment", "in a number", "between numbers", "before pixels"),
    ],
)
def test_endless_comments_and_spaces_are_refused_and_not_read(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Image, "open", pytest.fail)
    path, image = save_map(hall(), tmp_path / "hall")
    long, many = b"#" + b"x" * 1_000_000 + b"\n", b"#\n" * 500_000
    chunk = bytes(4) + b"tEXt" + zlib.crc32(b"tEXt").to_bytes(4, "big")
    png = io.BytesIO()
    Image.new("L", (160, 110)).save(png, "PNG")
    texts = {
        "P3 spaces": b"P3 160 110 255\n" + b" " * 2_000_000,
        "P2 spaces": b"P2 160 110 255\n" + b"0\n" + b"\n" * 2_000_000,
        "one comment": b"P2 160 110 255\n" + b"0 #" + b"x" * 2_000_000 + b"\n",
        "in a number": b"P5 16" + long + b"0 110 255\n",
        "between numbers": b"P5 160 " + many + b"110 255\n",
        "before pixels": b"P5 160 110 255" + long,
        "PNG": png.getvalue()[:33] + 100_000 * chunk + png.getvalue()[33:],
    }
    numbers = b"160 110" if kind in {"P1", "P4"} else b"160 110 255"
    within = many if kind in {"P1", "P2"} else b""
    image.write_bytes(
        texts.get(kind, kind.encode() + b"\n" + (b"" if within else long) + numbers + b"\n" + within)
        + bytes(160 * 110)
    )
    with pytest.raises(UserError, match="with a header and spaces of a usual length"):
        load_map(path, CELL)


@pytest.mark.parametrize("space", [b" ", b"\r\n", b"\t\t\t\t# row\n"])
def test_plain_images_are_read(tmp_path: Path, space: bytes) -> None:
    path, image = save_map(hall(), tmp_path / "hall")
    expected = load_map(path, CELL)
    pixels = np.frombuffer(image.read_bytes()[-160 * 110 :], np.uint8).reshape(110, 160)
    rows = [b"    ".join(b"%3d" % value for value in row) for row in pixels.tolist()]
    image.write_bytes(b"P2\n160 110\n255\n" + space.join(rows) + b"\n")
    assert np.array_equal(load_map(path, CELL).log_odds, expected.log_odds)


@pytest.mark.parametrize("yaw", ["1e-9", "-1.0e-7", "0", "-0.0"])
def test_a_yaw_that_rounding_left_is_none(tmp_path: Path, yaw: str) -> None:
    path, _ = save_map(hall(), tmp_path / "hall")
    path.write_text(path.read_text().replace("0.0, 0.0]", f"0.0, {yaw}]"))
    assert np.array_equal(load_map(path, CELL).occupied, hall().occupied)


@pytest.mark.parametrize(
    "head", ["%YAML 1.0\n---\n", "%YAML 1.1\n---\n", "%YAML 1.2\n---\n", "\ufeff", "\ufeff%YAML 1.0\n---\n"]
)
def test_heads_of_other_writers_of_yaml_are_read(tmp_path: Path, head: str) -> None:
    path, _ = save_map(hall(), tmp_path / "hall")
    path.write_text(head + path.read_text(), encoding="utf-8")
    assert np.array_equal(load_map(path, CELL).occupied, hall().occupied)


def write_map(folder: Path, pixels: Image.Image, **changes: object) -> Path:
    about = {"image": "map.png", "resolution": CELL, "origin": [0.0, 0.0, 0.0], "negate": 0}
    about |= {"occupied_thresh": 0.65, "free_thresh": 0.2, **changes}
    pixels.save(folder / "map.png")
    (folder / "map.yaml").write_text("\n".join(f"{key}: {value}" for key, value in about.items()))
    return folder / "map.yaml"


def test_the_modes_of_map_server_are_understood(tmp_path: Path) -> None:
    shades = np.array([[0, 128, 254, 255]], dtype=np.uint8)
    trinary = load_map(write_map(tmp_path, Image.fromarray(shades), mode="trinary"), CELL).log_odds[:, 0]
    assert np.sign(trinary).tolist() == [1, 0, -1, -1]
    deep = load_map(write_map(tmp_path, Image.fromarray(shades.astype(np.uint16) * 257)), CELL)
    assert np.sign(deep.log_odds[:, 0]).tolist() == [1, 0, -1, -1]
    negated = load_map(write_map(tmp_path, Image.fromarray(shades), negate=1), CELL).log_odds[:, 0]
    assert np.sign(negated).tolist() == [-1, 0, 1, 1]
    alpha = np.stack([np.array([[0, 100, 150, 255]]), np.array([[255, 255, 255, 0]])], axis=-1)
    scale = Image.fromarray(alpha.astype(np.uint8), "LA")
    scaled = load_map(write_map(tmp_path, scale, mode="scale"), CELL).log_odds[:, 0]
    assert np.sign(scaled).tolist() == [1, 1, -1, 0]  # the last one is transparent: unknown
    assert scaled[0] > scaled[1] > 0.0
    percent = np.array([[100, 80, 50, 20, 0, 255]], dtype=np.uint8)
    raw = load_map(write_map(tmp_path, Image.fromarray(percent), mode="raw"), CELL).log_odds[:, 0]
    assert np.sign(raw).tolist() == [1, 1, 0, -1, -1, 0]


@pytest.mark.parametrize("factor", [0.5, 2.0, 2.5])
def test_pixels_of_another_size_are_resampled(tmp_path: Path, factor: float) -> None:
    pixels = np.full((40, 60), 255, dtype=np.uint8)
    pixels[-10:, :20] = 0  # a block at the lower left corner
    path = write_map(tmp_path, Image.fromarray(pixels), resolution=factor * CELL)
    loaded = load_map(path, CELL)
    assert loaded.log_odds.shape == (60 * factor, 40 * factor)
    assert loaded.occupied.sum() == pytest.approx(200 * factor**2, rel=0.1)
    assert loaded.occupied[: int(20 * factor), : int(10 * factor)].all()
