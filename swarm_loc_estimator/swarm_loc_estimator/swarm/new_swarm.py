"""New swarm descriptions from a few answers: robots of one known type, markers, landmarks along the walls.

Numbers of e-pucks, PushBots and Droplets are those of drivers and simulations; others name their source.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from types import MappingProxyType

from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.swarm.error_models import FixModel, ImuModel, LidarModel, OdometryModel, RandomWalk
from swarm_loc_estimator.swarm.ir_board import RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.swarm import (
    Anchor,
    CameraMount,
    Face,
    FixedCamera,
    Landmark,
    Localizer,
    Robot,
    Swarm,
    UwbDevice,
)

SENSORS = MappingProxyType(
    {
        "robots": "cameras on the robots, which see markers on other robots",
        "landmarks": "cameras on the robots, which see markers on the walls",
        "aerial": "a camera above, which cannot tell the robots apart",
        "fix": "poses from motion capture or another tracker, on <robot>/fix",
        "imu": "a gyroscope on each robot, on <robot>/imu",
        "infrared": "infrared boards",
        "lidar": "a lidar on each robot, on <robot>/scan",
        "map": "a map of map_server, in which lidars locate the robots",
        "uwb": "radios on the robots and at four corners, sensor_msgs/Range on a topic for each pair",
        "ceiling": "two cameras at the ceiling, which see a lying marker on each robot",
        "mocap": "motion capture, which localizer_bridge converts to <robot>/fix",
        "mapper": "poses from mapper_node by lasers and event cameras",
    }
)
"""What a swarm can be located by."""
_CAMERAS = ("robots", "landmarks", "aerial", "fix", "ceiling", "mocap")
_PENTAGON = MappingProxyType(
    {"front_left": 36.0, "left": 108.0, "back": 180.0, "right": -108.0, "front_right": -36.0}
)
_SQUARE = MappingProxyType({"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0})
"""Names and directions of markers [deg]."""


@dataclass(frozen=True)
class KnownRobot:
    """One type of robot."""

    title: str  # What people call it
    sensors: tuple[str, ...]  # Those of `SENSORS` that go with it
    odometry: OdometryModel | None = OdometryModel()  # Error model of its odometry; None: it has none
    camera: CameraMount = CameraMount()  # Usual place of a camera
    faces: tuple[Face, ...] = ()  # Usual markers on its body, with id 0
    imu: ImuModel = ImuModel()  # Error model of its gyroscope
    random_walk: RandomWalk = RandomWalk()  # Random walk without odometry
    lidar: LidarModel = LidarModel()  # Its lidar, as far as its transforms do not say
    lidar_frame: str = ""  # Frame of its scans; "": it has no lidar
    fix: FixModel = FixModel(position_sigma=0.002, heading_sigma=0.01)  # Of fixes without covariance
    # How motion capture is usually published for it; None: its driver publishes fixes
    localizer: Localizer | None = Localizer()
    tf_per_robot: bool = False  # Whether it publishes transforms on <robot>/tf, in frames without its name
    image: str = ""  # Namespace of its images below its own
    # Executable of swarm_loc_drivers and its arguments, of {robot} and {file}; "": others drive it
    driver: str = ""
    sources: str = ""  # Where the numbers come from, and which are guesses; sentences

    @property
    def usual_sensors(self) -> tuple[str, ...]:
        """Those that most have."""
        return self.sensors[: 2 if "landmarks" in self.sensors else 1]

    @property
    def marker_size(self) -> float:
        """Usual side of markers on its body [m]."""
        return self.faces[0].size if self.faces else 0.036


def _ring(places: Mapping[str, float], radius: float, height: float, size: float) -> tuple[Face, ...]:
    """Markers around a body, which look outwards."""
    faces = []
    for name, degrees in places.items():
        yaw = math.radians(degrees)
        x, y = round(radius * math.cos(yaw), 6), round(radius * math.sin(yaw), 6)
        faces.append(Face(name, 0, x, y, height, round(yaw, 6), size))
    return tuple(faces)


_DRIVEN = OdometryModel(distance_scale_sigma=0.05, turn_scale_sigma=0.05)
LIDAR = LidarModel(range_sigma=0.01)
GYROSCOPE = ImuModel(turn_noise_density=5e-4, turn_bias_sigma=0.01)
_MEMS = "imu: three times the noise density of an MPU-9250 (0.01 deg/s/Hz^0.5, data sheet PS-MPU-9250A)."
_EPUCK_DRIVER = "epuck_driver_node --ros-args -r __ns:=/{robot}"
_EPUCK_CAMERA = CameraMount(x=0.03, z=0.08)
_EPUCK_FACES = _ring(_PENTAGON, 0.033, 0.08, 0.036)
_EPUCK_SOURCES = (
    "odometry: epuck_driver_node. camera and faces: a turret with a camera over the body and five markers"
    " around it; the camera of the robot itself is lower."
)
DROPLET_ODOMETRY = OdometryModel(
    wheel_separation=0.044,
    wheel_noise=5e-5,
    distance_noise=5e-4,
    lateral_noise=5e-4,
    turn_noise=0.01,
    max_speed=0.05,
    max_turn_rate=0.3,
    speed_change=0.003,
    turn_rate_change=0.15,
)
"""Noise that covers the commanded motion of Droplets that err as in `D1` of their simulated world.

