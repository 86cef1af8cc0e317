"""New swarm descriptions from a few answers: robots of one type, markers, landmarks along the walls."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from types import MappingProxyType

from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.swarm.board_file import load_ir_platform
from swarm_loc_estimator.swarm.error_models import FixModel, ImuModel, OdometryModel
from swarm_loc_estimator.swarm.ir_board import RobotIr
from swarm_loc_estimator.swarm.robot_types import KNOWN_ROBOTS, KnownRobot
from swarm_loc_estimator.swarm.swarm import Face, Landmark, Robot, Swarm

FAMILY_IDS = MappingProxyType(
    {
        "artoolkit_bch_thin": 4096,
        "artoolkit_bch_thick": 4096,
        "aruco_mip_36h12": 250,
        "apriltag_36h11": 587,
        "apriltag_36h11_thick": 587,
        "apriltag_16h5": 30,
        "apriltag_25h9": 35,
        "apriltag_standard_41h12": 2115,
        **{f"aruco_{n}x{n}_{count}": count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    }
)
"""Families of markers that the detector has -> number of their ids."""
_FIRST_BOARD = 0x1001
_TRACKED = FixModel(position_sigma=0.002, heading_sigma=0.01)
_MAPPED = FixModel(systematic_share=1.0)


class PlanError(UserError):
    """A swarm that cannot be described."""


@dataclass(frozen=True)
class SwarmPlan:
    """What a new description is to hold; lengths are in m."""

    type: str  # Of `KNOWN_ROBOTS`
    robots: int  # How many
    prefix: str  # Names are this and a number from 1 on
    sensors: tuple[str, ...]  # Of the sensors of the type
    wheel_separation: float | None = None  # Distance of the wheels; None: that of the type
    family: str = "artoolkit_bch_thin"  # Kind of the markers
    size: float | None = None  # Side of the markers on robots; None: that of the type
    arena: tuple[float, float] = (2.4, 1.6)  # Length along x and along y; the middle is the origin of map
    pitch: float = 0.4  # Distance of the landmarks along the walls
    landmark_size: float = 0.05  # Side of the landmarks

    @property
    def known(self) -> KnownRobot:
        """The type of its robots."""
        return KNOWN_ROBOTS[self.type]


def planned_swarm(plan: SwarmPlan) -> Swarm:
    """The swarm of a plan; start poses are unknown, and landmarks stand at the height of the cameras.

    Raises:
        PlanError: The family has too few ids.
    """
    known, sensors = plan.known, plan.sensors
    places = list(_wall_places(plan)) if "landmarks" in sensors else []
    faces = known.faces if "robots" in sensors else ()
    face_ids, landmark_ids = _ids(plan, len(faces), len(places))
    board = load_ir_platform("droplet") if "infrared" in known.sensors else None
    odometry, size = known.odometry, plan.size or known.marker_size
    if odometry is not None and plan.wheel_separation is not None:
        odometry = replace(odometry, wheel_separation=plan.wheel_separation)
    common = Robot(
        "",
        plan.type,
        odometry=odometry or OdometryModel(),
        stands=odometry is None,
        random_walk=known.random_walk,
        camera=known.camera if {"robots", "landmarks"} & set(sensors) else None,
        imu=known.imu if "imu" in sensors else ImuModel(),
        fix=_MAPPED if "mapper" in sensors else _TRACKED if "fix" in sensors else FixModel(),
    )
    robots = tuple(
        replace(
            common,
            name=f"{plan.prefix}{k + 1}",
            faces=_numbered(faces, face_ids[k * len(faces) :], size),
            ir=None if board is None else RobotIr(_FIRST_BOARD + k, board, "droplet"),
        )
        for k in range(plan.robots)
    )
    landmarks = tuple(
        Landmark(marker_id, *place, size=plan.landmark_size)
        for marker_id, place in zip(landmark_ids, places, strict=True)
    )
    return Swarm(robots, landmarks)


def _numbered(faces: tuple[Face, ...], ids: list[int], size: float) -> tuple[Face, ...]:
    """Faces with the first of some ids."""
    return tuple(replace(face, id=marker_id, size=size) for face, marker_id in zip(faces, ids, strict=False))


def _ids(plan: SwarmPlan, faces: int, landmarks: int) -> tuple[list[int], list[int]]:
    """Ids of all faces, robot by robot, and of the landmarks, which are larger.

    Each robot has a decade of its own and landmarks begin at a hundred, where the family has enough ids.
    """
    decade = 10 * math.ceil(faces / 10)
    for first, step, round_to in ((decade, decade, 100), (0, faces, 10), (0, faces, 1)):
        of_faces = [first + step * robot + face for robot in range(plan.robots) for face in range(faces)]
        begin = round_to * math.ceil((max(of_faces, default=0) + 1) / round_to) if landmarks else 0
        if max([begin + landmarks - 1, *of_faces[-1:]]) < FAMILY_IDS[plan.family]:
            return of_faces, [begin + k for k in range(landmarks)]
    raise PlanError(
        f"The swarm needs {faces * plan.robots + landmarks} markers, but {plan.family} has"
        f" {FAMILY_IDS[plan.family]} ids: take another family, fewer robots or a larger pitch of landmarks."
    )


def _wall_places(plan: SwarmPlan) -> Iterator[tuple[float, float, float, float]]:
    """x, y, z, yaw of the landmarks, counter-clockwise from the left of the lower wall, facing inwards."""
    length, width = plan.arena
    walls = (
        [(x, -0.5 * width, 0.5 * math.pi) for x in _along(length, plan.pitch)],
        [(0.5 * length, y, math.pi) for y in _along(width, plan.pitch)],
        [(-x, 0.5 * width, -0.5 * math.pi) for x in _along(length, plan.pitch)],
        [(-0.5 * length, -y, 0.0) for y in _along(width, plan.pitch)],
    )
    for x, y, yaw in chain(*walls):
        yield round(x, 6), round(y, 6), plan.known.camera.z, round(yaw, 6)


def _along(length: float, pitch: float) -> list[float]:
    """Places of landmarks along a wall, in its middle; one at least."""
    count = max(1, math.floor(length / pitch + 1e-9))
    return [(k - 0.5 * (count - 1)) * pitch for k in range(count)]
