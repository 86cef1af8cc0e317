"""The types of ROS messages that the workspace uses, as fields read from `.msg` definitions.

The standard types stand here as text, this workspace's own are read from the `.msg` files of
`swarm_loc_msgs`, each when it is first used. To load the definitions of all ROS packages with `rosbags`
would cost a node 0.16 s at start.
"""

from __future__ import annotations

import os
import re
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from swarm_loc_estimator.common.parameters import UserError

MESSAGE_PACKAGE = "swarm_loc_msgs"

ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM_STAMPED = "geometry_msgs/msg/TransformStamped"
MARKERS = "visualization_msgs/msg/MarkerArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
ANONYMOUS_DETECTION = f"{MESSAGE_PACKAGE}/msg/AnonymousDetection"
DETECTIONS = f"{MESSAGE_PACKAGE}/msg/MarkerDetectionArray"
DETECTION = f"{MESSAGE_PACKAGE}/msg/MarkerDetection"
BRIGHTNESS = f"{MESSAGE_PACKAGE}/msg/BrightnessMatrix"
ANONYMOUS_DETECTIONS = f"{MESSAGE_PACKAGE}/msg/AnonymousDetectionArray"
ROBOT_IDENTITIES = f"{MESSAGE_PACKAGE}/msg/RobotIdentities"
SWARM_ODOMETRY = f"{MESSAGE_PACKAGE}/msg/SwarmOdometry"
SWARM_DETECTIONS = f"{MESSAGE_PACKAGE}/msg/SwarmDetections"
SWARM_FIXES = f"{MESSAGE_PACKAGE}/msg/SwarmFixes"
SWARM_POSES = f"{MESSAGE_PACKAGE}/msg/SwarmPoses"
SWARM_SIGHTINGS = f"{MESSAGE_PACKAGE}/msg/SwarmSightings"
RANGES = f"{MESSAGE_PACKAGE}/msg/RangeArray"
LASER = f"{MESSAGE_PACKAGE}/msg/LaserDistance"
LIGHTS = f"{MESSAGE_PACKAGE}/msg/LightBearingArray"
EVENT_PACKETS = ("event_camera_msgs/msg/EventPacket", f"{MESSAGE_PACKAGE}/msg/EventPacket")
"""The type of events and our copy of it, with the same fields: nodes use the first one that is installed."""

STANDARD = """
builtin_interfaces/Time: int32 sec, uint32 nanosec
builtin_interfaces/Duration: int32 sec, uint32 nanosec
std_msgs/Header: builtin_interfaces/Time stamp, string frame_id
std_msgs/ColorRGBA: float32 r, float32 g, float32 b, float32 a
geometry_msgs/Point: float64 x, float64 y, float64 z
geometry_msgs/Vector3: float64 x, float64 y, float64 z
geometry_msgs/Quaternion: float64 x, float64 y, float64 z, float64 w
geometry_msgs/Pose: Point position, Quaternion orientation
geometry_msgs/PoseStamped: Header header, Pose pose
geometry_msgs/PoseWithCovariance: Pose pose, float64[36] covariance
geometry_msgs/PoseWithCovarianceStamped: Header header, PoseWithCovariance pose
geometry_msgs/Transform: Vector3 translation, Quaternion rotation
geometry_msgs/TransformStamped: Header header, string child_frame_id, Transform transform
geometry_msgs/Twist: Vector3 linear, Vector3 angular
geometry_msgs/TwistWithCovariance: Twist twist, float64[36] covariance
nav_msgs/MapMetaData: builtin_interfaces/Time map_load_time, float32 resolution, uint32 width,
    uint32 height, geometry_msgs/Pose origin
nav_msgs/OccupancyGrid: Header header, MapMetaData info, int8[] data
nav_msgs/Odometry: Header header, string child_frame_id, geometry_msgs/PoseWithCovariance pose,
    geometry_msgs/TwistWithCovariance twist
sensor_msgs/CompressedImage: Header header, string format, uint8[] data
sensor_msgs/Image: Header header, uint32 height, uint32 width, string encoding, uint8 is_bigendian,
    uint32 step, uint8[] data
sensor_msgs/Imu: Header header, geometry_msgs/Quaternion orientation, float64[9] orientation_covariance,
    geometry_msgs/Vector3 angular_velocity, float64[9] angular_velocity_covariance,
    geometry_msgs/Vector3 linear_acceleration, float64[9] linear_acceleration_covariance
sensor_msgs/LaserScan: Header header, float32 angle_min, float32 angle_max, float32 angle_increment,
    float32 time_increment, float32 scan_time, float32 range_min, float32 range_max, float32[] ranges,
    float32[] intensities
sensor_msgs/RegionOfInterest: uint32 x_offset, uint32 y_offset, uint32 height, uint32 width, bool do_rectify
sensor_msgs/CameraInfo: Header header, uint32 height, uint32 width, string distortion_model, float64[] d,
    float64[9] k, float64[9] r, float64[12] p, uint32 binning_x, uint32 binning_y, RegionOfInterest roi
tf2_msgs/TFMessage: geometry_msgs/TransformStamped[] transforms
visualization_msgs/MeshFile: string filename, uint8[] data
visualization_msgs/UVCoordinate: float32 u, float32 v
visualization_msgs/Marker: Header header, string ns, int32 id, int32 type, int32 action,
    geometry_msgs/Pose pose, geometry_msgs/Vector3 scale, std_msgs/ColorRGBA color,
    builtin_interfaces/Duration lifetime, bool frame_locked, geometry_msgs/Point[] points,
    std_msgs/ColorRGBA[] colors, string texture_resource, sensor_msgs/CompressedImage texture,
    UVCoordinate[] uv_coordinates, string text, string mesh_resource, MeshFile mesh_file,
    bool mesh_use_embedded_materials
visualization_msgs/MarkerArray: Marker[] markers
""".replace(",\n", ",")
"""Type and fields, as ROS 2 Jazzy defines them; `test_cdr.py` compares them with `rosbags`."""

