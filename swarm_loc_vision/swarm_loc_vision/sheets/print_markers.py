"""Draw the markers of a swarm description in true size on sheets to print: a PDF.

    print_markers swarm.yaml --family apriltag_36h11 --out markers.pdf
    print_markers --board 3x4 --family apriltag_36h11 --out board.pdf

Each marker has its id, its robot and face, and lines to cut along. --board adds a sheet to lay on the floor
below a camera, and writes its markers to a file of control points of aerial_camera_node: markers_board.yaml.
"""

from __future__ import annotations

import argparse
import io
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.command_line import argument, command, file_to_write, number_in
from swarm_loc_estimator.common.files import check_file, replacing
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.aerial.ground_control import FloorMarker, Ground, save_ground
from swarm_loc_vision.markers.families import Family, families, family_named

MM_PER_INCH = 25.4
RULER_MM = 100
_POINTS_PER_MM = 72.0 / MM_PER_INCH
_FAINT = "0.6"
_LINE_PT = 0.4
_TEXT_MM = 2.6
_WIDTH_OF_LETTER = 0.62  # Of its height, at most


def save_pdf(pages: list[Page], family: Family, paper: str, path: Path) -> None:
    """Write sheets as a PDF of vector graphics; the same sheets give the same bytes."""
    data = io.BytesIO()  # PdfPages hides errors of files
    with PdfPages(data, metadata={"CreationDate": None}) as file:
        for page in pages:
            file.savefig(sheet_figure(page, family, paper))
    with replacing(path) as part:
        part.write_bytes(data.getvalue())


def sheet_figure(page: Page, family: Family, paper: str) -> Figure:
    """A sheet, with cutting lines, labels, and a ruler to check the scale of the printer."""
    width, height = PAPERS[paper]
    figure = Figure((width / MM_PER_INCH, height / MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set(xlim=(0.0, width), ylim=(0.0, height))
    for piece in page.pieces:
        _draw(axes, piece, family, is_cut=page.is_cut)
    # the ruler has a tick for each centimetre
    x = EDGE_MM + np.arange(0.0, RULER_MM + 1.0, 10.0)
    axes.hlines(EDGE_MM, x[0], x[-1], colors="black", linewidth=_LINE_PT)
    axes.vlines(x, EDGE_MM, EDGE_MM + np.where(np.arange(len(x)) % 5, 2.0, 4.0), colors="black", lw=_LINE_PT)
    said = f"{page.title}. Print at 100 % (actual size): the ruler must be {RULER_MM} mm long."
    _write(axes, EDGE_MM, EDGE_MM + 8.0, said, width - 2.0 * EDGE_MM)
    return figure


def outline(black: NDArray[np.bool_], left: float, bottom: float, cell: float) -> Outline:
    """The border of the black cells (n, n), upper row first, as closed loops with black on their right.

    One outline without seams: between squares that only touch, viewers and printers leave fine lines. The
    cells begin at `left` and at `bottom`, and have sides of `cell`.
    """
    padded = np.pad(black, 1)
    ways: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for row, column in np.argwhere(padded).tolist():
        corners = [(row, column), (row, column + 1), (row + 1, column + 1), (row + 1, column)]
        neighbours = [(row - 1, column), (row, column + 1), (row + 1, column), (row, column - 1)]
        for side, other in enumerate(neighbours):
            if not padded[other]:
                ways.setdefault(corners[side], []).append(corners[(side + 1) % 4])
    loops: list[Outline] = []
    while ways:
        start = here = next(iter(ways))
        loop = [start]
        while not loop[1:] or here != start:
            here = ways[here].pop() if len(ways[here]) > 1 else ways.pop(here)[0]
            loop.append(here)
        loops.append(Outline(_places(loop, len(black), left, bottom, cell), closed=True))
    return Outline.make_compound_path(*loops)


def _places(corners: list[tuple[int, int]], size: int, left: float, bottom: float, cell: float) -> FloatArray:
    """(n, 2) places of corners, which count rows from above; those of padded cells begin at 1."""
    rows, columns = np.array(corners, float).T - 1.0
    return np.column_stack([left + cell * columns, bottom + cell * (size - rows)])


def _draw(axes: Axes, piece: Piece, family: Family, *, is_cut: bool) -> None:
    """One marker, its label and its cutting line."""
    sticker = piece.sticker
    black = family.pattern(sticker.id) == 0
    cell = sticker.side / family.side
    outside = family.layout.outside * cell  # some families have data around their square
    path = outline(black, piece.x - outside, piece.y - outside, cell)
    axes.add_patch(PathPatch(path, facecolor="black", linewidth=0.0, snap=False))
    left, bottom, width, height = piece.frame
    if is_cut:
        line = Rectangle((left, bottom), width, height, fill=False, edgecolor=_FAINT, linewidth=_LINE_PT)
        axes.add_patch(line)
    _write(axes, piece.x, bottom + 0.4 * STRIP_MM, f"{sticker.id}  {sticker.label}", width - piece.margin)


def _write(axes: Axes, x: float, y: float, said: str, width: float) -> None:
    """Text of a given width at most."""
    size = min(_TEXT_MM, width / (_WIDTH_OF_LETTER * len(said)))
    axes.text(x, y, said, fontsize=size * _POINTS_PER_MM, color="0.3", va="center")


PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4), "a3": (297.0, 420.0)}  # Width and height [mm]
EDGE_MM = 10.0  # Width of the paper's edge, on which printers cannot print
FOOT_MM = 14.0  # Height of the ruler and its text
STRIP_MM = 5.0  # Height of the label below a marker
_LEAST_MARGIN_MM = 3.0
_PITCH_STEP_MM = 5.0


