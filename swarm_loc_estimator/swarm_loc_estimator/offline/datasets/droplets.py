"""Recordings of Droplets under an overhead camera: read, cleaned, and written as a bag with its description.

    {"TX", "RX", {{6 counts}, ...}, camera time [s], {"id"->{x, y, orientation}, ...}},

There is one exchange per line, with camera poses. Matrices are printed by the firmware's console, one row per
emitter and one column per sensor. Positions are in pixels, y downwards, orientations in degrees. Ids are four
hexadecimal digits.

The orientation of the fiducials on the robots is found from the brightness matrices. The sums of a matrix
over sensors and emitters point to the other robot whatever the board's curves are, eqs (5)-(10) of the
Droplet paper. The mean of each robot gives the quarter turn of its fiducial, and all together whether the
image is mirrored. The mean while a robot stood at one place shows whether its fiducial was misread there.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import POSE_STAMPED
from swarm_loc_estimator.common.messages.detections import encode_brightness
from swarm_loc_estimator.common.messages.poses import encode_fix, encode_pose_stamped
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.sensors.inputs import kinds
from swarm_loc_estimator.swarm.error_models import RandomWalk
from swarm_loc_estimator.swarm.ir_board import IrPlatform, RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.swarm import Pose2, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm

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
    """A file that is not such a recording."""


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

    Raises DropletRecordingError if it cannot be read, or holds no exchange.
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
    # all places in the order of their first sightings
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
    # the places of each robot, and its poses there
    owned: dict[int, list[Place]] = {}
    for place in places:
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
    place: Place, owner: int, stand: int, poses: list[dict[int, CameraPose]], remarks: Counter[str]
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


ROBOT_TYPE = "droplet"
DIAMETER_M = 0.044
METRES_PER_PIXEL = DIAMETER_M / 42.0  # Robots that touch are 42 pixels apart in the recordings of 2016
FIX_SIGMA = (0.001, 0.001, 0.05)  # Standard deviations of fixes by the camera: x, y [m], heading [rad]
WALK = RandomWalk(position=1e-4, heading=3e-2)
"""By the camera, over 1 to 10 minutes: of the fastest robot of each recording; most move a tenth of that."""
_NS = 1_000_000_000
_BRIGHTNESS, _FIXES = kinds()["brightness"], kinds()["fixes"]

_CLEAR = 8.0  # Matrices whose brightest reading is not this far above the noise are not used [sigma]
_ONE_WAY = 0.5  # If the mean vector of all directions is shorter, matrices and camera contradict each other
_VOTES, _AGREED, _NEAR_QUARTER = 5, 0.7, math.radians(30.0)
"""A fiducial was misread at a stand if at least this number of directions have a mean vector of at least this
length within this angle of another quarter turn. Dark elements turn directions by up to 60 degrees."""


@dataclass(frozen=True)
class Fiducials:
    """Orientation of all fiducials."""

    handedness: int  # 1 if x and y of the image are those of map, -1 if y points the other way
    # Robot -> from the orientation of its fiducial to its own [rad], a multiple of a quarter turn
    turn_of: Mapping[int, float]
    misread: Mapping[int, float]  # `CameraPose.stand` -> additional turn where the fiducial was misread [rad]

    def pose(self, robot: int, seen: CameraPose, metres_per_pixel: float) -> Pose2:
        """The robot's pose x, y [m], heading [rad] in map."""
        turned = self.handedness * seen.orientation + self.turn_of[robot] + self.misread.get(seen.stand, 0.0)
        x, y = metres_per_pixel * seen.x, self.handedness * metres_per_pixel * seen.y
        return x, y, float(wrap_angle(turned))


