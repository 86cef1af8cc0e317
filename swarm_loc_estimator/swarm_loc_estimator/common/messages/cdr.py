"""Encode and decode CDR, the serialization of ROS 2 messages, by tables from the `.msg` definitions.

A subscription with `raw=True` and a bag both deliver the serialized message. Plain CDR (XCDR1) is read in
both byte orders and written in little-endian. `streams` reads frequent messages many at a time, in compiled
code. The standard types stand here as text, this workspace's own are read from the `.msg` files of
`swarm_loc_msgs`, each when it is first used. To load the definitions of all ROS packages with `rosbags`
would cost a node 0.16 s at start.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.parameters import UserError

MESSAGE_PACKAGE = "swarm_loc_msgs"

ODOMETRY, OCCUPANCY_GRID = "nav_msgs/msg/Odometry", "nav_msgs/msg/OccupancyGrid"
IMU, RANGE, LASER_SCAN = "sensor_msgs/msg/Imu", "sensor_msgs/msg/Range", "sensor_msgs/msg/LaserScan"
POSE_STAMPED, TRANSFORM_STAMPED = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
MARKERS, TRANSFORMS = "visualization_msgs/msg/MarkerArray", "tf2_msgs/msg/TFMessage"
_OWN = f"{MESSAGE_PACKAGE}/msg"
DETECTION, DETECTIONS = f"{_OWN}/MarkerDetection", f"{_OWN}/MarkerDetectionArray"
ANONYMOUS_DETECTION, ANONYMOUS_DETECTIONS = f"{_OWN}/AnonymousDetection", f"{_OWN}/AnonymousDetectionArray"
BRIGHTNESS, ROBOT_IDENTITIES = f"{_OWN}/BrightnessMatrix", f"{_OWN}/RobotIdentities"
RANGES, LASER, LIGHTS = f"{_OWN}/RangeArray", f"{_OWN}/LaserDistance", f"{_OWN}/LightBearingArray"
SWARM_ODOMETRY, SWARM_DETECTIONS = f"{_OWN}/SwarmOdometry", f"{_OWN}/SwarmDetections"
SWARM_FIXES, SWARM_POSES = f"{_OWN}/SwarmFixes", f"{_OWN}/SwarmPoses"
SWARM_SIGHTINGS = f"{_OWN}/SwarmSightings"
EVENT_PACKETS = ("event_camera_msgs/msg/EventPacket", f"{_OWN}/EventPacket")
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
diagnostic_msgs/KeyValue: string key, string value
diagnostic_msgs/DiagnosticStatus: byte level, string name, string message, string hardware_id,
    KeyValue[] values
diagnostic_msgs/DiagnosticArray: std_msgs/Header header, DiagnosticStatus[] status
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
sensor_msgs/Range: Header header, uint8 radiation_type, float32 field_of_view, float32 min_range,
    float32 max_range, float32 range, float32 variance
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
FOREIGN = """
motion_capture_tracking_interfaces/NamedPose: string name, geometry_msgs/Pose pose
motion_capture_tracking_interfaces/NamedPoseArray: std_msgs/Header header, NamedPose[] poses
mocap4r2_msgs/Marker: int64 index, geometry_msgs/Point translation
mocap4r2_msgs/RigidBody: std_msgs/Header header, uint32 frame_number, string rigid_body_name,
    Marker[] markers, geometry_msgs/Pose pose
