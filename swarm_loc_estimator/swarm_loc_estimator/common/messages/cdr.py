"""Encode and decode CDR, the serialization of ROS 2 messages, by tables from the `.msg` definitions.

A subscription with `raw=True` and a bag both deliver the serialized message. Plain CDR (XCDR1) is read in
both byte orders and written in little-endian. `streams` reads frequent messages many at a time, in compiled
code.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.messages.definitions import SEQUENCE, Field, fields_of

Rows = NDArray[np.void]

ENCAPSULATION = 4  # Bytes before the payload; alignment counts from behind them
MAX_PADDING = 7  # Bytes that may come behind a message
SECOND_NS = 1_000_000_000
TIME = "builtin_interfaces/msg/Time"

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}
_struct = lru_cache(maxsize=256)(struct.Struct)


class CdrError(ValueError):
    """Bytes that are not a whole message of the expected type; the message is one sentence."""


class Stamp(Protocol):
    """A builtin_interfaces/Time, whatever has built it."""

    @property
    def sec(self) -> int:
        """Whole seconds, which may be negative."""

    @property
    def nanosec(self) -> int:
        """The rest [ns]."""


def nanoseconds(stamp: Stamp) -> int:
    """A stamp [ns]; it may lie before zero, which `rclpy.time.Time` refuses."""
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def stamp_rows(stamp_ns: NDArray[np.int64]) -> Rows:
    """Stamps (n,) [ns] as rows of builtin_interfaces/Time."""
    rows = np.empty(len(stamp_ns), row_dtype(TIME))
    rows["sec"], rows["nanosec"] = np.divmod(stamp_ns, SECOND_NS)
    return rows


def decode(data: bytes, message_type: str, places: dict[str, list[int]] | None = None) -> Any:
    """Read a message.

    Args:
        data: The serialized message with its encapsulation header.
        message_type: Its type, such as nav_msgs/msg/Odometry.
        places: Filled with the offsets of each field by its path, such as "robots.x"; those of strings and
            sequences are of their length.

    Returns:
        An object with the fields as attributes: numbers, texts, arrays of numbers, messages. A sequence of
        messages of fixed size is a structured array, see `row_dtype`; any other one is a list.

    Raises:
        CdrError: The bytes are not one whole message.
    """
    reader = _CdrReader(data, places)
    message = reader.message(message_type)
    reader.check_end()
    return message


def encode(message: object, message_type: str) -> bytes:
    """Serialize a message.

    Args:
        message: A mapping, or an object with attributes, as `decode` returns it. Fields that it lacks are
            zero or empty. A stamp may be given in nanoseconds, points or colours as an array (n, fields).
        message_type: Its type.
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

    Args:
        message_type: Its type. A field of a message inside is named by its path; a message inside whose
            numbers
            are all of one type, such as a Point, is one field.
        start: Where it starts, in bytes behind a multiple of 8; None: as all but the first of a sequence do.
        order: "<" or ">".
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
            raise CdrError(
                f"encapsulation {bytes(data[:ENCAPSULATION]).hex() or 'missing'} is not plain CDR."
            )
        self._data, self._order, self._offset, self._places = data, order, ENCAPSULATION, places

    def message(self, message_type: str, path: str = "") -> Any:
        """The fields of a message."""
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
        """Refuse a message that goes on behind its last field."""
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
            begin = self._take(len(part) * dtype.itemsize, 1)
            stored = np.frombuffer(self._data, dtype, len(part), begin)
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
        """Add a message."""
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
            stored = np.zeros(
                len(part), dtype
            )  # equal messages give equal bytes, those between fields included
            for name, own in zip(dtype.names or (), part.dtype.names or (), strict=True):
                stored[name] = part[own].reshape(stored[name].shape)
            self.data += stored.tobytes()

    def _append(self, data: bytes, alignment: int) -> None:
        self.data += bytes(-(len(self.data) - ENCAPSULATION) % alignment)
        self.data += data
