"""Write a recording of Droplets as a bag with its swarm description.

How fiducials sit on robots is found from what the robots read of each other.

The sums of a brightness matrix over sensors and emitters point to the other robot whatever the board's curves
are, eqs (5)-(10) of the Droplet paper. Each robot's median tells the quarter turn by which its fiducial sits,
and all together whether the image is mirrored.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.encoders import encode_brightness, encode_fix, encode_pose_stamped
from swarm_loc_estimator.common.messages.typestore import POSE_STAMPED
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.offline.datasets.droplets import (
    CameraPose,
    DropletRecordingError,
    Exchange,
    clean,
    read_exchanges,
)
from swarm_loc_estimator.sensors.topics import InputKind
from swarm_loc_estimator.swarm.board_file import load_ir_platform
from swarm_loc_estimator.swarm.ir_board import IrPlatform
from swarm_loc_estimator.swarm.robot_ir import RobotIr
from swarm_loc_estimator.swarm.swarm import RandomWalk, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_writer import save_swarm

_QUARTER = 0.5 * math.pi
_CLEAR = 8.0
"""Matrices whose brightest reading is not above the noise by so much are not asked [sigma]."""
_ONE_WAY = 0.5
"""Directions whose mean vector is shorter contradict each other."""


@dataclass(frozen=True)
class Fiducials:
    """How all fiducials sit.

    Attributes:
        handedness: 1 where the image's x and y are those of map, -1 where y points the other way.
        turn_of: Robot -> from its fiducial's orientation to its own [rad], a multiple of a quarter turn.
        told: By how many exchanges each robot's was told.
    """

    handedness: int
    turn_of: Mapping[int, float]
    told: Mapping[int, int]

    def pose(self, robot: int, seen: CameraPose, metres_per_pixel: float) -> tuple[float, float, float]:
        """The robot's pose x, y [m], heading [rad] in map."""
        turned = self.handedness * seen.orientation + self.turn_of[robot]
        x, y = metres_per_pixel * seen.x, self.handedness * metres_per_pixel * seen.y
        return x, y, float(wrap_angle(turned))


def find_fiducials(
    exchanges: Sequence[Exchange], poses: Sequence[Mapping[int, CameraPose]], angles: FloatArray
) -> Fiducials:
    """Find how fiducials sit.

    Args:
        exchanges: All.
        poses: One per exchange: where robots stood.
        angles: (n,) directions of the elements in base_link [rad].

    Raises:
        DropletRecordingError: Matrices and camera contradict each other however the image is turned.
    """
    floor = _CLEAR * _noise(exchanges)
    rows = [
        (one, where)
        for one, where in zip(exchanges, poses, strict=True)
        if one.receiver in where and one.transmitter in where and one.readings.max() > floor
    ]
    best, told = max(((_turns(rows, angles, sign), sign) for sign in (1, -1)), key=lambda pair: pair[0][0])
    share, turns, counts = best
    if share < _ONE_WAY:
        raise DropletRecordingError(
            f"what robots read and what the camera saw contradict each other: directions agree to {share:.2f}"
            f" of 1 in {len(rows)} exchanges, at least {_ONE_WAY} is needed."
        )
    usual = float(np.median(list(turns.values())))
    everybody = {robot for where in poses for robot in where}
    return Fiducials(told, {robot: turns.get(robot, usual) for robot in everybody}, counts)


def _turns(
    rows: Sequence[tuple[Exchange, Mapping[int, CameraPose]]], angles: FloatArray, sign: int
) -> tuple[float, dict[int, float], dict[int, int]]:
    """How well directions agree, the turn of each robot that took part, and how often it did."""
    said: dict[int, list[complex]] = {}
    units = np.exp(1j * angles)
    for one, where in rows:
        light = np.clip(one.readings, 0.0, None)
        bearing = np.angle(units @ light.sum(axis=1))
        heading = np.angle(-(units @ light @ units.conj()))
        receiver, transmitter = where[one.receiver], where[one.transmitter]
        along = math.atan2(sign * (transmitter.y - receiver.y), transmitter.x - receiver.x)
        forward = along - bearing
        said.setdefault(one.receiver, []).append(np.exp(1j * (forward - sign * receiver.orientation)))
        turned = forward + heading - sign * transmitter.orientation
        said.setdefault(one.transmitter, []).append(np.exp(1j * turned))
    sums = {robot: sum(values) for robot, values in said.items()}
    turns = {robot: _QUARTER * round(np.angle(total) / _QUARTER) for robot, total in sums.items()}
    share = sum(abs(total) for total in sums.values()) / max(sum(map(len, said.values())), 1)
    return share, turns, {robot: len(values) for robot, values in said.items()}


def _noise(exchanges: Sequence[Exchange]) -> float:
    """Robust scatter of what sensors read, most of which is no light [count]."""
    values = np.concatenate([one.readings.ravel() for one in exchanges])
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1.0)