mocap4r2_msgs/RigidBodies: std_msgs/Header header, uint32 frame_number, RigidBody[] rigidbodies
""".replace(",\n", ",")
"""Types of motion capture, as their packages define them."""

_PRIMITIVE = "bool byte char int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64"
NUMBERS = dict(zip(_PRIMITIVE.split(), "?BBbBhHiIqQfd", strict=True))
"""Primitive types but strings -> their letter, which `struct` and NumPy share."""

_FIELD = re.compile(r"(?P<type>[\w/]+)(?P<array>\[(?P<count>\d*)\])?\s+(?P<name>[a-z]\w*)\s*$")


class DefinitionsNotFoundError(UserError):
    """A message type without a definition."""


class Field(NamedTuple):
    """A field of a message."""

    name: str  # Its name
    type: str  # "string", a letter of `NUMBERS`, or a message type such as std_msgs/msg/Header
    size: int  # 1 for a value, the length of an array, or `SEQUENCE`
    is_array: bool  # Whether it is an array or a sequence


SEQUENCE = -1  # In place of a length: it varies and stands before the elements


@lru_cache(maxsize=1)
def message_folder() -> Path:
    """The folder with this workspace's `.msg` files; raises DefinitionsNotFoundError if it is not found.

    It lies in this package: as a link in a source tree, with its content in a wheel. In a package that was
    built without its neighbours the link leads nowhere; then it is found on AMENT_PREFIX_PATH, as ROS does.
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
    """The fields of a type such as nav_msgs/msg/Odometry; raises DefinitionsNotFoundError if unknown."""
    package, _, name = message_type.replace("/msg/", "/").partition("/")
    if package == MESSAGE_PACKAGE:
        path = message_folder() / f"{name}.msg"
        if path.is_file():
            return parse(path.read_text(encoding="utf-8"), package)
    for line in (STANDARD + FOREIGN).splitlines():
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


Rows = NDArray[np.void]

ENCAPSULATION = 4  # Bytes before the payload; alignment counts from their end
MAX_PADDING = 7  # Bytes that may come after a message
SECOND_NS = 1_000_000_000
TIME = "builtin_interfaces/msg/Time"

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}
_struct = lru_cache(maxsize=256)(struct.Struct)


class CdrError(ValueError):
    """Bytes that are not a whole message of the expected type."""


def nanoseconds(stamp: Any) -> int:
    """A builtin_interfaces/Time [ns]; it may lie before zero, which `rclpy.time.Time` refuses."""
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def stamp_rows(stamp_ns: IntArray) -> Rows:
    """Stamps (n,) [ns] as rows of builtin_interfaces/Time."""
    rows = np.empty(len(stamp_ns), row_dtype(TIME))
    rows["sec"], rows["nanosec"] = np.divmod(stamp_ns, SECOND_NS)
    return rows


def decode(data: bytes, message_type: str, places: dict[str, list[int]] | None = None) -> Any:
    """Read a message of a type such as nav_msgs/msg/Odometry, with its encapsulation header.

    `places` gets the offsets of each field by its path, such as "robots.x"; those of strings and sequences
    are of their length. The fields are attributes of the result: numbers, texts, arrays of numbers, messages.
    A sequence of messages of fixed size is a structured array, see `row_dtype`; any other one is a list.
    Raises CdrError if the bytes are not one whole message.
    """
    reader = _CdrReader(data, places)
    message = reader.message(message_type)
    reader.check_end()
    return message


def encode(message: object, message_type: str) -> bytes:
    """Serialize a mapping, or an object with attributes, as `decode` returns it, as a message of a type.

    Fields that it lacks are zero or empty. A stamp may be given in nanoseconds, points or colours as an array
    (n, fields).
    """
    writer = _CdrWriter()
    writer.message(message, message_type)
    return bytes(writer.data)


@lru_cache(maxsize=256)
def _columns(message_type: str) -> tuple[tuple[str, str, int], ...] | None:
    """Path, letter and count of the numbers of a message of fixed size; None: its size varies."""
    columns: list[tuple[str, str, int]] = []
    for field in fields_of(message_type):
        if field.type == "string" or field.size == SEQUENCE:
            return None
        if len(field.type) == 1:
            columns.append((field.name, field.type, field.size))
            continue
        inner = _columns(field.type)
        if inner is None or field.is_array:
            return None
        if {one[1:] for one in inner} == {(inner[0][1], 1)}:
            columns.append((field.name, inner[0][1], len(inner)))
        else:
            columns += [(f"{field.name}.{name}", letter, count) for name, letter, count in inner]
    return tuple(columns)


@lru_cache(maxsize=256)
def row_dtype(message_type: str, start: int | None = None, order: str = "<") -> np.dtype[np.void]:
    """The bytes of one message of fixed size in a sequence.

    A field of a message inside is named by its path; a message inside whose numbers are all of one type, such
    as a Point, is one field. It starts `start` bytes after a multiple of 8; None: as all but the first of a
    sequence do. `order` is "<" or ">".
    """
    columns = _columns(message_type) or ()
    if start is None:
        start = row_dtype(message_type, 0, order).itemsize % 8
    names, formats, offsets, offset = [], [], [], start
    for name, letter, count in columns:
        dtype = np.dtype(order + letter)
        offset += -offset % dtype.itemsize
        names.append(name)
        formats.append((dtype, (count,)) if count > 1 else dtype)
        offsets.append(offset - start)
        offset += dtype.itemsize * count
    layout = {"names": names, "formats": formats, "offsets": offsets, "itemsize": offset - start}
    return np.dtype(layout)  # type: ignore[call-overload,no-any-return]