Their steps are 8 % too long or short and lead aside, in every direction differently: a stretch of 5 cm goes
4 mm and 0.03 rad wrong.
"""

KNOWN_ROBOTS = MappingProxyType(
    {
        "epuck": KnownRobot(
            "e-puck",
            _CAMERAS,
            camera=_EPUCK_CAMERA,
            faces=_EPUCK_FACES,
            driver=f"{_EPUCK_DRIVER} -p address:=/dev/rfcomm0 -p model:=epuck1",
            sources=_EPUCK_SOURCES,
        ),
        "epuck2": KnownRobot(
            "e-puck2",
            (*_CAMERAS, "imu"),
            camera=_EPUCK_CAMERA,
            faces=_EPUCK_FACES,
            imu=GYROSCOPE,
            driver=f"{_EPUCK_DRIVER} -p address:=tcp://192.168.1.1 -p model:=epuck2",
            sources=f"{_EPUCK_SOURCES} {_MEMS}",
        ),
        "pipuck": KnownRobot(
            "Pi-puck",
            (*_CAMERAS, "imu"),
            camera=_EPUCK_CAMERA,
            faces=_EPUCK_FACES,
            imu=GYROSCOPE,
            sources=f"wheels: those of the e-puck below the Pi-puck board. {_EPUCK_SOURCES} {_MEMS}",
        ),
        "pushbot": KnownRobot(
            "PushBot",
            ("mapper", "aerial", "fix"),
            OdometryModel(wheel_separation=0.085),
            driver="pushbot_driver_node --ros-args -r __ns:=/{robot} -p address:=tcp://192.168.1.11",
            sources="odometry: pushbot_driver_node.",
        ),
        "droplet": KnownRobot(
            "Droplet",
            ("infrared", "aerial", "fix"),
            DROPLET_ODOMETRY,
            driver="droplet_fleet_node --ros-args -p swarm_file:={file} -p link_folder:=/dev/droplets",
            sources="odometry: commanded motion with the errors of the simulated Droplets.",
        ),
        "turtlebot3": KnownRobot(
            "TurtleBot 3 Burger",
            (*_CAMERAS, "imu", "lidar", "map", "uwb"),
            replace(_DRIVEN, wheel_separation=0.160),
            CameraMount(x=0.05, z=0.1),
            _ring(_SQUARE, 0.09, 0.1, 0.08),
            GYROSCOPE,
            lidar=replace(LIDAR, range_sigma=0.02, max_range=3.5),
            lidar_frame="base_scan",
            tf_per_robot=True,
            sources=(
                "wheel_separation: burger.yaml of ROBOTIS-GIT/turtlebot3. camera and faces: guesses. lidar:"
                f" data sheet of the LDS-01. scales: as of real TurtleBot 4s. {_MEMS}"
            ),
        ),
        "turtlebot4": KnownRobot(
            "TurtleBot 4",
            (*_CAMERAS, "imu", "lidar", "map", "uwb"),
            replace(_DRIVEN, wheel_separation=0.233),
            CameraMount(x=-0.06, z=0.186),
            _ring(_SQUARE, 0.17, 0.1, 0.1),
            GYROSCOPE,
            lidar=LIDAR,
            lidar_frame="rplidar_link",
            tf_per_robot=True,
            image="oakd/rgb/preview/",
            sources=(
                "wheel_separation: Create 3 of iRobotEducation/create3_sim. camera: turtlebot4.urdf.xacro of"
                " turtlebot/turtlebot4. faces: guesses at the rim of the base. scales: real ones drove up to"
                f" a tenth less than they said (TIERS/uwb-cooperative-mrs-localization). {_MEMS}"
            ),
        ),
        "dotbot": KnownRobot(
            "DotBot",
            ("fix",),
            None,
            random_walk=RandomWalk(position=0.01, heading=1.0),
            fix=FixModel(position_sigma=0.01, heading_sigma=0.1),
            localizer=None,
            driver="dotbot_node --ros-args -p swarm_file:={file} -p url:=http://localhost:8000",
            sources="random_walk and fix: guesses for 10 cm/s and its Lighthouse.",
        ),
        "crazyflie": KnownRobot(
            "Crazyflie at one height",
            ("mocap", "fix"),
            None,
            random_walk=RandomWalk(position=0.25, heading=0.3),
            localizer=Localizer("named_poses"),
            sources="random_walk: a guess for 0.5 m/s. localizer: topic /poses of Crazyswarm2.",
        ),
        "kilobot": KnownRobot(
            "Kilobot below a tracker",
            ("fix",),
            None,
            random_walk=RandomWalk(position=1e-4, heading=0.6),
            sources=("random_walk: 1 cm/s and 45 deg/s, by Rubenstein and others: Kilobot, ICRA 2012."),
        ),
        "own": KnownRobot(
            "another robot with two driven wheels",
            (*_CAMERAS, "imu"),
            camera=CameraMount(x=0.05, z=0.1),
            faces=_ring(_SQUARE, 0.05, 0.1, 0.05),
            imu=GYROSCOPE,
            sources=f"All numbers but wheel_separation are guesses. {_MEMS}",
        ),
    }
)
"""Type of a swarm description -> robot."""


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
_TOP = Face("top", 0, yaw=0.0, lies=True)
_CEILING = (
    FixedCamera("ceiling1", -0.5, 0.0, 2.5, position_sigma=0.05, yaw_sigma=0.05),
    FixedCamera("ceiling2", 0.5, 0.0, 2.5, position_sigma=0.05, yaw_sigma=0.05),
)
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
    map: str = "map.yaml"  # File of map_server

    @property
    def known(self) -> KnownRobot:
        """The type of its robots."""
        return KNOWN_ROBOTS[self.type]


def planned_swarm(plan: SwarmPlan) -> Swarm:
    """The swarm of a plan; start poses are unknown, and landmarks stand at the height of the cameras.

    Raises PlanError if the family has too few ids.
    """
    known, sensors = plan.known, plan.sensors
    # places and ids of all markers
    places = list(_wall_places(plan)) if "landmarks" in sensors else []
    faces = known.faces if "robots" in sensors else ()
    if "ceiling" in sensors:
        faces = (*faces, replace(_TOP, z=known.camera.z))
    face_ids, landmark_ids = _ids(plan, len(faces), len(places))
    # what all robots have in common
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
        lidar=known.lidar if {"lidar", "map"} & set(sensors) else LidarModel(),
        imu=known.imu if "imu" in sensors else ImuModel(),
        fix=_MAPPED if "mapper" in sensors else known.fix if "fix" in sensors else FixModel(),
        uwb=UwbDevice(1) if "uwb" in sensors else None,
    )
    # the robots with their own ids, and the landmarks along the walls
    robots, ids = [], iter(face_ids)
    for k in range(plan.robots):
        own = tuple(replace(face, id=next(ids), size=size) for face in faces)
        ir = None if board is None else RobotIr(_FIRST_BOARD + k, board, "droplet")
        uwb = replace(common.uwb, address=k + 1) if common.uwb else None
        robots.append(replace(common, name=f"{plan.prefix}{k + 1}", faces=own, ir=ir, uwb=uwb))
    landmarks = tuple(
        Landmark(marker_id, *place, size=plan.landmark_size)
        for marker_id, place in zip(landmark_ids, places, strict=True)
    )
    x, y = (0.5 * length for length in plan.arena)
    corners = [(x, y), (-x, y), (-x, -y), (x, -y)] if "uwb" in sensors else []
    return Swarm(
        tuple(robots),
        landmarks,
        tuple(replace(one, x=one.x * x) for one in _CEILING) if "ceiling" in sensors else (),
        tuple(Anchor(plan.robots + k, *corner, z=2.0) for k, corner in enumerate(corners, 1)),
        Path(plan.map).absolute() if "map" in sensors else None,
        "uwb/n_{from}/n_{to}/distance" if "uwb" in sensors else "",
        localizer=known.localizer if "mocap" in sensors else None,
    )


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
