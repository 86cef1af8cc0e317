"""Which markers go where on the sheets; lengths are in mm from the lower left of the paper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.swarm.swarm import Landmark, Swarm
from swarm_loc_vision.aerial.ground_control import FloorMarker
from swarm_loc_vision.markers.families import Family

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
    faces = [
        Sticker(face.id, 1e3 * face.size, f"{robot.name} {face.name}")
        for robot in swarm.robots
        for face in robot.faces
    ]
    return faces + [Sticker(mark.id, 1e3 * mark.size, _place(mark)) for mark in swarm.landmarks]


def _place(mark: Landmark) -> str:
    yaw = "" if mark.yaw is None else f", {math.degrees(mark.yaw):.3g} deg"
    return f"landmark at {mark.x:g}, {mark.y:g}{yaw}"


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
    """A grid of markers, as far apart as the paper allows, with ids row by row from the upper left.

    Args:
        first_id: Id of the upper left marker.
        columns: Markers side by side.
        rows: Markers one below the other.
        side: Side of the markers [mm].
        family: Their family.
        paper: Name of the paper.

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
    middles = {
        piece.sticker.id: (piece.x + 0.5 * piece.sticker.side, piece.y + 0.5 * piece.sticker.side)
        for piece in board.pieces
    }
    x, y = (0.5 * (min(values) + max(values)) for values in zip(*middles.values(), strict=True))
    return tuple(
        FloorMarker(
            piece.sticker.id,
            round(1e-3 * (middles[piece.sticker.id][0] - x), 6),
            round(1e-3 * (middles[piece.sticker.id][1] - y), 6),
            size=1e-3 * piece.sticker.side,
        )
        for piece in board.pieces
    )


def _piece(sticker: Sticker, family: Family, left: float, bottom: float) -> Piece:
    """A piece whose frame has a given lower left corner [mm]."""
    if sticker.id >= len(family.words):
        raise SheetError(f"marker {sticker.id} is none of {family.name}, which has {len(family.words)} ids.")
    cell = sticker.side / family.side
    margin = max(cell, _LEAST_MARGIN_MM) + family.layout.outside * cell  # of data around the square
    return Piece(sticker, left + margin, bottom + margin + STRIP_MM, margin)