def find_fiducials(
    exchanges: Sequence[Exchange], poses: Sequence[Mapping[int, CameraPose]], angles: FloatArray
) -> Fiducials:
    """Find the orientation of all fiducials of a recording.

    `poses` has one mapping per exchange: robot -> pose in the image; angles (n,) are directions of the
    elements in base_link [rad]. Raises DropletRecordingError if matrices and camera contradict each other
    however the image is turned.
    """
    floor = _CLEAR * _noise(exchanges)
    rows = [
        k
        for k, (one, where) in enumerate(zip(exchanges, poses, strict=True))
        if one.receiver in where and one.transmitter in where and one.readings.max() > floor
    ]
    clear, there = [exchanges[k] for k in rows], [poses[k] for k in rows]
    found = [(_directions(clear, there, angles, sign), sign) for sign in (1, -1)]
    directions, handedness = max(found, key=lambda one: _share(one[0]))
    share = _share(directions)
    if share < _ONE_WAY:
        raise DropletRecordingError(
            f"brightness matrices and camera contradict each other: directions agree to {share:.2f}"
            f" of 1 in {len(rows)} exchanges, at least {_ONE_WAY} is needed."
        )
    turns = {robot: _QUARTER * round(np.angle(_sum(of)) / _QUARTER) for robot, of in directions.items()}
    misread = {
        stand: turn
        for robot, of_stands in directions.items()
        for stand, of_stand in of_stands.items()
        if (turn := _misread_turn(np.array(of_stand) * np.exp(-1j * turns[robot])))
    }
    usual = float(np.median(list(turns.values())))
    everybody = {robot for where in poses for robot in where}
    return Fiducials(handedness, {robot: turns.get(robot, usual) for robot in everybody}, misread)


Directions = dict[int, dict[int, list[complex]]]
"""Unit vectors from the orientation of a fiducial to the robot's heading, by robot and stand."""


def _directions(
    exchanges: Sequence[Exchange], poses: Sequence[Mapping[int, CameraPose]], angles: FloatArray, sign: int
) -> Directions:
    """Directions of all robots; each depends on the positions of both robots but on one orientation only."""
    found: Directions = {}
    units = np.exp(1j * angles)
    for one, where in zip(exchanges, poses, strict=True):
        light = np.clip(one.readings, 0.0, None)
        bearing = np.angle(units @ light.sum(axis=1))
        heading = np.angle(-(units @ light @ units.conj()))
        receiver, transmitter = where[one.receiver], where[one.transmitter]
        forward = math.atan2(sign * (transmitter.y - receiver.y), transmitter.x - receiver.x) - bearing
        for robot, there, by_matrix in (
            (one.receiver, receiver, forward),
            (one.transmitter, transmitter, forward + heading),
        ):
            turn = np.exp(1j * (by_matrix - sign * there.orientation))
            found.setdefault(robot, {}).setdefault(there.stand, []).append(turn)
    return found


def _sum(of_stands: Mapping[int, Sequence[complex]]) -> complex:
    """Sum of all directions of a robot."""
    return sum((direction for of_stand in of_stands.values() for direction in of_stand), 0j)


def _share(directions: Directions) -> float:
    """Length of the mean vector of all directions, at most 1."""
    count = sum(len(of_stand) for of_stands in directions.values() for of_stand in of_stands.values())
    return sum(abs(_sum(of_stands)) for of_stands in directions.values()) / max(count, 1)


def _misread_turn(directions: NDArray[np.complex128]) -> float:
    """Multiple of a quarter turn that the directions (k,) of one stand clearly show [rad]; 0: none."""
    mean = np.mean(directions)
    off = float(np.angle(mean))
    turn = _QUARTER * round(off / _QUARTER)
    clear = len(directions) >= _VOTES and abs(mean) >= _AGREED and abs(off - turn) < _NEAR_QUARTER
    return turn if clear else 0.0


def _noise(exchanges: Sequence[Exchange]) -> float:
    """Robust standard deviation of all readings, most of which are dark [count]."""
    values = np.concatenate([one.readings.ravel() for one in exchanges])
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1.0)


@dataclass(frozen=True)
class ImportSettings:
    """Settings of an import that the files do not contain."""

    platform: str = "droplet_2016"  # Packaged name or path of the board of all robots
    metres_per_pixel: float = METRES_PER_PIXEL  # Of the camera's image


@dataclass(frozen=True)
class DropletImport:
    """Result of an import."""

    exchanges: int  # Their number
    with_truth: int  # Number of those with both robots' poses known
    fiducials: Fiducials  # Their orientation
    remarks: tuple[str, ...]  # Corrections and drops, one sentence each


