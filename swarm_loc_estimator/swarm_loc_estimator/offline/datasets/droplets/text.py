"""Parse recordings of Droplets under an overhead camera: one exchange a line, camera poses beside each.

    {"TX", "RX", {{6 counts}, ...}, camera time [s], {"id"->{x, y, orientation}, ...}},

Matrices are as the firmware's console prints them, one row per emitter and one column per sensor. Places are
in pixels, y downwards, orientations in degrees. Ids are the four hexadecimal digits that the robots print.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.errors import UserError

_NUMBER = r"\s*(-?\d{1,7}(?:\.\d{0,9})?)\s*"
_ID = r'"([0-9A-Fa-f]{1,4})"'
_HEAD = rf"\{{\s*{_ID}\s*,\s*{_ID}\s*,\s*\{{(.*?\}})\s*\}}\s*,{_NUMBER},"
_LINE = re.compile(rf"{_HEAD}\s*\{{(.*)\}}\s*\}}\s*,?\s*\}}?")
_ROW = re.compile(r"\{([^{}]*)\}")
_SIGHTING = re.compile(rf"{_ID}\s*->\s*\{{{_NUMBER},{_NUMBER},{_NUMBER}\}}")
_FRAME = ("{", "}", "")
_MAX_BYTES = 200_000_000
_MAX_COUNT = 2**31 - 1


class DropletRecordingError(UserError):
    """A file that is no such recording; the message is one sentence."""


@dataclass(frozen=True)
class Sighting:
    """A fiducial in the camera's image.

    Attributes:
        id: Whose it was read as.
        x: [px], to the right.
        y: [px], downwards.
        orientation: Counter-clockwise as seen in the image [rad].
    """

    id: int
    x: float
    y: float
    orientation: float


@dataclass(frozen=True)
class Exchange:
    """What one robot read of another one's emitters, and where the camera saw all robots.

    Attributes:
        transmitter: Id of the robot that lit its emitters.
        receiver: Id of the robot that measured.
        readings: (n, n) [count], [sensor, emitter].
        time_s: Of the camera.
        sightings: Of the camera.
    """

    transmitter: int
    receiver: int
    readings: FloatArray
    time_s: float
    sightings: tuple[Sighting, ...]


def read_exchanges(path: Path) -> tuple[list[Exchange], Counter[str]]:
    """All exchanges of a file in the order of their times, and how many lines are of no use, by reason.

    Raises:
        DropletRecordingError: It cannot be read, or holds no exchange.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise DropletRecordingError(f"'{path}' has more than {_MAX_BYTES} bytes; is it such a recording?")
        lines = path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError as error:
        raise DropletRecordingError(f"'{path}' cannot be read: {error.strerror or error}.") from error
    exchanges, dropped = list[Exchange](), Counter[str]()
    for line in lines:
        if line.strip() in _FRAME:
            continue
        parsed = parse_line(line)
        if isinstance(parsed, Exchange):
            exchanges.append(parsed)
        else:
            dropped[parsed] += 1
    if not exchanges:
        raise DropletRecordingError(
            f"'{path}' holds no exchange; expected lines"
            ' {"TX", "RX", {{...}, ...}, time, {"id"->{x, y, orientation}, ...}},.'
        )
    return sorted(exchanges, key=lambda one: one.time_s), dropped


def parse_line(line: str) -> Exchange | str:
    """The exchange of a line, or why it is none: `not_an_exchange`, `not_square`, `hears_itself`."""
    match = _LINE.fullmatch(line.strip())
    if match is None:
        return "not_an_exchange"
    transmitter, receiver = int(match[1], 16), int(match[2], 16)
    try:
        rows = [[int(cell) for cell in row.split(",")] for row in _ROW.findall(match[3])]
    except ValueError:
        return "not_an_exchange"
    if len(rows) < 3 or any(len(row) != len(rows) for row in rows):
        return "not_square"
    if max(abs(cell) for row in rows for cell in row) > _MAX_COUNT:
        return "not_an_exchange"
    if transmitter == receiver:
        return "hears_itself"
    sightings = tuple(
        Sighting(int(m[1], 16), float(m[2]), float(m[3]), math.radians(float(m[4])))
        for m in _SIGHTING.finditer(match[5])
    )
    return Exchange(transmitter, receiver, np.array(rows, dtype=float).T, float(match[4]), sightings)
