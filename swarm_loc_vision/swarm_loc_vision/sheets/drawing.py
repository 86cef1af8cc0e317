"""Sheets as figures: one unit of a figure's axes is 1 mm, and each marker is one closed outline."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.markers.families import Family
from swarm_loc_vision.sheets.pages import EDGE_MM, PAPERS, STRIP_MM, Page, Piece

MM_PER_INCH = 25.4
RULER_MM = 100
_POINTS_PER_MM = 72.0 / MM_PER_INCH
_FAINT = "0.6"
_LINE_PT = 0.4
_TEXT_MM = 2.6
_WIDTH_OF_LETTER = 0.62  # Of its height, at most


def save_pdf(pages: list[Page], family: Family, paper: str, path: Path) -> None:
    """Write sheets as a PDF of vector graphics; the same sheets give the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with PdfPages(path, metadata={"CreationDate": None}) as file:
        for page in pages:
            file.savefig(sheet_figure(page, family, paper))


def sheet_figure(page: Page, family: Family, paper: str) -> Figure:
    """A sheet, with cutting lines, labels, and a ruler to check the scale of the printer."""
    width, height = PAPERS[paper]
    figure = Figure((width / MM_PER_INCH, height / MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set(xlim=(0.0, width), ylim=(0.0, height))
    for piece in page.pieces:
        _draw(axes, piece, family, is_cut=page.is_cut)
    _draw_ruler(axes)
    said = f"{page.title}. Print at 100 % (actual size): the ruler must be {RULER_MM} mm long."
    _write(axes, EDGE_MM, EDGE_MM + 8.0, said, width - 2.0 * EDGE_MM)
    return figure


def outline(black: NDArray[np.bool_], left: float, bottom: float, cell: float) -> Outline:
    """The border of the black cells (n, n), upper row first, as closed loops with black on their right.

    One outline without seams: between squares that only touch, viewers and printers leave fine lines.

    Args:
        black: Which cells are black.
        left: x of the left border.
        bottom: y of the lower border.
        cell: Side of a cell.
    """
    padded = np.pad(black, 1)
    ways: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for row, column in np.argwhere(padded).tolist():
        corners = [(row, column), (row, column + 1), (row + 1, column + 1), (row + 1, column)]
        beside = [(row - 1, column), (row, column + 1), (row + 1, column), (row, column - 1)]
        for side, other in enumerate(beside):
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


def _draw_ruler(axes: Axes) -> None:
    """A line with a tick for each centimetre."""
    x = EDGE_MM + np.arange(0.0, RULER_MM + 1.0, 10.0)
    axes.hlines(EDGE_MM, x[0], x[-1], colors="black", linewidth=_LINE_PT)
    axes.vlines(x, EDGE_MM, EDGE_MM + np.where(np.arange(len(x)) % 5, 2.0, 4.0), colors="black", lw=_LINE_PT)


def _write(axes: Axes, x: float, y: float, said: str, width: float) -> None:
    """Text of a given width at most."""
    size = min(_TEXT_MM, width / (_WIDTH_OF_LETTER * len(said)))
    axes.text(x, y, said, fontsize=size * _POINTS_PER_MM, color="0.3", va="center")