NUMBERS = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""Primitive types but strings -> their letter, which `struct` and NumPy share."""

_FIELD = re.compile(r"(?P<type>[\w/]+)(?P<array>\[(?P<count>\d*)\])?\s+(?P<name>[a-z]\w*)\s*$")


class DefinitionsNotFoundError(UserError):
    """A message type without a definition; the message is one sentence."""


class Field(NamedTuple):
    """A field of a message."""

    name: str  # Its name
    type: str  # "string", a letter of `NUMBERS`, or a message type such as std_msgs/msg/Header
    size: int  # 1 for a value, the length of an array, or `SEQUENCE`
    is_array: bool  # Whether it is an array or a sequence


SEQUENCE = -1  # In place of a length: it varies and stands before the elements


@lru_cache(maxsize=1)
def message_folder() -> Path:
    """The folder with this workspace's `.msg` files.

    It lies in this package: as a link in a source tree, with its content in a wheel. In a package that was
    built without its neighbours the link leads nowhere; then it is found as ROS does, on AMENT_PREFIX_PATH.

    Raises:
        DefinitionsNotFoundError: It is in neither place.
    """
    own = Path(__file__).parent / "msg"
    prefixes = [one for one in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if one]
    for folder in (own, *(Path(prefix, "share", MESSAGE_PACKAGE, "msg") for prefix in prefixes)):
        if any(folder.glob("*.msg")):
            return folder
    raise DefinitionsNotFoundError(
        f"The message definitions of {MESSAGE_PACKAGE} are neither in '{own}' nor under a prefix on"
        " AMENT_PREFIX_PATH; build the workspace and source its set-up first."
    )


@lru_cache(maxsize=256)
def fields_of(message_type: str) -> tuple[Field, ...]:
    """The fields of a type such as nav_msgs/msg/Odometry.

    Raises:
        DefinitionsNotFoundError: The type is not known.
    """
    package, _, name = message_type.replace("/msg/", "/").partition("/")
    if package == MESSAGE_PACKAGE:
        path = message_folder() / f"{name}.msg"
        if path.is_file():
            return parse(path.read_text(encoding="utf-8"), package)
    for line in STANDARD.splitlines():
        title, _, fields = line.partition(": ")
        if title == f"{package}/{name}":
            return parse(fields.replace(",", "\n"), package)
    raise DefinitionsNotFoundError(f"The message type {message_type} is not defined in this workspace.")


def parse(definition: str, package: str) -> tuple[Field, ...]:
    """The fields of the text of a `.msg` file; constants have none."""
    fields = []
    for line in definition.splitlines():
        text = line.partition("#")[0].strip()
        if not text or "=" in text:
            continue
        match = _FIELD.match(text)
        if match is None:
            raise DefinitionsNotFoundError(f"The field '{text}' of a message of {package} cannot be read.")
        kind = "std_msgs/Header" if match["type"] == "Header" else match["type"]
        if kind in NUMBERS:
            kind = NUMBERS[kind]
        elif kind != "string":
            owner, _, name = kind.rpartition("/")
            kind = f"{owner or package}/msg/{name}"
        size = int(match["count"] or SEQUENCE) if match["array"] else 1
        fields.append(Field(match["name"], kind, size, match["array"] is not None))
    return tuple(fields)
