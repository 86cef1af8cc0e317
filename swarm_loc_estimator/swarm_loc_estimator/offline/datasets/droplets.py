"""Read recordings of Droplets under an overhead camera: one exchange per line, with camera poses.

    {"TX", "RX", {{6 counts}, ...}, camera time [s], {"id"->{x, y, orientation}, ...}},

Matrices are printed by the firmware's console, one row per emitter and one column per sensor. Positions are
in pixels, y downwards, orientations in degrees. Ids are four hexadecimal digits.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.se2 import wrap_angle

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
    """A file that is not such a recording; the message is one sentence."""


@dataclass(frozen=True)
class Sighting:
    """A fiducial in the camera's image."""

    id: int  # As read by the camera
    x: float  # [px], to the right
    y: float  # [px], downwards
    orientation: float  # Counter-clockwise as seen in the image [rad]


@dataclass(frozen=True)
class Exchange:
    """Readings of one robot while another lit its emitters, and the camera's detections at that time."""

    transmitter: int  # Id of the robot that lit its emitters
    receiver: int  # Id of the robot that measured
    readings: FloatArray  # (n, n) [count], [sensor, emitter]
    time_s: float  # Of the camera
    sightings: tuple[Sighting, ...]  # Of the camera


def read_exchanges(path: Path) -> tuple[list[Exchange], Counter[str]]:
    """All exchanges of a file in the order of their times, and the number of unusable lines by reason.

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
    """The exchange of a line, or the reason to drop it: `not_an_exchange`, `not_square`, `hears_itself`."""
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


SAME_PLACE_PX = 3.5  # A standing robot moves less than this between two sightings
SAME_TURN = math.radians(8.0)
MAX_GAP_S = 30.0  # A robot unseen for longer may have moved
_QUARTER = 0.5 * math.pi


@dataclass
class Place:
    """A robot that stands, or moves very slowly."""

    moments: list[int] = field(default_factory=list)  # Indices of the exchanges at which it was seen
    seen: list[Sighting] = field(default_factory=list)  # Its sightings, one per moment
    # One per moment: the orientation up to quarter turns, continuous [rad]
    turned: list[float] = field(default_factory=list)

    @property
    def owner(self) -> int:
        """The most frequent id."""
        return Counter(one.id for one in self.seen).most_common(1)[0][0]

    @property
    def votes(self) -> int:
        """Number of sightings with the id of the owner."""
        return sum(one.id == self.owner for one in self.seen)

    @property
    def quarter(self) -> int:
        """Quarter turns from `turned` to the orientation of most sightings of the owner."""
        owner = self.owner
        votes = Counter(
            round((one.orientation - turned) / _QUARTER) % 4
            for one, turned in zip(self.seen, self.turned, strict=True)
            if one.id == owner
        )
        return votes.most_common(1)[0][0]

    def distance_to(self, sighting: Sighting) -> float:
        """Distance from its last sighting [px]; infinite if the orientations differ."""
        last = self.seen[-1]
        turn = abs(_within_quarter(sighting.orientation - self.turned[-1]))
        return math.hypot(sighting.x - last.x, sighting.y - last.y) if turn < SAME_TURN else math.inf

    def add(self, moment: int, sighting: Sighting) -> None:
        """Add a sighting."""
        self.moments.append(moment)
        self.seen.append(sighting)
        before = self.turned[-1] if self.turned else sighting.orientation
        self.turned.append(before + _within_quarter(sighting.orientation - before))


@dataclass(frozen=True)
class CameraPose:
    """Pose of a standing robot in the image."""

    x: float  # [px], to the right
    y: float  # [px], downwards
    orientation: float  # As in `Sighting` [rad]
    stand: int  # Number of the place at which the robot stands; poses of one place have the same quarter turn


@dataclass
class CleanTruth:
    """Poses of all standing robots."""

    poses: list[dict[int, CameraPose]]  # One mapping per exchange: robot -> its pose, if known
    remarks: Counter[str]  # Kind of correction or drop -> count


def clean(exchanges: Sequence[Exchange]) -> CleanTruth:
    """Find the poses of all robots at each exchange."""
    remarks = Counter[str]()
    owned: dict[int, list[Place]] = {}
    for place in find_places(exchanges):
        if len(place.seen) < 2:
            remarks["sightings of robots on the move or seen once dropped"] += len(place.seen)
        else:
            owned.setdefault(place.owner, []).append(place)
    poses: list[dict[int, CameraPose]] = [{} for _ in exchanges]
    stand = 0
    for owner, places in owned.items():
        for place in _without_overlaps(places, remarks):
            stand += 1
            _write(place, owner, stand, poses, remarks)
    return CleanTruth(poses, remarks)


def find_places(exchanges: Sequence[Exchange]) -> list[Place]:
    """All places in the order of their first sightings."""
    places, open_places = list[Place](), list[Place]()
    for moment, exchange in enumerate(exchanges):
        open_places = [
            place
            for place in open_places
            if exchange.time_s - exchanges[place.moments[-1]].time_s <= MAX_GAP_S
        ]
        taken: set[int] = set()
        for sighting in exchange.sightings:
            free = [place for place in open_places if id(place) not in taken]
            nearest = min(free, key=lambda place, one=sighting: place.distance_to(one), default=None)  # type: ignore[misc]
            if nearest is None or nearest.distance_to(sighting) > SAME_PLACE_PX:
                nearest = Place()
                places.append(nearest)
                open_places.append(nearest)
            nearest.add(moment, sighting)
            taken.add(id(nearest))
    return places


def _without_overlaps(places: list[Place], remarks: Counter[str]) -> list[Place]:
    """Places of one robot that do not overlap in time; of overlapping ones that with more sightings."""
    kept: list[Place] = []
    for place in sorted(places, key=lambda one: -one.votes):
        first, last = place.moments[0], place.moments[-1]
        if any(first <= other.moments[-1] and other.moments[0] <= last for other in kept):
            remarks["sightings of a robot in two places dropped"] += len(place.seen)
        else:
            kept.append(place)
    return kept


def _write(
    place: Place,
    owner: int,
    stand: int,
    poses: list[dict[int, CameraPose]],
    remarks: Counter[str],
) -> None:
    """Write a robot's poses while it stood at a place, also between sightings."""
    quarter = place.quarter
    for k, moment in enumerate(place.moments):
        seen, turned = place.seen[k], place.turned[k] + quarter * _QUARTER
        remarks["ids misread, corrected"] += seen.id != owner
        remarks["orientations a quarter or half turn off, corrected"] += (
            seen.id == owner and abs(float(wrap_angle(seen.orientation - turned))) > 0.5 * _QUARTER
        )
        until = place.moments[k + 1] if k + 1 < len(place.moments) else moment + 1
        for between in range(moment, until):
            poses[between][owner] = CameraPose(seen.x, seen.y, turned, stand)


def _within_quarter(angle: float) -> float:
    """An angle modulo quarter turns, within +-pi/4 [rad]."""
    return angle - _QUARTER * round(angle / _QUARTER)
