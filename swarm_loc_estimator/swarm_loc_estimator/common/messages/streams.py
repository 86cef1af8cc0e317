"""Decode the messages of many topics at once, in compiled code.

Frame names and byte order hardly ever change from one message of a topic to the next. They are compared with
those of the last message that `cdr` has decoded, and only the numbers are read; a message that differs is
decoded by `cdr`. That takes 0.1 us a message instead of 20 us, see docs/decisions/0003-cdr-codec.md.

Many serialized messages at once: one buffer, and columns with the place of each message in it.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.messages.cdr import ENCAPSULATION, MAX_PADDING, SECOND_NS, CdrError
from swarm_loc_estimator.common.messages.detections import (
    DETECTION_DTYPE,
    DETECTION_GAP,
    DetectionArrayMessage,
    decode_detections,
)
from swarm_loc_estimator.common.messages.poses import (
    POSE_DOUBLES,
    PoseMessage,
    yaw_of,
)


class SerializedMessage(NamedTuple):
    """One serialized message: number of its topic, bytes, and when it was recorded or arrived [ns]."""

    topic: int
    data: bytes
    log_ns: int


class MessageBatch(NamedTuple):
    """Messages (n,) of several topics."""

    data: NDArray[np.uint8]  # (b,) bytes, read-only
    topic: IntArray  # (n,) number of the topic of each
    log_ns: IntArray  # (n,) when each was recorded or arrived
    offset: IntArray  # (n,) where each begins in `data`
    length: IntArray  # (n,) of each in bytes

    @classmethod
    def of(cls, messages: Sequence[SerializedMessage]) -> MessageBatch:
        """A batch of single messages."""
        length = np.array([len(data) for _, data, _ in messages], dtype=np.int64)
        return cls(
            np.frombuffer(b"".join([data for _, data, _ in messages]), dtype=np.uint8),
            np.array([topic for topic, _, _ in messages], dtype=np.int64),
            np.array([log_ns for _, _, log_ns in messages], dtype=np.int64),
            np.cumsum(length) - length,
            length,
        )

    @classmethod
    def parts_of(cls, messages: list[SerializedMessage], size: int) -> Iterator[MessageBatch]:
        """Batches of successive messages of about so many bytes each; the list is emptied meanwhile."""
        ends = (np.cumsum([len(data) for _, data, _ in messages]) // size).tolist()
        messages.reverse()
        for _, part in itertools.groupby(ends):
            yield cls.of([messages.pop() for _ in part])

    @property
    def size(self) -> int:
        """Number of messages."""
        return self.topic.size

    def message(self, k: int) -> bytes:
        """The bytes of one message."""
        return self.data[self.offset[k] : self.offset[k] + self.length[k]].tobytes()

    def messages(self) -> Iterator[tuple[int, int, bytes]]:
        """Number of the topic, time and bytes of one after the other."""
        view = memoryview(self.data)  # type: ignore[arg-type]
        columns = (self.topic, self.log_ns, self.offset, self.length)
        for topic, log_ns, offset, length in zip(*(c.tolist() for c in columns), strict=True):
            yield topic, log_ns, bytes(view[offset : offset + length])

    def chosen(self, k: slice | NDArray[np.intp] | BoolArray) -> MessageBatch:
        """Some of them, in the same buffer."""
        return MessageBatch(self.data, self.topic[k], self.log_ns[k], self.offset[k], self.length[k])

    def in_order_of_time(self) -> MessageBatch:
        """Sorted by time, equal ones as they lie."""
        if np.all(self.log_ns[1:] >= self.log_ns[:-1]):
            return self
        return self.chosen(np.argsort(self.log_ns, kind="stable"))


def merged(parts: Sequence[MessageBatch]) -> MessageBatch:
    """All messages of batches that are each in order of time; equal times in the order of the parts."""
    parts = [part for part in parts if part.size] or [*parts[:1]]
    if len(parts) == 1:
        return parts[0]
    sizes = np.cumsum([0, *(part.data.size for part in parts)]).tolist()
    offsets = [part.offset + begin for part, begin in zip(parts, sizes, strict=False)]
    data = np.concatenate([part.data for part in parts])
    data.flags.writeable = False  # as all others are: compiled code depends on it
    return MessageBatch(
        data,
        np.concatenate([part.topic for part in parts]),
        np.concatenate([part.log_ns for part in parts]),
        np.concatenate(offsets),
        np.concatenate([part.length for part in parts]),
    ).in_order_of_time()


def trimmed(batch: MessageBatch) -> MessageBatch:
    """The batch with a buffer that holds little else than its messages."""
    if not batch.size:
        return batch._replace(data=batch.data[:0].copy())
    begin, end = int(batch.offset.min()), int((batch.offset + batch.length).max())
    return batch._replace(data=batch.data[begin:end], offset=batch.offset - begin)


def merge_streams(streams: Sequence[Iterator[MessageBatch]]) -> Iterator[MessageBatch]:
    """Streams that are each in order of time as one; equal times in the order of the streams."""
    heads = [_next_of(stream) for stream in streams]
    while True:
        alive = [k for k, head in enumerate(heads) if head is not None]
        if not alive:
            return
        ends = {k: int(head.log_ns[-1]) for k, head in enumerate(heads) if head is not None}
        limit = min(ends.values())
        shortest = next(k for k in alive if ends[k] == limit)
        parts = []
        for k in alive:
            head = heads[k]
            if head is None:
                continue
            # what later streams have at this very time must wait for what the shortest may still have
            count = int(np.searchsorted(head.log_ns, limit, side="right" if k <= shortest else "left"))
            parts.append(trimmed(head.chosen(slice(count))))
            heads[k] = head.chosen(slice(count, None))
        yield merged(parts)
        heads[shortest] = _next_of(streams[shortest])


def _next_of(stream: Iterator[MessageBatch]) -> MessageBatch | None:
    """The next batch with anything in it."""
    return next((batch for batch in stream if batch.size), None)


BytesArray = NDArray[np.uint8]


class StampedMessage(Protocol):
    """Any message with a header."""

    @property
    def stamp_ns(self) -> int:
        """When it was true."""

    @property
    def frame_id(self) -> str:
        """Its frame."""


Message = TypeVar("Message", bound=StampedMessage)

_LITTLE_ENDIAN = b"\x00\x01"
_NAMES = ENCAPSULATION + 8  # Offset of the first frame name's length, after the stamp
_DETECTION_SIZE = DETECTION_DTYPE.itemsize
_TWIST = tuple(8 * (POSE_DOUBLES + 36 + component) for component in (0, 1, 5))
"""Offsets of x, y and yaw of the twist from the start of the numbers of nav_msgs/Odometry."""
_ODOMETRY_NUMBERS = 8 * (POSE_DOUBLES + 36 + 6 + 36)
"""Size of these numbers [byte]; of other messages with a pose it is less."""


def _not_known() -> IntArray:
    return np.zeros(0, dtype=np.int64)


class _Models(NamedTuple):
    """Per topic what its messages have in common that only differ in stamp and numbers."""

    names: BytesArray  # (t, w) bytes from `_NAMES` to `end`
    end: IntArray  # (t,) offset after the frame names; 0 where no message was read yet
    start: IntArray  # (t,) offset of the numbers
    size: IntArray  # (t,) length of the message, where it does not vary


def _no_models(topics: int) -> _Models:
    return _Models(np.zeros((topics, 64), dtype=np.uint8), *np.zeros((3, topics), dtype=np.int64))


def _with_model(models: _Models, topic: int, data: bytes, end: int, start: int) -> _Models:
    """The models with that of one topic learned from a message."""
    names = np.frombuffer(data[_NAMES:end], dtype=np.uint8)
    missing = names.size - models.names.shape[1]
    if missing > 0:
        models = models._replace(names=np.pad(models.names, ((0, 0), (0, missing))))
    models.names[topic, : names.size] = names
    models.end[topic], models.start[topic], models.size[topic] = end, start, len(data)
    return models


@dataclass(frozen=True)
class PoseColumns:
    """Stamped poses (n,), one per message."""

    stamp_ns: IntArray  # (n,)
    pose: FloatArray  # (n, 3) x [m], y [m], yaw [rad]; yaw is NaN when the quaternion is zero
    # (n, 3) forward and left [m/s] and turn rate [rad/s] of nav_msgs/Odometry; NaN for other types
    twist: FloatArray
    valid: BoolArray  # (n,) whether the bytes were a whole message of the type
    robot: IntArray = field(default_factory=_not_known)  # (n,) see `Messages`
    arrival_ns: IntArray = field(default_factory=_not_known)  # (n,) arrival times


class PoseReader:
    """Reads messages, of some number of topics, that begin with a header, names and a pose.

    `decode` reads one message completely. `names` frame names lie before the pose, that of the header, too.
    """

    def __init__(self, topics: int, decode: Callable[[bytes], PoseMessage], names: int) -> None:
        self.frame_ids = [""] * topics  # Per topic the frame of the newest message, "" before the first
        self._decode = decode
        self._names = names
        self._models = _no_models(topics)

    def read(self, batch: MessageBatch) -> PoseColumns:
        """Read messages whose topics are numbered from 0 to `topics`."""
        n = batch.size
        pose, twist = np.full((2, n, 3), np.nan)
        columns = PoseColumns(np.zeros(n, dtype=np.int64), pose, twist, np.ones(n, dtype=bool))
        k = _read_poses(batch, self._models, 0, columns.stamp_ns, pose, twist)
        while k < n:
            try:
                message = self._learn(int(batch.topic[k]), batch.message(k))
                columns.stamp_ns[k], pose[k], twist[k] = message.stamp_ns, message.pose, message.twist
            except CdrError:
                columns.valid[k] = False
            k = _read_poses(batch, self._models, k + 1, columns.stamp_ns, pose, twist)
        return columns

    def _learn(self, topic: int, data: bytes) -> PoseMessage:
        """Read one message completely; the next ones are compared with it."""
        message = self._decode(data)
        self.frame_ids[topic] = message.frame_id
        self._models.end[topic] = 0
        if data[:2] == _LITTLE_ENDIAN:
            end = _NAMES
            for _ in range(self._names):
                end = _after_string(data, end)
            start = end + -(end - ENCAPSULATION) % 8
            self._models = _with_model(self._models, topic, data, end, start)
        return message


@dataclass(frozen=True)
class DetectionColumns:
    """Detections of all messages (n,), one after the other (d,)."""

    stamp_ns: IntArray  # (n,)
    count: IntArray  # (n,) detections per message
    detection: NDArray[np.void]  # (d,) of `DETECTION_DTYPE`
    valid: BoolArray  # (n,) whether the bytes were a whole message of the type
    robot: IntArray = field(default_factory=_not_known)  # (n,) see `Messages`
    arrival_ns: IntArray = field(default_factory=_not_known)  # (n,) arrival times


class DetectionReader:
    """Reads swarm_loc_msgs/MarkerDetectionArray of some number of topics."""

    def __init__(self, topics: int) -> None:
        self.frame_ids = [""] * topics  # Per topic the frame of the newest message, "" before the first
        self._models = _no_models(topics)

    def read(self, batch: MessageBatch) -> DetectionColumns:
        """Read messages whose topics are numbered from 0 to `topics`."""
        n = batch.size
        stamp_ns, count, begin = np.zeros((3, n), dtype=np.int64)
        valid = np.ones(n, dtype=bool)
        unlike: list[bytes] = []
        unlike_size = 0
        k = _scan_detections(batch, self._models, 0, stamp_ns, count, begin)
        while k < n:
            try:
                message = self._learn(int(batch.topic[k]), batch.message(k))
                stamp_ns[k], count[k] = message.stamp_ns, message.detections.size
                begin[k] = batch.data.size + unlike_size  # as if it lay after the others
                unlike.append(message.detections.tobytes())
                unlike_size += len(unlike[-1])
            except CdrError:
                valid[k] = False
            k = _scan_detections(batch, self._models, k + 1, stamp_ns, count, begin)
        packed = np.empty((int(count.sum()), _DETECTION_SIZE), dtype=np.uint8)
        _pack(batch.data, np.frombuffer(b"".join(unlike), dtype=np.uint8), batch.offset, count, begin, packed)
        return DetectionColumns(stamp_ns, count, packed.view(DETECTION_DTYPE)[:, 0], valid)

    def _learn(self, topic: int, data: bytes) -> DetectionArrayMessage:
        """Read one message completely; the next ones are compared with it."""
        message = decode_detections(data)
        self.frame_ids[topic] = message.frame_id
        self._models.end[topic] = 0
        if data[:2] == _LITTLE_ENDIAN:
            end = _after_string(data, _NAMES)
            self._models = _with_model(self._models, topic, data, end, end + -end % 4 + 4)
        return message


@dataclass(frozen=True)
class Messages(Generic[Message]):
    """Messages (n,) read whole."""

    stamp_ns: IntArray  #: (n,) stamps of their headers
    valid: BoolArray  #: (n,) whether the bytes were a whole message of the type
    decoded: list[Message]  #: The valid ones
    #: (n,) index of the topic's robot, or N plus that of the camera; -1: swarm
    robot: IntArray = field(default_factory=_not_known)
    arrival_ns: IntArray = field(default_factory=_not_known)  #: (n,) arrival times


class EachReader(Generic[Message]):
    """Reads messages one by one, which is enough for what comes some hundred times a second.

    `decode` raises ValueError, LookupError or struct.error if a message is malformed.
    """

    def __init__(self, topics: int, decode: Callable[[bytes], Message]) -> None:
        self.frame_ids = [""] * topics  # Per topic the frame of the newest message, "" before the first
        self._decode: Callable[[bytes], Message] = decode

    def read(self, batch: MessageBatch) -> Messages[Message]:
        """Read messages whose topics are numbered from 0 to `topics`."""
        stamp_ns, valid = np.zeros(batch.size, dtype=np.int64), np.ones(batch.size, dtype=bool)
        messages: list[Message] = []
        for k, (topic, _, data) in enumerate(batch.messages()):
            try:
                message = self._decode(data)
            except (ValueError, LookupError, struct.error):
                valid[k] = False
                continue
            stamp_ns[k], self.frame_ids[topic] = message.stamp_ns, message.frame_id
            messages.append(message)
        return Messages(stamp_ns, valid, messages, arrival_ns=batch.log_ns)


def _after_string(data: bytes, offset: int) -> int:
    """Offset after the string field that starts at or after `offset`, in bytes that are known to be whole."""
    offset += -offset % 4
    return offset + 4 + int.from_bytes(data[offset : offset + 4], "little")


@cached_njit
def _read_poses(
    batch: MessageBatch, models: _Models, k: int, stamp_ns: IntArray, pose: FloatArray, twist: FloatArray
) -> int:
    """Write stamps (n,), poses and twists (n, 3) from message k on; return the first unlike its topic's."""
    bits = np.empty(7, dtype=np.uint64)
    numbers = bits.view(np.float64)
    while k < batch.offset.size:
        offset, start = batch.offset[k], models.start[batch.topic[k]]
        if batch.length[k] != models.size[batch.topic[k]] or not _is_alike(batch, k, models):
            return k
        for i in range(7):
            bits[i] = _word(batch.data, offset + start + 8 * i, 8)
        stamp_ns[k] = _stamp_ns(batch.data, offset)
        pose[k, 0], pose[k, 1] = numbers[0], numbers[1]
        pose[k, 2] = yaw_of(numbers[3], numbers[4], numbers[5], numbers[6])
        if batch.length[k] >= start + _ODOMETRY_NUMBERS:
            for i in range(3):
                bits[i] = _word(batch.data, offset + start + _TWIST[i], 8)
                twist[k, i] = numbers[i]
        k += 1
    return k


