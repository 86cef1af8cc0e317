"""Swarm description: robots with their sensors and error models, and landmarks; units are SI and radians."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from swarm_loc_estimator.common.codec import EntrySpec, address, entry, entry_specs, matching, switch
from swarm_loc_estimator.common.parameters import choice, estimated, flag, gate, number, positive, text, texts
from swarm_loc_estimator.swarm import error_models as models
from swarm_loc_estimator.swarm.error_models import TURN

if TYPE_CHECKING:
    from swarm_loc_estimator.swarm.ir_board import RobotIr

_ADDRESS = address(2**64 - 1, "address in messages")
_WORD = r"[A-Za-z0-9_]{0,64}"
_SAID = {"pattern": f"^{_WORD}$", "description": "in range_topic, the address by default"}
_NAME = matching(_WORD, "up to 64 letters, digits and underscores", _SAID)
_SENSOR = EntrySpec(
    lambda checks, tree, key: models.SensorModel(**checks.values(tree, key, entry_specs(models.SensorModel))),
    {"$ref": "#/definitions/sensor"},
)


@dataclass(frozen=True)
class Radio:
    """What messages and topics call a radio."""

    #: Number by which messages name it, unique among robots and anchors
    address: int = field(metadata=entry(_ADDRESS))
    #: What `Swarm.range_topic` has for it; "": its address in decimal
    name: str = field(default="", kw_only=True, metadata=entry(_NAME))

    @property
    def word(self) -> str:
        """What a topic of two radios has for it."""
        return self.name or str(self.address)


@dataclass(frozen=True)
class UwbDevice(Radio):
    """Radio on a robot: its antenna in base_link, and the error model of what it measures.

    A measured range is range_scale times the true one, plus the range_bias of both devices.
    """

    x: float = number(0.0, "m", -10.0, 10.0, "antenna forward of base_link")
    y: float = number(0.0, "m", -10.0, 10.0, "antenna left of base_link")
    z: float = number(0.0, "m", -10.0, 10.0, "antenna above the ground")
    range_sigma: float = positive(0.1, "m", 10.0, "noise of a range without variance")
    difference_sigma: float = positive(0.15, "m", 10.0, "noise of a range difference without variance")
    range_bias: float = number(0.0, "m", -10.0, 10.0, "added to each range from or to this device")
    range_bias_sigma: float = estimated(0.2, "m", 10.0, "range_bias")
    range_scale: float = number(1.0, "1", 0.5, 2.0, "measured over true distance, of ranges that it measures")
    gate_probability: float = gate("ranges", 0.999)


class StaticBody:
    """A static body, whose place may be estimated."""

    @property
    def is_estimated(self) -> bool:
        """Whether its place, yaw or bias is estimated: any standard deviation is positive."""
        return any(value > 0.0 for name, value in vars(self).items() if name.endswith("_sigma"))


@dataclass(frozen=True)
class Anchor(Radio, StaticBody):
    """Radio at a fixed place in `map`."""

    x: float = number(0.0, "m", -1e8, 1e8, "in map")
    y: float = number(0.0, "m", -1e8, 1e8, "in map")
    z: float = number(0.0, "m", -1e4, 1e4, "above the ground")
    position_sigma: float = estimated(0.0, "m", 100.0, "x and y")
    range_bias: float = number(0.0, "m", -10.0, 10.0, "added to each range to this anchor")
    range_bias_sigma: float = estimated(0.2, "m", 10.0, "range_bias")

    @property
    def title(self) -> str:
        """What messages call it."""
        return f"anchor {self.address}"


Pose2 = tuple[float, float, float]  # x [m], y [m], heading [rad]


@dataclass(frozen=True)
class CameraMount:
    """Pose of the camera in base_link (x forward, y left, z up).

    The viewing direction is R = Rz(yaw) Ry(pitch) Rx(roll) times the x axis; positive pitch looks down.
    """

    x: float = number(0.0, "m", -10.0, 10.0, "forward of base_link")
    y: float = number(0.0, "m", -10.0, 10.0, "left of base_link")
    z: float = number(0.0, "m", -10.0, 10.0, "above base_link")
    yaw: float = number(0.0, "rad", -TURN, TURN, "turned to the left")
    yaw_sigma: float = estimated(0.0, "rad", 1.0, "yaw")
    yaw_time_s: float = number(0.0, "s", 0.0, 1e6, "time constant of yaw (Gauss-Markov); 0: constant")
    pitch: float = number(0.0, "rad", -TURN, TURN, "turned down")
    roll: float = number(0.0, "rad", -TURN, TURN, "turned about the optical axis")


@dataclass(frozen=True)
class Face:
    """A marker on a robot's body, in base_link."""

    name: str  #: Name of this side in the robot's type
    id: int  #: Marker id, unique in the swarm
    x: float = number(0.0, "m", -10.0, 10.0, "forward of base_link")  #: [m], forward
    y: float = number(0.0, "m", -10.0, 10.0, "left of base_link")  #: [m], left
    z: float = number(0.0, "m", -10.0, 10.0, "above base_link")  #: [m], up
    yaw: float | None = number(None, "rad", -TURN, TURN, "direction out of the face; null: shows no heading")
    size: float = number(0.036, "m", 0.001, 10.0, "side of the marker, black border included")
    position_sigma: float = number(0.0, "m", 0.0, 10.0, "standard deviation of x and y, added to sightings")
    #: Whether it lies flat and looks up; its yaw is then the direction of its x axis, to the right
    lies: bool = field(default=False, metadata=entry(switch("lies flat and looks up")))


