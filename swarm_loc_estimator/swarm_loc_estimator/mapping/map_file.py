"""Maps as files: an image in PGM and a YAML beside it, by the convention of ROS's map_server."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.yaml_tree import read_tree, shown, tree_text
from swarm_loc_estimator.mapping.grid import LOG_ODDS_CAP, OccupancyMap

_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196
_MAX_BYTES = 500_000_000
_PGM = re.compile(rb"P5\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(\d{1,9})\s+255\s")


class MapFileError(UserError):
    """A map file that cannot be used or written; the message is one sentence."""


def save_map(occupancy: OccupancyMap, path: Path) -> tuple[Path, Path]:
    """Write PATH.yaml and PATH.pgm; returns both.

    Raises:
        MapFileError: They cannot be written.
    """
    image_path, yaml_path = path.with_suffix(".pgm"), path.with_suffix(".yaml")
    pixels = np.full(occupancy.log_odds.shape, _UNKNOWN, dtype=np.uint8)
    pixels[occupancy.free], pixels[occupancy.occupied] = _FREE, _OCCUPIED
    rows = pixels.T[::-1]  # the first row is the uppermost
    header = f"P5\n# {occupancy.cell:.6f} m a pixel\n{rows.shape[1]} {rows.shape[0]}\n255\n"
    about = {
        "image": image_path.name,
        "mode": "trinary",
        "resolution": float(occupancy.cell),
        "origin": [float(occupancy.corner[0]), float(occupancy.corner[1]), 0.0],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESHOLD,
        "free_thresh": _FREE_THRESHOLD,
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for target, data in (
            (image_path, header.encode() + rows.tobytes()),
            (yaml_path, tree_text(about).encode()),
        ):
            part = target.with_name(f"{target.name}.part")
            part.write_bytes(data)
            part.replace(target)
    except OSError as error:
        raise MapFileError(f"The map cannot be written to '{path}': {error.strerror}.") from error
    return yaml_path, image_path


def load_map(path: Path, cell: float) -> OccupancyMap:
    """Read a map that has cells of some size [m].

    Raises:
        UserError: It cannot be read, or is not such a map.
    """
    about = read_tree(path)
    if not isinstance(about, dict):
        raise MapFileError(f"'{path}' does not describe a map.")
    resolution = _number(about, "resolution", path)
    if not math.isclose(resolution, cell, rel_tol=1e-3):
        raise MapFileError(f"'{path}' has cells of {resolution:g} m but the mapper's have {cell:g} m.")
    origin = about.get("origin")
    if (
        not isinstance(origin, list)
        or len(origin) != 3
        or not all(isinstance(o, int | float) for o in origin)
    ):
        raise MapFileError(f"'{path}': origin must be a list of x, y and yaw.")
    if not all(math.isfinite(o) for o in origin) or origin[2] != 0.0:
        raise MapFileError(f"'{path}': origin must be finite and its yaw 0, not {origin[2]:g}.")
    pixels = _read_pgm(path.parent / str(about.get("image", "")))
    shade = pixels / 255.0 if about.get("negate") else 1.0 - pixels / 255.0
    occupied, free = _number(about, "occupied_thresh", path), _number(about, "free_thresh", path)
    log_odds = np.where(shade > occupied, LOG_ODDS_CAP, np.where(shade < free, -LOG_ODDS_CAP, 0.0))
    corner = np.round(np.array(origin[:2], dtype=float) / cell) * cell
    return OccupancyMap(corner, cell, np.ascontiguousarray(log_odds[::-1].T))


def _number(about: Mapping[str, Any], key: str, path: Path) -> float:
    value = about.get(key)
    if not isinstance(value, int | float) or not math.isfinite(value) or value <= 0.0:
        raise MapFileError(f"'{path}': {key} must be a number above 0, not {shown(value)}.")
    return float(value)


def _read_pgm(path: Path) -> NDArray[np.uint8]:
    """Pixels (height, width) of a binary PGM of one byte a pixel."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise MapFileError(f"The image '{path}' of a map is larger than {_MAX_BYTES} bytes.")
        data = path.read_bytes()
    except OSError as error:
        raise MapFileError(f"The image '{path}' of a map cannot be read: {error.strerror}.") from error
    header = _PGM.match(data)
    if header is None:
        raise MapFileError(f"'{path}' is no binary PGM with values up to 255.")
    width, height = int(header[1]), int(header[2])
    pixels = np.frombuffer(data, dtype=np.uint8, offset=header.end())
    if len(pixels) != width * height or not len(pixels):
        raise MapFileError(f"'{path}' says {width} x {height} pixels but holds {len(pixels)}.")
    return pixels.reshape(height, width)
