"""Robots that a new swarm description can begin with: wheels, cameras, markers on the body, gyroscopes.

Numbers of e-pucks, PushBots and Droplets are those of drivers and simulations; others name their source.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from swarm_loc_estimator.swarm.error_models import ImuModel, OdometryModel, RandomWalk
from swarm_loc_estimator.swarm.swarm import CameraMount, Face

SENSORS = MappingProxyType(
    {
        "robots": "cameras on the robots, which see markers on other robots",
        "landmarks": "cameras on the robots, which see markers on the walls",
        "aerial": "a camera above, which cannot tell the robots apart",
        "fix": "poses from motion capture or another tracker, on <robot>/fix",
        "imu": "a gyroscope on each robot, on <robot>/imu",
        "infrared": "infrared boards",
        "mapper": "poses from mapper_node by lasers and event cameras",
    }
)
"""What a swarm can be located by."""
_CAMERAS = ("robots", "landmarks", "aerial", "fix")
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
    return tuple(
        Face(
            name,
            0,
            round(radius * math.cos(yaw), 6),
            round(radius * math.sin(yaw), 6),
            height,
            round(yaw, 6),
            size,
        )
        for name, degrees in places.items()
        for yaw in [math.radians(degrees)]
    )


_GYROSCOPE = ImuModel(turn_noise_density=5e-4, turn_bias_sigma=0.01)
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
            imu=_GYROSCOPE,
            driver=f"{_EPUCK_DRIVER} -p address:=tcp://192.168.1.1 -p model:=epuck2",
            sources=f"{_EPUCK_SOURCES} {_MEMS}",
        ),
        "pipuck": KnownRobot(
            "Pi-puck",
            (*_CAMERAS, "imu"),
            camera=_EPUCK_CAMERA,
            faces=_EPUCK_FACES,
            imu=_GYROSCOPE,
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
            (*_CAMERAS, "imu"),
            OdometryModel(wheel_separation=0.160),
            CameraMount(x=0.05, z=0.1),
            _ring(_SQUARE, 0.09, 0.1, 0.08),
            _GYROSCOPE,
            sources=(
                f"wheel_separation: burger.yaml of ROBOTIS-GIT/turtlebot3. camera and faces: guesses. {_MEMS}"
            ),
        ),
        "turtlebot4": KnownRobot(
            "TurtleBot 4",
            (*_CAMERAS, "imu"),
            OdometryModel(wheel_separation=0.233),
            CameraMount(x=-0.06, z=0.186),
            _ring(_SQUARE, 0.17, 0.1, 0.1),
            _GYROSCOPE,
            image="oakd/rgb/preview/",
            sources=(
                "wheel_separation: Create 3 of iRobotEducation/create3_sim. camera: turtlebot4.urdf.xacro of"
                f" turtlebot/turtlebot4. faces: guesses at the rim of the base. {_MEMS}"
            ),
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
            imu=_GYROSCOPE,
            sources=f"All numbers but wheel_separation are guesses. {_MEMS}",
        ),
    }
)
"""Type of a swarm description -> robot."""