@dataclass(frozen=True)
class Landmark(StaticBody):
    """A static marker in `map`."""

    id: int  #: Marker id, unique in the swarm
    x: float = number(0.0, "m", -1e8, 1e8, "in map")  #: [m]
    y: float = number(0.0, "m", -1e8, 1e8, "in map")  #: [m]
    z: float = number(0.0, "m", -1e4, 1e4, "in map")  #: [m]
    yaw: float | None = number(None, "rad", -TURN, TURN, "direction out of its face; null: shows no heading")
    size: float = number(0.05, "m", 0.001, 10.0, "side of the marker, black border included")
    position_sigma: float = estimated(0.0, "m", 100.0, "x and y")
    yaw_sigma: float = estimated(0.0, "rad", 10.0, "yaw")

    @property
    def title(self) -> str:
        """What messages call it."""
        return f"landmark {self.id}"


@dataclass(frozen=True)
class StartSigma:
    """Standard deviations of the start pose."""

    x: float = positive(0.01, "m", 1e3, "along map x")
    y: float = positive(0.01, "m", 1e3, "along map y")
    theta: float = positive(0.02, "rad", 10.0, "heading")


@dataclass(frozen=True)
class Robot:
    """One robot."""

    name: str  #: Namespace of its topics and prefix of its frames
    type: str = ""  #: Name of its type; "" if it has none
    odometry: models.OdometryModel = models.OdometryModel()  #: Error model of its odometry
    imu: models.ImuModel = models.ImuModel()  #: Error model of its IMU
    lidar: models.LidarModel = models.LidarModel()  #: Its lidar, for mapping and for localization in a map
    response: models.MotionResponse | None = None  #: True share of the reported motion; None: all of it
    camera: CameraMount | None = CameraMount()  #: Pose of its camera; None if it has none
    sensor: models.SensorModel = models.SensorModel()  #: Error model of its sightings
    faces: tuple[Face, ...] = ()  #: Markers on its body
    start: Pose2 | None = None  #: Start pose in `map`; None: unknown, to be initialized by sightings or fixes
    start_sigma: StartSigma = StartSigma()  #: Standard deviations of the start pose
    stands: bool = False  #: True if it has no odometry; it moves only by `random_walk`
    random_walk: models.RandomWalk = models.RandomWalk()  #: Random walk without odometry
    fix: models.FixModel = models.FixModel()  #: Error model of its absolute fixes
    clock: models.ClockModel = models.ClockModel()  #: Its clock
    ir: RobotIr | None = None  #: Infrared board; None if it has none
    uwb: UwbDevice | None = None  #: UWB radio; None if it has none
    #: Numbers that its file says, such as "lidar.yaw"; others may come from transforms
    said: frozenset[str] = field(default=frozenset(), compare=False, repr=False)

    @property
    def turn_sensor(self) -> models.OdometryModel | models.ImuModel:
        """The error model with the scale and bias of its turns that are estimated."""
        return self.imu if self.imu.is_used else self.odometry

    @property
    def estimates_motion(self) -> bool:
        """Whether any parameter of its motion is estimated from the start."""
        turns = self.turn_sensor
        return max(self.odometry.distance_scale_sigma, turns.turn_scale_sigma, turns.turn_bias_sigma) > 0.0


