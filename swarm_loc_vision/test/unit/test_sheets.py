"""Sheets of markers: in true size, read by detectors, and every id on them."""

import io
import re
import zlib
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from swarm_loc_estimator.swarm.swarm import Face, Landmark, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_vision.aerial.ground_control import FloorMarkers, load_ground
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import families, family_named
from swarm_loc_vision.sheets.print_markers import (
    MM_PER_INCH,
    PAPERS,
    Page,
    board_page,
    floor_markers,
    main,
    outline,
    pages_of,
    save_pdf,
    sheet_figure,
    stickers_of,
)

ROBOTS = tuple(
    Robot(f"epuck{k}", faces=tuple(Face(name, 10 * k + n) for n, name in enumerate(("front", "back"))))
    for k in (1, 2)
)
SWARM = Swarm(ROBOTS, (Landmark(22, -1.0, 0.5, yaw=1.5708, size=0.08), Landmark(27, 2.0, 0.0)))
IDS = [10, 11, 20, 21, 22, 27]
DPI = 300
NUMBER = r"(-?[\d.]+)"


def squares_in(pdf: bytes) -> NDArray[np.float64]:
    """Left, bottom, right and top [mm] of all closed outlines on the pages of a PDF, in its own units."""
    found = []
    for stream in re.findall(rb"stream\r?\n(.*?)\r?\nendstream", pdf, re.DOTALL):
        content = zlib.decompress(stream).decode("latin-1")
        for loop in re.findall(rf"{NUMBER} {NUMBER} m\n((?:{NUMBER} {NUMBER} l\n)+)h", content):
            points = np.array([loop[:2], *re.findall(f"{NUMBER} {NUMBER} l", loop[2])], float)
            found.append([*points.min(axis=0), *points.max(axis=0)])
    return np.array(found, float) * MM_PER_INCH / 72.0