class SheetError(UserError):
    """Markers that cannot be printed; the message is one sentence."""


@dataclass(frozen=True)
class Sticker:
    """A marker to print."""

    id: int  # Marker id
    side: float  # Side of its black square [mm]
    label: str  # What it is for


@dataclass(frozen=True)
class Piece:
    """A sticker on a sheet."""

    sticker: Sticker  # The marker
    x: float  # Left of its black square [mm]
    y: float  # Bottom of its black square [mm]
    margin: float  # White margin around it, and above its label [mm]

    @property
    def frame(self) -> tuple[float, float, float, float]:
        """Left, bottom, width and height of what is cut out, with its label [mm]."""
        width = self.sticker.side + 2.0 * self.margin
        bottom = self.y - self.margin - STRIP_MM
        return self.x - self.margin, bottom, width, width + STRIP_MM


@dataclass(frozen=True)
class Page:
    """One sheet."""

    title: str  # What is on it
    pieces: Sequence[Piece]  # Its markers
    is_cut: bool = True  # Whether its markers are cut out


def stickers_of(swarm: Swarm) -> list[Sticker]:
    """The markers of a swarm: faces robot by robot, then landmarks with their places."""
    stickers = [
        Sticker(face.id, 1e3 * face.size, f"{robot.name} {face.name}")
        for robot in swarm.robots
        for face in robot.faces
    ]
    for mark in swarm.landmarks:
        yaw = "" if mark.yaw is None else f", {math.degrees(mark.yaw):.3g} deg"
        stickers.append(Sticker(mark.id, 1e3 * mark.size, f"landmark at {mark.x:g}, {mark.y:g}{yaw}"))
    return stickers


def pages_of(stickers: Sequence[Sticker], family: Family, paper: str) -> list[Page]:
    """Sheets with as many markers as fit, row by row from above, in the given order.

    Raises:
        SheetError: A marker is larger than the paper, or the family does not have its id.
    """
    width, height = PAPERS[paper]
    pages: list[list[Piece]] = [[]]
    x, top, bottom = EDGE_MM, height - EDGE_MM, height - EDGE_MM
    for sticker in stickers:
        _, _, wide, high = _piece(sticker, family, 0.0, 0.0).frame
        if wide > width - 2.0 * EDGE_MM or high > height - 2.0 * EDGE_MM - FOOT_MM:
            raise SheetError(f"marker {sticker.id} of {sticker.side:g} mm does not fit on {paper} paper.")
        if x + wide > width - EDGE_MM + 1e-9:
            x, top = EDGE_MM, bottom
        if top - high < EDGE_MM + FOOT_MM - 1e-9:
            pages.append([])
            x, top, bottom = EDGE_MM, height - EDGE_MM, height - EDGE_MM
        pages[-1].append(_piece(sticker, family, x, top - high))
        x, bottom = x + wide, min(bottom, top - high)
    count = len(pages)
    return [Page(f"{family.name}, sheet {k} of {count}", page) for k, page in enumerate(pages, 1) if page]


def board_page(first_id: int, columns: int, rows: int, side: float, family: Family, paper: str) -> Page:
    """A grid of markers of a side [mm], as far apart as the paper allows.

    Ids begin with `first_id` at the upper left, and go row by row.

    Raises:
        SheetError: They do not fit, or the family does not have their ids.
    """
    label = f"board of {columns} x {rows}"
    first = _piece(Sticker(first_id, side, label), family, 0.0, 0.0)
    _, _, wide, high = first.frame
    width, height = (length - 2.0 * EDGE_MM for length in PAPERS[paper])
    across = _pitch(width - wide, columns, side + first.margin)
    down = _pitch(height - FOOT_MM - high, rows, side + first.margin + STRIP_MM)
    if across is None or down is None:
        raise SheetError(f"a {label} markers of {side:g} mm does not fit on {paper} paper.")
    pieces = []
    for row, column in product(range(rows), range(columns)):
        sticker = Sticker(first_id + row * columns + column, side, label)
        bottom = EDGE_MM + FOOT_MM + (rows - 1 - row) * down
        pieces.append(_piece(sticker, family, EDGE_MM + column * across, bottom))
    apart = f"{across:g} mm apart to the right, {down:g} mm down"
    return Page(f"{family.name}, {label} markers of {side:g} mm, {apart}", pieces, is_cut=False)


