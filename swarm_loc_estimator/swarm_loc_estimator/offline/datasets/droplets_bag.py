"""Write a recording of Droplets as a bag with its swarm description.

The orientation of the fiducials on the robots is found from the brightness matrices.

The sums of a brightness matrix over sensors and emitters point to the other robot whatever the board's curves
are, eqs (5)-(10) of the Droplet paper. The mean of each robot gives the quarter turn of its fiducial, and all
together whether the image is mirrored. The mean while a robot stood at one place shows whether its fiducial
was misread there.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import POSE_STAMPED
from swarm_loc_estimator.common.messages.detections import encode_brightness
from swarm_loc_estimator.common.messages.poses import encode_fix, encode_pose_stamped
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.offline.datasets.droplets import (
    CameraPose,
    DropletRecordingError,
    Exchange,
    clean,
    read_exchanges,
)
from swarm_loc_estimator.sensors.registry import kinds
from swarm_loc_estimator.swarm.error_models import RandomWalk
from swarm_loc_estimator.swarm.ir_board import IrPlatform, RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.swarm import Pose2, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm

ROBOT_TYPE = "droplet"
DIAMETER_M = 0.044
METRES_PER_PIXEL = DIAMETER_M / 42.0  # Robots that touch are 42 pixels apart in the recordings of 2016
FIX_SIGMA = (0.001, 0.001, 0.05)  # Standard deviations of fixes by the camera: x, y [m], heading [rad]
WALK = RandomWalk(position=5e-6, heading=3e-2)  # The robots turn often and move some centimetres per minute
_NS = 1_000_000_000
_BRIGHTNESS, _FIXES = kinds()["brightness"], kinds()["fixes"]

_QUARTER = 0.5 * math.pi
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
    """Find the orientation of all fiducials.

    Args:
        exchanges: All of a recording.
        poses: One mapping per exchange: robot -> pose in the image.
        angles: (n,) directions of the elements in base_link [rad].

    Raises:
        DropletRecordingError: Matrices and camera contradict each other however the image is turned.
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

    Args:
        path: The recording, see `datasets.droplets`.
        folder: The bag to create.
        settings: Board and scale of the recording.
        progress: Called with the share done and what is being done.

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
    _write(folder, swarm, sized, places)
    known = sum(
        one.receiver in where and one.transmitter in where
        for one, where in zip(sized, truth.poses, strict=True)
    )
    remarks = tuple(f"{count} {what}." for what, count in _counted(dropped + truth.remarks))
    save_swarm(swarm, folder / "swarm.yaml", "\n".join([f"Imported from {path.name}.", *remarks]))
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


def _write(
    folder: Path, swarm: Swarm, exchanges: Sequence[Exchange], places: Sequence[Mapping[int, Pose2]]
) -> None:
    """Write all messages; exchanges with equal stamps are spaced by a microsecond."""
    covariance = np.diag(np.square(FIX_SIGMA))
    with BagWriter(folder, compress=True) as bag:
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


def _counted(counts: Counter[str]) -> list[tuple[str, int]]:
    """Reasons with their counts, without those of zero."""
    return sorted((what.replace("_", " "), count) for what, count in counts.items() if count)