@dataclass(frozen=True)
class FixedCamera(StaticBody):
    """A camera with a fixed pose in `map`, such as at the ceiling; its angles are those of `CameraMount`."""

    name: str
    x: float = number(0.0, "m", -1e8, 1e8, "in map")
    y: float = number(0.0, "m", -1e8, 1e8, "in map")
    z: float = number(0.0, "m", -1e4, 1e4, "above the floor")
    yaw: float = number(0.0, "rad", -TURN, TURN, "turned to the left")
    pitch: float = number(math.pi / 2, "rad", -TURN, TURN, "turned down; by default straight down")
    roll: float = number(0.0, "rad", -TURN, TURN, "turned about the optical axis")
    position_sigma: float = positive(0.001, "m", 10.0, "standard deviation of x and y, always estimated")
    yaw_sigma: float = positive(0.002, "rad", 1.0, "standard deviation of yaw, always estimated")
    sensor: models.SensorModel = field(default=models.SensorModel(), metadata=entry(_SENSOR))

    @property
    def title(self) -> str:
        """What messages call it."""
        return self.name


Surveyed = Landmark | Anchor | FixedCamera  # A static body whose place may be estimated


@dataclass(frozen=True)
class MapError:
    """Error that all places with a standard deviation share."""

    x: float = number(0.0, "m", -1e8, 1e8, "in map: the point about which they are turned and stretched")
    y: float = number(0.0, "m", -1e8, 1e8, "in map")
    position_sigma: float = number(0.0, "m", 0.0, 100.0, "standard deviation of x and y of all of them")
    yaw_sigma: float = number(0.0, "rad", 0.0, 10.0, "standard deviation of their turn")
    scale_sigma: float = number(0.0, "1", 0.0, 1.0, "standard deviation of their scale")


NO_MAP_ERROR = MapError()


@dataclass(frozen=True)
class MarkerOwner:
    """Owner of a marker id."""

    robot_index: int  #: Index into `Swarm.robots`; -1 for a landmark
    landmark_index: int  #: Index into `Swarm.landmarks`; -1 for a robot's face
    marker: Face | Landmark  #: The face (in base_link) or the landmark (in map)


LOCALIZERS = ("pose", "pose_with_covariance", "odometry", "tf", "named_poses", "rigid_bodies")
"""Kinds of messages of localizers, see `sensors/localizers.py`."""
BODY = "<body>"  # Stands for the name of a body in a topic
BODY_TOPIC = f"/vrpn_mocap/{BODY}/pose"  # Default of the source `pose`


@dataclass(frozen=True)
class Localizer:
    """Motion capture, AMCL or another localizer, and which of its bodies are robots."""

    source: str = choice("pose", LOCALIZERS, "kind of messages, see the table of sources")
    topic: str = text("", "topic, with <body> for the body's name; empty: that of the table of sources")
    output: str = choice("fix", ("fix", "ground_truth"), "<robot>/fix, or <robot>/ground_truth to evaluate")
    bodies: tuple[str, ...] = texts(
        "tracked bodies, such as cf1=epuck1, or epuck2 of the robot's name; empty: one of each robot's name"
    )
    offsets: tuple[str, ...] = texts(
        "poses of bodies in base_link, such as epuck1=0.01,0,1.5708 [m, m, rad]; others are at base_link"
    )
    source_frame: str = text("", "frame that the poses must be in; empty: map_frame or world")
    map_frame: str = text("map", "frame of the published poses", required=True)
    latency_s: float = number(0.0, "s", 0.0, 2.0, "time from exposure to stamp, subtracted from the stamp")
    stamp_on_arrival: bool = flag(False, "stamp by arrival, for a source with another clock or none")
    position_sigma: float = positive(0.001, "m", 10.0, "noise of x and of y, for poses without covariance")
    heading_sigma: float = positive(0.005, "rad", 3.0, "noise of the heading, for poses without covariance")
    max_tilt: float = number(0.35, "rad", 0.0, 3.1416, "largest angle between z axes of body and frame")


class SwarmError(ValueError):
    """An inconsistent swarm."""


MAP_BY_TOPIC: Final = "topic"  # `Swarm.map` of a swarm whose map comes on the topic `map`