@cached_njit
def _scan_detections(
    batch: MessageBatch, models: _Models, k: int, stamp_ns: IntArray, count: IntArray, begin: IntArray
) -> int:
    """Write stamps, counts and first offsets (n,) from message k on; return the first that is not alike."""
    while k < batch.offset.size:
        offset, length, start = batch.offset[k], batch.length[k], models.start[batch.topic[k]]
        if length < start or not _is_alike(batch, k, models):
            return k
        found = np.int64(_word(batch.data, offset + start - 4, 4))
        gap = 4 if found and start % 8 == ENCAPSULATION else 0
        end = start + found * _DETECTION_SIZE + gap
        if not end <= length <= end + MAX_PADDING:
            return k
        stamp_ns[k], count[k], begin[k] = _stamp_ns(batch.data, offset), found, offset + start
        k += 1
    return k


@cached_njit
def _pack(
    data: BytesArray,
    unlike: BytesArray,
    offset: IntArray,
    count: IntArray,
    begin: IntArray,
    packed: BytesArray,
) -> None:
    """Copy all detections (d, size), without the padding that the first one of a message may have."""
    row = 0
    for k in range(count.size):
        source, place = (data, begin[k]) if begin[k] < data.size else (unlike, begin[k] - data.size)
        padded = begin[k] < data.size and (begin[k] - offset[k]) % 8 == ENCAPSULATION
        for first in range(row, row + count[k]):
            packed[first, :DETECTION_GAP] = source[place : place + DETECTION_GAP]
            place += 4 if padded and first == row else 0
            packed[first, DETECTION_GAP:] = source[place + DETECTION_GAP : place + _DETECTION_SIZE]
            place += _DETECTION_SIZE
        row += count[k]


@cached_njit
def _is_alike(batch: MessageBatch, k: int, models: _Models) -> bool:
    """Whether message k has the byte order and the names of its topic's model, and a stamp."""
    data, offset, topic = batch.data, batch.offset[k], batch.topic[k]
    end = models.end[topic]
    if end == 0 or data[offset] != 0 or data[offset + 1] != 1:
        return False
    for i in range(end - _NAMES):
        if data[offset + _NAMES + i] != models.names[topic, i]:
            return False
    return bool(_word(data, offset + ENCAPSULATION + 4, 4) < SECOND_NS)


@cached_njit
def _stamp_ns(data: BytesArray, offset: int) -> int:
    """The stamp of the message at an offset [ns]."""
    seconds = np.int64(np.int32(np.uint32(_word(data, offset + ENCAPSULATION, 4))))
    stamp_ns: int = seconds * SECOND_NS + np.int64(_word(data, offset + ENCAPSULATION + 4, 4))
    return stamp_ns


@cached_njit
def _word(data: BytesArray, offset: int, size: int) -> np.uint64:
    """A little-endian number."""
    word: np.uint64 = np.uint64(0)
    for i in range(size):
        word |= np.uint64(data[offset + i]) << np.uint64(8 * i)
    return word
