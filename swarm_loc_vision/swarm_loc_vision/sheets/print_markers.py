"""Draw the markers of a swarm description in true size on sheets to print: a PDF.

    print_markers swarm.yaml --family apriltag_36h11 --out markers.pdf
    print_markers --board 3x4 --family apriltag_36h11 --out board.pdf

Each marker has its id, its robot and face, and lines to cut along. --board adds a sheet to lay on the floor
below a camera, and writes its markers to a file of control points of aerial_camera_node: markers_board.yaml.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from swarm_loc_estimator.common.command_line import argument, command, file_to_write, number_in
from swarm_loc_estimator.common.files import check_file
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.aerial.ground_control import Ground
from swarm_loc_vision.aerial.ground_file import save_ground
from swarm_loc_vision.markers.families import families, family_named
from swarm_loc_vision.sheets.pages import (
    PAPERS,
    SheetError,
    board_page,
    floor_markers,
    pages_of,
    save_pdf,
    stickers_of,
)

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
        "--out",
        type=file_to_write(".pdf"),
        default="markers.pdf",
        help="the PDF (default: markers.pdf)",
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
        why = (
            f"{options.swarm_file} has no markers" if options.swarm_file else "name a description, or --board"
        )
        raise SheetError(f"There is nothing to print: {why}.")
    file = options.out.with_name(f"{options.out.stem}_board.yaml")
    check_file(file)
    save_pdf(pages, family, options.paper, options.out)
    print(f"{sum(len(page.pieces) for page in pages)} markers on {len(pages)} sheets in {options.out}")
    if options.board:
        origin = (
            f"{pages[-1].title}. The middle of the board is the origin of map, x to the right of its text."
        )
        save_ground(Ground(markers=floor_markers(pages[-1]), family=family), file, origin)
        print(f"places of the markers of the board in {file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