def _pitch(room: float, count: int, least: float) -> float | None:
    """Largest round distance between middles of markers that may move by `room` [mm]; None: they overlap."""
    pitch = _PITCH_STEP_MM * math.floor(room / (count - 1) / _PITCH_STEP_MM) if count > 1 else 0.0
    return None if room < 0.0 or (count > 1 and pitch < least) else pitch


def floor_markers(board: Page) -> tuple[FloorMarker, ...]:
    """The markers of a board on the floor, in a map with its middle as origin and x to the right."""
    middles = np.array([(piece.x, piece.y) for piece in board.pieces])
    middles += 0.5 * np.array([[piece.sticker.side] for piece in board.pieces])
    places = np.round(1e-3 * (middles - 0.5 * (middles.min(axis=0) + middles.max(axis=0))), 6).tolist()
    stickers = [piece.sticker for piece in board.pieces]
    return tuple(
        FloorMarker(sticker.id, x, y, size=1e-3 * sticker.side)
        for sticker, (x, y) in zip(stickers, places, strict=True)
    )


def _piece(sticker: Sticker, family: Family, left: float, bottom: float) -> Piece:
    """A piece whose frame has a given lower left corner [mm]."""
    if sticker.id >= len(family.words):
        raise SheetError(f"marker {sticker.id} is none of {family.name}, which has {len(family.words)} ids.")
    cell = sticker.side / family.side
    margin = max(cell, _LEAST_MARGIN_MM) + family.layout.outside * cell  # of data around the square
    return Piece(sticker, left + margin, bottom + margin + STRIP_MM, margin)


_BOARD_SIDE_M = 0.05
_GRID = re.compile(r"([1-9]\d?)x([1-9]\d?)")


def _grid(text: str) -> list[int]:
    match = _GRID.fullmatch(text)
    if match is None:
        raise argparse.ArgumentTypeError(f"'{text}' must be columns and rows, such as 3x4")
    return [int(number) for number in match.groups()]


@command(
    __doc__,
    argument("swarm_file", metavar="SWARM_FILE", type=Path, nargs="?", help="swarm description"),
    argument(
        "--out", type=file_to_write(".pdf"), default="markers.pdf", help="the PDF (default: markers.pdf)"
    ),
    argument(
        "--family", choices=list(families()), default="artoolkit_bch_thin", help="as of marker_detector_node"
    ),
    argument("--paper", choices=list(PAPERS), default="a4", help="size of the sheets (default: a4)"),
    argument("--board", type=_grid, metavar="COLUMNSxROWS", help="add a grid of markers"),
    argument(
        "--size", type=number_in(0.005, 1.0, "m"), help=f"side of those markers (default: {_BOARD_SIDE_M} m)"
    ),
    argument(
        "--first-id",
        type=number_in(0, 2**32 - 1),
        help="id of the first one (default: the next after the swarm's)",
    ),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    if not options.board and (options.size is not None or options.first_id is not None):
        raise SheetError("--size and --first-id are those of a board: give --board, too.")
    family = family_named(options.family)
    swarm = load_swarm(options.swarm_file) if options.swarm_file else Swarm()
    pages = pages_of(stickers_of(swarm), family, options.paper)
    if options.board:
        first = max(swarm.owner_of, default=-1) + 1 if options.first_id is None else options.first_id
        columns, rows = options.board
        board = board_page(first, columns, rows, 1e3 * (options.size or _BOARD_SIDE_M), family, options.paper)
        if taken := [piece.sticker.id for piece in board.pieces if piece.sticker.id in swarm.owner_of]:
            raise SheetError(
                f"marker {taken[0]} of the board is in {options.swarm_file}, too: see --first-id."
            )
        pages.append(board)
    if not pages:
        file = options.swarm_file
        why = f"{file} has no markers" if file else "name a description, or --board"
        raise SheetError(f"There is nothing to print: {why}.")
    file = options.out.with_name(f"{options.out.stem}_board.yaml")
    check_file(file)
    save_pdf(pages, family, options.paper, options.out)
    print(f"{sum(len(page.pieces) for page in pages)} markers on {len(pages)} sheets in {options.out}")
    if options.board:
        origin = "The middle of the board is the origin of map, x to the right of its text."
        origin = f"{pages[-1].title}. {origin}"
        save_ground(Ground(markers=floor_markers(pages[-1]), family=family), file, origin)
        print(f"places of the markers of the board in {file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