ROBOT_TYPE = "droplet"
DIAMETER_M = 0.044
"""Of a Droplet."""
METRES_PER_PIXEL = DIAMETER_M / 42.0
"""Robots that touch are 42 pixels apart in the recordings of 2016."""
FIX_SIGMA = (0.001, 0.001, 0.05)
"""How well the camera knows the receiver: x, y [m], heading [rad]."""
WALK = RandomWalk(position=5e-6, heading=3e-2)
"""They turn often and go some centimetres a minute."""
_NS = 1_000_000_000


@dataclass(frozen=True)
class ImportSettings:
    """What the files do not say.

    Attributes:
        platform: Packaged name or path of the board of all robots.
        metres_per_pixel: Of the camera's image.
    """

    platform: str = "droplet_2016"
    metres_per_pixel: float = METRES_PER_PIXEL


@dataclass(frozen=True)
class DropletImport:
    """What was written.

    Attributes:
        exchanges: How many.
        with_truth: In how many of them both robots' poses are known.
        fiducials: How they sit.
        remarks: What was put right and what was dropped, one sentence each.
    """

    exchanges: int
    with_truth: int
    fiducials: Fiducials
    remarks: tuple[str, ...]


def import_recording(
    path: Path, folder: Path, settings: ImportSettings, progress: Callable[[float, str], None]
) -> DropletImport:
    """Write a recording as a bag with its `swarm.yaml` inside.

    The bag holds <robot>/brightness, <robot>/ground_truth at each exchange, and <robot>/fix of the receivers.

    Args:
        path: The recording, see `text`.
        folder: The bag to create.
        settings: What it does not say.
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
    swarm = _describe(sized, truth.poses, settings.platform, platform)
    progress(0.6, "writing")
    _write(folder, sized, truth.poses, _Scene(swarm, fiducials, settings.metres_per_pixel))
    known = sum(
        one.receiver in where and one.transmitter in where
        for one, where in zip(sized, truth.poses, strict=True)
    )
    remarks = tuple(f"{count} {what}." for what, count in _counted(dropped + truth.remarks))
    save_swarm(swarm, folder / "swarm.yaml", "\n".join([f"Imported from {path.name}.", *remarks]))
    return DropletImport(len(sized), known, fiducials, remarks)


@dataclass(frozen=True)
class _Scene:
    """What turns exchanges into messages."""

    swarm: Swarm
    fiducials: Fiducials
    metres_per_pixel: float

    def pose(self, robot: int, seen: CameraPose) -> FloatArray:
        """The pose (1, 3) of a robot in map."""
        return np.array([self.fiducials.pose(robot, seen, self.metres_per_pixel)])


def name_of(robot: int) -> str:
    """What a robot is called."""
    return f"{ROBOT_TYPE}_{robot:04x}"


def _describe(
    exchanges: Sequence[Exchange],
    poses: Sequence[dict[int, CameraPose]],
    source: str,
    platform: IrPlatform,
) -> Swarm:
    """The swarm: all robots that exchanged light or were seen standing; their starts are not known."""
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
    folder: Path, exchanges: Sequence[Exchange], poses: Sequence[dict[int, CameraPose]], scene: _Scene
) -> None:
    """Write all messages; exchanges of one stamp follow each other by a microsecond."""
    covariance = np.diag(np.square(FIX_SIGMA))
    with BagWriter(folder, compress=True) as bag:
        for robot in scene.swarm.robots:
            for kind in (InputKind.BRIGHTNESS, InputKind.FIXES):
                bag.add_topic(f"{robot.name}/{kind.topic}", kind.message_type)
            bag.add_topic(f"{robot.name}/ground_truth", POSE_STAMPED)
        last_ns = 0
        for one, where in zip(exchanges, poses, strict=True):
            stamp_ns = max(round(one.time_s * _NS), last_ns + 1000)
            last_ns = stamp_ns
            for robot_id, seen in where.items():
                pose = scene.pose(robot_id, seen)
                (message,) = encode_pose_stamped("map", np.array([stamp_ns]), pose)
                bag.write(f"{name_of(robot_id)}/ground_truth", stamp_ns, message)
                if robot_id == one.receiver:
                    fix = encode_fix("map", stamp_ns, pose[0], covariance)
                    bag.write(f"{name_of(robot_id)}/{InputKind.FIXES.topic}", stamp_ns, fix)
            receiver = name_of(one.receiver)
            matrix = encode_brightness(
                f"{receiver}/base_link", stamp_ns, (one.receiver, one.transmitter), one.readings
            )
            bag.write(f"{receiver}/{InputKind.BRIGHTNESS.topic}", stamp_ns, matrix)


def _counted(counts: Counter[str]) -> list[tuple[str, int]]:
    """Reasons with their counts, none of zero."""
    return sorted((what.replace("_", " "), count) for what, count in counts.items() if count)
