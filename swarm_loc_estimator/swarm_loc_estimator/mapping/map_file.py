"""Maps as files: an image and a YAML file next to it, by the convention of ROS's map_server."""

from __future__ import annotations

import io
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.codec import WHOLE_FILE, TreeChecks
from swarm_loc_estimator.common.files import replacing
from swarm_loc_estimator.common.parameters import NumberSpec, UserError
from swarm_loc_estimator.common.yaml_tree import read_file, read_tree, write_tree
from swarm_loc_estimator.mapping.grid import LOG_ODDS_CAP, OccupancyMap
from swarm_loc_estimator.mapping.messages import GridMessage

_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196
_MODES = ("trinary", "scale", "raw")
_MAX_BYTES = 200_000_000
MAX_CELLS = 50_000_000  # Maximum number of cells: 400 MB, or 141 x 141 m with cells of 2 cm
RESOLUTION = NumberSpec("m", 1e-4, 10.0, False, "side of a pixel")
PLACE = NumberSpec("m", -1e8, 1e8, False, "of the lower left corner")
_NUMBERS = {
    "resolution": RESOLUTION,
    "occupied_thresh": NumberSpec("1", 0.0, 1.0, False, "cells above are occupied"),
    "free_thresh": NumberSpec("1", 0.0, 1.0, False, "cells below are free"),
}
_MAX_YAW = 1e-6  # Of a map [rad], as rounding leaves it: less than a millimetre in a kilometre
_HEADER_BYTES = 1 << 18
_COMMENTS = 1000
_SEPARATOR = rb"(?:\s|#[^\r\n]*[\r\n])+"
_SIZE = 2 * (_SEPARATOR + rb"(\d{1,9})")
_PNM = re.compile(rb"P(?:[14]" + _SIZE + rb"|[2356]" + _SIZE + _SEPARATOR + rb"\d+)\s")
_PLAIN_BYTES = 16  # Maximum number of characters of a number in a plain PNM, with the space around it
_FORMATS = ("PPM", "PNG", "BMP")  # Other decoders of Pillow start programs, or have seen less care


class MapFileError(UserError):
    """A map file that cannot be used."""


def save_map(occupancy: OccupancyMap, path: Path) -> tuple[Path, Path]:
    """Write PATH.yaml and PATH.pgm; returns both, raises FileError if they cannot be written."""
    image_path, yaml_path = path.with_suffix(".pgm"), path.with_suffix(".yaml")
    pixels = np.full(occupancy.log_odds.shape, _UNKNOWN, dtype=np.uint8)
    pixels[occupancy.free], pixels[occupancy.occupied] = _FREE, _OCCUPIED
    image = pixels.T[::-1]  # the first row is the uppermost
    about = {
        "image": image_path.name,
        "mode": "trinary",
        "resolution": float(occupancy.cell),
        "origin": [float(occupancy.corner[0]), float(occupancy.corner[1]), 0.0],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESHOLD,
        "free_thresh": _FREE_THRESHOLD,
    }
    with replacing(image_path) as part:
        head = f"P5\n{image.shape[1]} {image.shape[0]}\n255\n".encode()
        part.write_bytes(head + image.tobytes())  # Pillow does not see where a disk ends
    write_tree(about, yaml_path)
    return yaml_path, image_path


def load_map(path: Path, cell: float | None = None) -> OccupancyMap:
    """Read a map of any of map_server's modes, with cells of the given size [m]; None: its own.

    Pixels of another size are resampled by nearest neighbour.

    Raises:
        UserError: It cannot be read, or is not such a map.
    """
    checks = TreeChecks(path, MapFileError)
    given = checks.mapping(read_tree(path), WHOLE_FILE, required=("image", "origin", "resolution"))
    about = {"occupied_thresh": _OCCUPIED_THRESHOLD, "free_thresh": _FREE_THRESHOLD, **given}
    numbers = {name: checks.number(about[name], name, spec) or 0.0 for name, spec in _NUMBERS.items()}
    places = checks.items(about["origin"], "origin")
    origin = [checks.number(value, "origin", PLACE) or 0.0 for value in places]
    if len(origin) != 3 or abs(origin[2]) > _MAX_YAW:
        raise checks.error("origin", about["origin"], "must be x, y and a yaw of 0")
    mode, negate = about.get("mode", "trinary"), about.get("negate", 0)
    if mode not in _MODES:
        raise checks.error("mode", mode, f"must be one of {', '.join(_MODES)}")
    if negate not in (0, 1):
        raise checks.error("negate", negate, "must be 0 or 1")
    if not isinstance(about["image"], str):
        raise checks.error("image", about["image"], "must be the path of a file")
    pixels, seen = _read_image(path.parent / about["image"])
    shade = np.arange(256) if negate or mode == "raw" else 255 - np.arange(256)
    occupied, free = numbers["occupied_thresh"], numbers["free_thresh"]
    log_odds = _log_odds(shade, mode, free, occupied)[pixels]
    if mode == "scale":
        log_odds[~seen] = 0.0
    own = numbers["resolution"]
    if cell is None:
        return OccupancyMap(np.array(origin[:2]), own, np.ascontiguousarray(log_odds[::-1].T))
    scale = cell / own
    if not math.isclose(scale, 1.0, rel_tol=1e-3):
        log_odds = _resampled(log_odds, scale, checks)
    corner = np.round(np.array(origin[:2]) / cell) * cell
    return OccupancyMap(corner, cell, np.ascontiguousarray(log_odds[::-1].T))