@dataclass(frozen=True)
class Swarm:
    """All robots, landmarks, fixed cameras and UWB anchors, and the map of walls that lidars see.

    Raises:
        SwarmError: A name, a marker id, the id of an infrared board or the address of a radio appears twice,
            or a robot with odometry has a random walk or one without has an IMU.
    """

    robots: tuple[Robot, ...] = ()
    landmarks: tuple[Landmark, ...] = ()
    cameras: tuple[FixedCamera, ...] = ()
    anchors: tuple[Anchor, ...] = ()
    map: Path | Literal["topic"] | None = None  #: File of the map of walls, or `MAP_BY_TOPIC`; None: no map
    #: Topic of the `sensor_msgs/Range` of two radios, in which {from} and {to} stand for their names; "":
    #: ranges come on `<robot>/ranges`
    range_topic: str = ""
    #: Expected topic, such as `robot1/odom` or `<robot>/odom` for all robots -> the topic in its place
    topics: Mapping[str, str] = field(default_factory=dict)
    localizer: Localizer | None = None  #: What tells the poses of robots from outside; None: nothing
    map_error: MapError = NO_MAP_ERROR  #: Error that places share
    origin: tuple[float, float] = (0.0, 0.0)  #: Of all places in the frame of `map` and its file [m]

    def __post_init__(self) -> None:
        names = Counter(one.name.lower() for one in self.sources)
        if twice := [name for name, count in names.items() if count > 1]:
            what = "two robots or cameras, which must differ by more than capitals"
            raise SwarmError(f"name '{twice[0]}' is given to {what}.")
        faces = [(f"face '{f.name}' of robot '{r.name}'", f.id) for r in self.robots for f in r.faces]
        marks = [(mark.title, mark.id) for mark in self.landmarks]
        boards = [(f"robot '{r.name}'", r.ir.id) for r in self.robots if r.ir is not None]
        radios = [(f"robot '{r.name}'", r.uwb.address) for r in self.robots if r.uwb is not None]
        radios += [(f"anchors[{k}]", anchor.address) for k, anchor in enumerate(self.anchors)]
        devices = [*(r.uwb for r in self.robots if r.uwb is not None), *self.anchors]
        words = [(owner, one.word) for (owner, _), one in zip(radios, devices, strict=True)]
        unique: tuple[tuple[str, Sequence[tuple[str, int | str]]], ...]
        unique = ("marker id", faces + marks), ("ir.id", boards), ("uwb.address", radios), ("uwb.name", words)
        for what, named in unique:
            owners: dict[int | str, str] = {}
            for owner, key in named:
                first = owners.setdefault(key, owner)
                if first is not owner:
                    raise SwarmError(f"{what} {key} belongs to both {first} and {owner}; ids must be unique.")
        if walking := [r.name for r in self.robots if r.random_walk.moves and not r.stands]:
            rule = "which must be 0 where odometry is not null"
            raise SwarmError(f"robot '{walking[0]}' has a random_walk, {rule}.")
        if turned := [r.name for r in self.robots if r.imu.is_used and r.stands]:
            raise SwarmError(f"robot '{turned[0]}' has no odometry, so its imu.turn_noise_density must be 0.")

    @property
    def sources(self) -> tuple[Robot | FixedCamera, ...]:
        """All that have input topics, as these count them: robots, then fixed cameras."""
        return (*self.robots, *self.cameras)

    def topic(self, source: str, topic: str) -> str:
        """The topic in place of one of a robot or fixed camera, such as that of epuck1 in place of odom."""
        named = self.topics.get(f"{source}/{topic}", self.topics.get(f"<robot>/{topic}", f"<robot>/{topic}"))
        return named.replace("<robot>", source).lstrip("/")

    @cached_property
    def index_of(self) -> Mapping[str, int]:
        """Robot index by name."""
        return {robot.name: index for index, robot in enumerate(self.robots)}

    @cached_property
    def surveyed(self) -> tuple[Surveyed, ...]:
        """Static bodies whose places may be estimated."""
        return (*self.landmarks, *self.anchors, *self.cameras)

    @cached_property
    def owner_of(self) -> Mapping[int, MarkerOwner]:
        """Owner by marker id."""
        faces = {f.id: MarkerOwner(k, -1, f) for k, robot in enumerate(self.robots) for f in robot.faces}
        return faces | {mark.id: MarkerOwner(-1, k, mark) for k, mark in enumerate(self.landmarks)}