def import_recording(
    path: Path, folder: Path, settings: ImportSettings, progress: Callable[[float, str], None]
) -> DropletImport:
    """Write a recording as a bag with its `swarm.yaml` inside.

    The bag holds <robot>/brightness, <robot>/ground_truth at each exchange, and <robot>/fix of the receivers.

    Raises:
        DropletRecordingError: The recording cannot be used.
        BagError: The folder is there already, or cannot be created.
    """
    progress(0.0, "reading")
    platform = load_ir_platform(settings.platform)
    exchanges, dropped = read_exchanges(path)
    sized = [one for one in exchanges if len(one.readings) == platform.n]
    dropped["of_another_board"] += len(exchanges) - len(sized)
    progress(0.3, "cleaning")
    truth = clean(sized)
    fiducials = find_fiducials(sized, truth.poses, np.array(platform.angles))
    truth.remarks["orientations contradicted by brightness matrices, corrected"] = sum(
        seen.stand in fiducials.misread for where in truth.poses for seen in where.values()
    )
    swarm = _describe(sized, truth.poses, settings.platform, platform)
    progress(0.6, "writing")
    places = [
        {robot: fiducials.pose(robot, seen, settings.metres_per_pixel) for robot, seen in where.items()}
        for where in truth.poses
    ]
    known = sum(
        one.receiver in where and one.transmitter in where
        for one, where in zip(sized, truth.poses, strict=True)
    )
    counts = sorted((what.replace("_", " "), count) for what, count in (dropped + truth.remarks).items())
    remarks = tuple(f"{count} {what}." for what, count in counts if count)
    comment = "\n".join([f"Imported from {path.name}.", *remarks])
    _write_bag(folder, swarm, comment, sized, places)
    return DropletImport(len(sized), known, fiducials, remarks)


def name_of(robot: int) -> str:
    """The name of a robot."""
    return f"{ROBOT_TYPE}_{robot:04x}"


def _describe(
    exchanges: Sequence[Exchange], poses: Sequence[dict[int, CameraPose]], source: str, platform: IrPlatform
) -> Swarm:
    """The swarm of all robots in exchanges or with poses, their starts unknown."""
    ids = {robot for where in poses for robot in where}
    ids |= {robot for one in exchanges for robot in (one.receiver, one.transmitter)}
    path = str(Path(source).resolve()) if source.endswith((".yaml", ".yml")) else source
    return Swarm(
        tuple(
            Robot(
                name_of(robot),
                ROBOT_TYPE,
                camera=None,
                stands=True,
                random_walk=WALK,
                ir=RobotIr(robot, platform, path),
            )
            for robot in sorted(ids)
        )
    )


def _write_bag(
    folder: Path,
    swarm: Swarm,
    comment: str,
    exchanges: Sequence[Exchange],
    places: Sequence[Mapping[int, Pose2]],
) -> None:
    """Write all messages and `swarm.yaml`; exchanges with equal stamps are spaced by a microsecond."""
    covariance = np.diag(np.square(FIX_SIGMA))
    with BagWriter(folder, compress=True) as bag:
        save_swarm(swarm, bag.folder / "swarm.yaml", comment)
        for robot in swarm.robots:
            for kind in (_BRIGHTNESS, _FIXES):
                bag.add_topic(f"{robot.name}/{kind.topic}", kind.message_type)
            bag.add_topic(f"{robot.name}/ground_truth", POSE_STAMPED)
        last_ns = 0
        for one, where in zip(exchanges, places, strict=True):
            stamp_ns = max(round(one.time_s * _NS), last_ns + 1000)
            last_ns = stamp_ns
            for robot_id, pose in where.items():
                (message,) = encode_pose_stamped("map", np.array([stamp_ns]), np.array([pose]))
                bag.write(f"{name_of(robot_id)}/ground_truth", stamp_ns, message)
                if robot_id == one.receiver:
                    fix = encode_fix("map", stamp_ns, pose, covariance)
                    bag.write(f"{name_of(robot_id)}/{_FIXES.topic}", stamp_ns, fix)
            receiver = name_of(one.receiver)
            matrix = encode_brightness(
                f"{receiver}/base_link", stamp_ns, (one.receiver, one.transmitter), one.readings
            )
            bag.write(f"{receiver}/{_BRIGHTNESS.topic}", stamp_ns, matrix)