def photograph(page: Page, family: str) -> NDArray[np.uint8]:
    """A sheet as it is printed with 300 dots per inch."""
    file = io.BytesIO()
    sheet_figure(page, family_named(family), "a4").savefig(file, dpi=DPI, format="png")
    image = cv2.imdecode(np.frombuffer(file.getvalue(), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image.astype(np.uint8)


def corners_of(page: Page) -> dict[int, NDArray[np.float64]]:
    """Corners (4, 2) of the markers in that image [px], clockwise from the upper left."""
    result = {}
    for piece in page.pieces:
        right, top = piece.x + piece.sticker.side, piece.y + piece.sticker.side
        places = np.array([[piece.x, top], [right, top], [right, piece.y], [piece.x, piece.y]])
        places[:, 1] = PAPERS["a4"][1] - places[:, 1]
        result[piece.sticker.id] = places * DPI / MM_PER_INCH - 0.5
    return result


@pytest.mark.parametrize("paper", PAPERS)
def test_squares_have_their_true_size_and_place_in_the_pdf(tmp_path: Path, paper: str) -> None:
    family = family_named("apriltag_36h11")
    pages = [*pages_of(stickers_of(SWARM), family, paper), board_page(200, 3, 3, 50.0, family, paper)]
    save_pdf(pages, family, paper, tmp_path / "sheets.pdf")
    data = (tmp_path / "sheets.pdf").read_bytes()
    boxes = [float(number) for number in re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", data)[0]]
    assert boxes == pytest.approx([length * 72.0 / MM_PER_INCH for length in PAPERS[paper]], abs=0.01)
    squares = squares_in(data)
    for page in pages:
        for piece in page.pieces:
            side = piece.sticker.side
            wanted = np.array([piece.x, piece.y, piece.x + side, piece.y + side])
            assert np.abs(squares - wanted).max(axis=1).min() < 0.001, piece


@pytest.mark.parametrize("name", families())
def test_every_marker_of_a_printed_sheet_is_read_where_it_is(name: str) -> None:
    detector, read = MarkerDetector(DetectorSettings(), {family_named(name): None}), list[int]()
    for page in pages_of(stickers_of(SWARM), family_named(name), "a4"):
        found, places = detector.detect(photograph(page, name)), corners_of(page)
        read += found.id.tolist()
        errors = [corners - places[k] for k, corners in zip(found.id.tolist(), found.corners, strict=True)]
        assert np.abs(errors).max() < 0.1 * DPI / MM_PER_INCH
    assert sorted(read) == IDS


def test_pieces_lie_on_the_paper_and_apart() -> None:
    family = family_named("artoolkit_bch_thin")
    robots = [Robot(f"r{k}", faces=(Face("a", 2 * k, size=0.02), Face("b", 2 * k + 1))) for k in range(40)]
    swarm = Swarm(tuple(robots), tuple(Landmark(100 + k, 0.0, 0.0, size=0.1) for k in range(5)))
    pages = pages_of(stickers_of(swarm), family, "letter")
    assert len(pages) > 2
    assert sorted(piece.sticker.id for page in pages for piece in page.pieces) == sorted(swarm.owner_of)
    for page in pages:
        frames = np.array([piece.frame for piece in page.pieces])
        low, high = frames[:, :2], frames[:, :2] + frames[:, 2:]
        assert (low >= [10.0 - 1e-6, 24.0 - 1e-6]).all()
        assert (high <= np.array(PAPERS["letter"]) - 10.0 + 1e-6).all()
        for k in range(len(frames)):
            apart = (low[k] >= high - 1e-6) | (high[k] <= low + 1e-6)
            assert apart.any(axis=1).sum() == len(frames) - 1


def test_an_outline_surrounds_the_black_cells_without_seams() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        black = rng.random((6, 6)) < 0.6
        path = outline(black, 0.0, 0.0, 1.0)
        vertices = np.asarray(path.vertices, float)
        ends = [*np.flatnonzero(path.codes == path.MOVETO), len(vertices)]
        loops = [vertices[begin:end] for begin, end in pairwise(ends)]
        area = sum(np.sum(a[:-1, 1] * a[1:, 0] - a[:-1, 0] * a[1:, 1]) / 2.0 for a in loops)
        assert area == black.sum()
        border = sum(np.abs(np.diff(loop, axis=0)).sum() for loop in loops)
        grid = np.pad(black, 1).astype(int)
        assert border == sum(np.abs(np.diff(grid, axis=axis)).sum() for axis in (0, 1))


def test_markers_of_a_board_are_where_the_file_says() -> None:
    family = family_named("aruco_mip_36h12")
    page = board_page(7, 3, 4, 50.0, family, "a4")
    markers = floor_markers(page)
    assert [marker.id for marker in markers] == [*range(7, 19)]
    floor = np.array([[marker.x, marker.y] for marker in markers])
    sheet = np.array([[piece.x, piece.y] for piece in page.pieces])
    assert 1e3 * (floor - floor[0]) == pytest.approx(sheet - sheet[0], abs=1e-6)
    assert floor.min(axis=0) == pytest.approx(-floor.max(axis=0))
    assert floor[0] == pytest.approx([-0.06, 0.0975])
    assert {marker.size for marker in markers} == {0.05}
    image = photograph(page, family.name)
    camera = Camera.from_matrix(image.shape[::-1], np.diag([1e3, 1e3, 1.0]), ())
    points = FloorMarkers(markers, family, camera).look(image)
    assert len(points) == 48
    away = points.pixels * MM_PER_INCH / DPI - 1e3 * points.places[:, :2] * [1.0, -1.0]
    assert np.abs(away - away.mean(axis=0)).max() < 0.1


def test_the_command_writes_sheets_and_the_places_of_a_board(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_swarm(SWARM, tmp_path / "swarm.yaml")
    arguments = [str(tmp_path / "swarm.yaml"), "--board", "3x2", "--family", "aruco_mip_36h12"]
    assert main([*arguments, "--out", str(tmp_path / "a.pdf")]) == 0
    assert "12 markers on 2 sheets" in capsys.readouterr().out
    assert main([*arguments, "--out", str(tmp_path / "b.pdf")]) == 0
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()
    ground = load_ground(tmp_path / "a_board.yaml")
    assert [marker.id for marker in ground.markers] == [*range(28, 34)]
    assert ground.family.name == "aruco_mip_36h12"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["swarm.yaml", "--first-id", "22", "--board", "2x2"], "marker 22 of the board is in"),
        (["swarm.yaml", "--board", "9x9"], "a board of 9 x 9 markers of 50 mm does not fit on a4 paper."),
        (["--board", "1x1", "--size", "0.3"], "a board of 1 x 1 markers of 300 mm does not fit on a4 paper."),
        (["large.yaml"], "marker 3 of 200 mm does not fit on a4 paper."),
        (["bare.yaml"], "There is nothing to print: bare.yaml has no markers."),
        (["swarm.yaml", "--size", "0.1"], "--size and --first-id are those of a board: give --board, too."),
        (["swarm.yaml", "--first-id", "0"], "--size and --first-id are those of a board: give --board, too."),
        ([], "There is nothing to print: name a description, or --board."),
        (
            ["--board", "2x2", "--first-id", "248", "--family", "aruco_mip_36h12"],
            "marker 250 is none of aruco_mip_36h12, which has 250 ids.",
        ),
    ],
)
def test_what_cannot_be_printed_is_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    save_swarm(SWARM, tmp_path / "swarm.yaml")
    save_swarm(Swarm((Robot("a"),)), tmp_path / "bare.yaml")
    save_swarm(Swarm((Robot("a", faces=(Face("top", 3, size=0.2),)),)), tmp_path / "large.yaml")
    assert main(arguments) == 1
    assert said in capsys.readouterr().err
    assert not Path("markers.pdf").exists()