def renamed(dtype: np.dtype[np.void], **shapes: tuple[int, ...]) -> np.dtype[np.void]:
    """The layout of rows with other names and shapes of its fields, given in order."""
    fields = [dtype[name] for name in dtype.names or ()]
    layout = {
        "names": list(shapes),
        "formats": [(one.base, shape) for one, shape in zip(fields, shapes.values(), strict=True)],
        "offsets": [entry[1] for entry in (dtype.fields or {}).values()],
        "itemsize": dtype.itemsize,
    }
    return np.dtype(layout)  # type: ignore[call-overload,no-any-return]


@lru_cache(maxsize=256)
def _numbers(message_type: str) -> str:
    """Letters of the numbers of a message that has nothing but single numbers of one type; "": another."""
    columns = _columns(message_type) or ()
    is_plain = not any(field.is_array for field in fields_of(message_type))
    letters = "".join(letter * count for _, letter, count in columns)
    inner = [field.type for field in fields_of(message_type) if len(field.type) > 1]
    return letters if is_plain and len(set(letters)) == 1 and all(map(_numbers, inner)) else ""


def _filled(message_type: str, numbers: Iterator[Any]) -> SimpleNamespace:
    """A message with numbers in the order of its fields."""
    fields = fields_of(message_type)
    return SimpleNamespace(
        **{f.name: next(numbers) if len(f.type) == 1 else _filled(f.type, numbers) for f in fields}
    )


@lru_cache(maxsize=4096)
def _text(raw: bytes) -> str:
    """The characters of a string field, its terminating zero included in `raw`."""
    if raw and raw[-1] != 0:
        raise CdrError("a string is not terminated.")
    try:
        return raw[:-1].decode()
    except UnicodeDecodeError:
        raise CdrError("a string is not UTF-8.") from None