def map_of_message(grid: GridMessage) -> OccupancyMap:
    """The map of a message, with map_server's usual thresholds; one that is turned is resampled.

    Raises:
        MapFileError: No cell is occupied, none is free, or it has too many cells once it is turned back.
    """
    occupied = grid.cells > 100.0 * _OCCUPIED_THRESHOLD
    free = (grid.cells >= 0) & (grid.cells < 100.0 * _FREE_THRESHOLD)
    if not (occupied.any() and free.any()):
        raise MapFileError("The map has no cell that is occupied, or none that is free.")
    log_odds = (LOG_ODDS_CAP * (occupied.astype(np.int8) - free.astype(np.int8))).T
    x, y, yaw = grid.origin
    cell, corner = float(str(np.float32(grid.resolution))), np.array([x, y])  # decimals, as in a file
    if abs(yaw) <= _MAX_YAW:
        return OccupancyMap(corner, cell, np.ascontiguousarray(log_odds))
    # a grid along the axes of `map` around it, whose cells have the value of the turned one at their centres
    cos, sin = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cos, sin], [-sin, cos]])  # rows times it are turned into `map`
    ends = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * log_odds.shape @ turn
    low = np.floor(ends.min(axis=0))
    nx, ny = (np.ceil(ends.max(axis=0)) - low).astype(np.int64).tolist()
    if nx * ny > MAX_CELLS:
        raise MapFileError(f"The map has {nx * ny} cells once it is turned but may have {MAX_CELLS}.")
    turned = np.zeros((nx, ny))
    for i in range(nx):
        centres = np.column_stack([np.full(ny, i + 0.5), np.arange(ny) + 0.5]) + low
        cells = np.floor(centres @ turn.T).astype(np.int64)
        inside = ((cells >= 0) & (cells < log_odds.shape)).all(axis=1)
        turned[i, inside] = log_odds[tuple(cells[inside].T)]
    return OccupancyMap(corner + low * cell, cell, turned)


def _log_odds(shade: NDArray[np.int64], mode: str, free: float, occupied: float) -> FloatArray:
    """Log odds (256,) of pixel values, from their darkness or occupancy in percent (256,)."""
    if mode == "raw":
        probability = np.where(shade <= 100, shade / 100.0, 0.5)
        free, occupied = 0.0, 1.0
    else:
        probability = shade / 255.0
    between = (probability - free) / max(occupied - free, 1e-9) if mode != "trinary" else np.full(256, 0.5)
    between = np.clip(between, 1e-6, 1.0 - 1e-6)
    ends = np.where(probability > occupied, LOG_ODDS_CAP, np.where(probability < free, -LOG_ODDS_CAP, 0.0))
    inside = np.clip(np.log(between / (1.0 - between)), -LOG_ODDS_CAP, LOG_ODDS_CAP)
    return np.asarray(np.where(ends == 0.0, inside, ends))


def _resampled(log_odds: FloatArray, scale: float, checks: TreeChecks) -> FloatArray:
    """Log odds (height, width), the last row lowest, scaled by nearest neighbour."""
    height, width = (max(1, round(size / scale)) for size in log_odds.shape)
    if height * width > MAX_CELLS:
        raise checks.said(f"the map has {height * width} cells of the mapper's size but may have {MAX_CELLS}")
    rows, columns = (
        np.minimum(((np.arange(count) + 0.5) * scale).astype(np.int64), size - 1)
        for count, size in zip((height, width), log_odds.shape, strict=True)
    )
    return np.asarray(log_odds[::-1][rows][::-1][:, columns])


def _check_header(data: bytes) -> None:
    """Raise ValueError if much is before the pixels, which Pillow reads byte by byte or chunk by chunk."""
    head = data[:_HEADER_BYTES]
    is_short = head.startswith(b"BM") or b"IDAT" in head
    if head.startswith(b"P"):  # digits have comments between them, too
        match = _PNM.match(head)
        is_short = match is not None and (head[1:2] > b"3" or _is_dense(data, match))
    if not is_short:
        raise ValueError("it is no PGM, PNG or BMP with a header and spaces of a usual length")


def _is_dense(data: bytes, head: re.Match[bytes]) -> bool:
    """Whether a plain PNM has few comments, and no more space between its numbers than they need."""
    width, height = (int(number) for number in head.groups() if number is not None)
    most = _HEADER_BYTES + _PLAIN_BYTES * width * height * (3 if data[1:2] == b"3" else 1)
    return len(data) <= most and data.count(b"#") <= _COMMENTS


def _read_image(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Gray values (height, width) of an image, and which pixels are opaque; raises UserError."""
    from PIL import Image  # noqa: PLC0415 - an estimator without a map starts without it

    data = read_file(path, _MAX_BYTES)
    try:
        _check_header(data)
        with Image.open(io.BytesIO(data), formats=_FORMATS) as opened:
            image: Any = opened
            small_enough = 0 < image.width * image.height <= MAX_CELLS
            if small_enough and image.mode.startswith("I"):  # 16 bits, which `convert` would cut off
                image = Image.fromarray((np.asarray(image) / 257.0).astype(np.uint8))
            gray: Any = image.convert("LA") if small_enough else None
    except Exception as error:  # decoders raise arbitrary exceptions for broken files
        raise MapFileError(f"The image '{path}' of a map cannot be decoded: {error}.") from error
    if gray is None:
        raise MapFileError(f"The image '{path}' of a map has more than {MAX_CELLS} pixels.")
    values = np.asarray(gray, dtype=np.uint8)
    return values[..., 0], values[..., 1] == 255