class _CdrReader:
    """Reads the fields of a message one after the other."""

    def __init__(self, data: bytes, places: dict[str, list[int]] | None) -> None:
        order = _ORDERS.get(bytes(data[:2]))
        if order is None or len(data) < ENCAPSULATION:
            found = bytes(data[:ENCAPSULATION]).hex() or "missing"
            raise CdrError(f"encapsulation {found} is not plain CDR.")
        self._data, self._order, self._offset, self._places = data, order, ENCAPSULATION, places

    def message(self, message_type: str, path: str = "") -> Any:
        letters = _numbers(message_type) if self._places is None else ""
        if letters:  # several times faster than one after the other
            numbers = _struct(self._order + letters)
            begin = self._take(numbers.size, numbers.size // len(letters))
            message = _filled(message_type, iter(numbers.unpack_from(self._data, begin)))
        else:
            message = SimpleNamespace(**{one.name: self._field(one, path) for one in fields_of(message_type)})
        if message_type == TIME and message.nanosec >= SECOND_NS:
            raise CdrError(f"stamp has {message.nanosec} nanoseconds, more than a second.")
        return message

    def check_end(self) -> None:
        """Refuse a message that goes on after its last field."""
        if len(self._data) > self._offset + MAX_PADDING:
            raise CdrError(f"{len(self._data) - self._offset} bytes more than the message has.")

    def _field(self, field: Field, path: str) -> Any:
        letter, place = field.type, path + field.name
        if not field.is_array:
            return self._value(letter, place)
        count = self._value("I", place) if field.size == SEQUENCE else field.size
        if len(letter) == 1:
            dtype = np.dtype(self._order + letter)
            begin = self._take(count * dtype.itemsize, dtype.itemsize if count else 1)
            return np.frombuffer(self._data, dtype, count, begin).astype(letter, copy=False)
        if _columns(letter):
            return self._rows(letter, count)
        return [self._value(letter, place) for _ in range(count)]

    def _value(self, letter: str, place: str) -> Any:
        if len(letter) > 1 and letter != "string":
            return self.message(letter, f"{place}.")
        number = _struct(self._order + ("I" if letter == "string" else letter))
        begin = self._take(number.size, number.size)
        if self._places is not None:
            self._places.setdefault(place, []).append(begin)
        value = number.unpack_from(self._data, begin)[0]
        if letter != "string":
            return value
        begin = self._take(value, 1)
        return _text(bytes(self._data[begin : self._offset]))

    def _rows(self, message_type: str, count: int) -> Rows:
        least = count * row_dtype(message_type).itemsize - MAX_PADDING
        if self._offset + least > len(self._data):  # before memory is taken for them
            raise CdrError(f"cut off after {len(self._data)} bytes.")
        rows = np.zeros(count, row_dtype(message_type))
        for part in (rows[:1], rows[1:]):
            dtype = row_dtype(message_type, (self._offset - ENCAPSULATION) % 8, self._order)
            stored = np.frombuffer(self._data, dtype, len(part), self._take(len(part) * dtype.itemsize, 1))
            for name in dtype.names or ():
                part[name] = stored[name]
        return rows

    def _take(self, size: int, alignment: int) -> int:
        """The offset of the next bytes, which are read."""
        begin = self._offset + -(self._offset - ENCAPSULATION) % alignment
        if begin + size > len(self._data):
            raise CdrError(f"cut off after {len(self._data)} bytes.")
        self._offset = begin + size
        return begin


class _CdrWriter:
    """Appends the fields of a message to `data` one after the other."""

    def __init__(self) -> None:
        self.data = bytearray(_LITTLE_ENDIAN)

    def message(self, message: object, message_type: str) -> None:
        if message_type == TIME and isinstance(message, int | np.integer):
            message = dict(zip(("sec", "nanosec"), divmod(int(message), SECOND_NS), strict=True))
        values = message if isinstance(message, Mapping) else vars(message)
        fields = fields_of(message_type)
        if unknown := values.keys() - {field.name for field in fields}:
            raise KeyError(f"{message_type} has no {', '.join(sorted(unknown))}")
        for field in fields:
            self._field(field, values.get(field.name))

    def _field(self, field: Field, value: Any) -> None:
        if not field.is_array:
            self._value(field.type, value)
            return
        if value is None:
            value = np.zeros(max(field.size, 0)) if len(field.type) == 1 else ()
        if isinstance(value, bytes | bytearray):
            value = np.frombuffer(value, np.uint8)
        if len(field.type) == 1:
            value = np.ravel(value)
        if field.size == SEQUENCE:
            self._value("I", len(value))
        elif len(value) != field.size:
            raise ValueError(f"{field.name} has {len(value)} values in place of {field.size}")
        if not len(value):
            return
        if len(field.type) == 1:
            numbers = np.asarray(value, "<" + field.type)
            self._append(numbers.tobytes(), numbers.itemsize)
        elif isinstance(value, np.ndarray):
            self._rows(field.type, value)
        else:
            for one in value:
                self._value(field.type, one)

    def _value(self, letter: str, value: Any) -> None:
        if letter == "string":
            text = (value or "").encode() + b"\x00"
            self._value("I", len(text))
            self.data += text
        elif len(letter) == 1:
            number = _struct("<" + letter)
            self._append(number.pack(0 if value is None else value), number.size)
        else:
            self.message({} if value is None else value, letter)

    def _rows(self, message_type: str, rows: NDArray[Any]) -> None:
        if rows.dtype.names is None:
            dtype = row_dtype(message_type, 0)
            rows = np.ascontiguousarray(rows, dtype[0]).view(dtype)[:, 0]
        for part in (rows[:1], rows[1:]):
            dtype = row_dtype(message_type, (len(self.data) - ENCAPSULATION) % 8)
            # equal messages give equal bytes, those between fields included
            stored = np.zeros(len(part), dtype)
            for name, own in zip(dtype.names or (), part.dtype.names or (), strict=True):
                stored[name] = part[own].reshape(stored[name].shape)
            self.data += stored.tobytes()

    def _append(self, data: bytes, alignment: int) -> None:
        self.data += bytes(-(len(self.data) - ENCAPSULATION) % alignment)
        self.data += data
