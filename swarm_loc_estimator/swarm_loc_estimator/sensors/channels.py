"""Decode the raw messages of one kind of input to the columns that the estimator takes.

A new kind of input is a member of `InputKind`, columns in `sensors/messages.py`, and a channel here or,
where its messages carry what many robots have sent, in `shared_channels.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.detections import (
    ANONYMOUS_DTYPE,
    AnonymousMessage,
    BrightnessMessage,
    decode_anonymous,
    decode_brightness,
)
from swarm_loc_estimator.common.messages.message_batch import MessageBatch
from swarm_loc_estimator.common.messages.poses import FixMessage, decode_fix, decode_odometry
from swarm_loc_estimator.common.messages.streams import DetectionReader, EachReader, PoseReader
from swarm_loc_estimator.sensors.messages import (
    AerialRows,
    BrightnessRows,
    DetectionRows,
    FixRows,
    OdometryRows,
    chosen,
)
from swarm_loc_estimator.sensors.topics import InputKind

HEADING_UNKNOWN = math.pi**2
"""A heading with such a variance [rad^2] or more was not measured: all headings there are vary by less."""
FOREIGN_FRAME = "fix_frame"
"""Why a fix that is not in `map` is dropped."""
FOREIGN_AERIAL_FRAME = "aerial_frame"
"""Likewise an aerial image whose detections are not."""
TOO_MANY = "aerial_too_many"
"""Why an aerial image with more detections than MAX_ANONYMOUS is dropped: it shows something else."""
MAX_ANONYMOUS = 2000


class Read(NamedTuple):
    """What messages (n,) hold.

    Attributes:
        rows: A tuple of columns of `sensors/messages.py`.
        stamp_ns: (n,) their stamps.
        valid: (n,) whether the bytes were a whole message of the type.
        dropped: Reason -> how many were whole and yet are not among the rows.
    """

    rows: tuple[NDArray[Any], ...]
    stamp_ns: IntArray
    valid: NDArray[np.bool_]
    dropped: Mapping[str, int] = MappingProxyType({})


class Known(NamedTuple):
    """What messages are held against.

    Attributes:
        map_frame: Name of the frame `map` in messages.
        robots: How many robots the swarm has.
        swarm: The number that messages of many robots name it by, see `swarm_key`.
    """

    map_frame: str
    robots: int
    swarm: int


class Channel(Protocol):
    """All topics of one kind."""

    def frame_id(self, topic: int) -> str:
        """Frame of the newest message on a topic, "" before the first."""

    def read(self, batch: MessageBatch, robot: IntArray) -> Read:
        """Read messages (n,) in order of arrival, which came on the topics of robots (n,)."""


class _OdometryChannel:
    """See `OdometryRows`."""

    def __init__(self, topics: int, _known: Known) -> None:
        self._reader = PoseReader(topics, decode_odometry, names=2)

    def frame_id(self, topic: int) -> str:
        return self._reader.frame_ids[topic]

    def read(self, batch: MessageBatch, robot: IntArray) -> Read:
        found = self._reader.read(batch)
        rows = OdometryRows(robot, found.stamp_ns, found.pose, batch.log_ns)
        return Read(rows if found.valid.all() else chosen(rows, found.valid), found.stamp_ns, found.valid)


class _DetectionChannel:
    """See `DetectionRows`."""

    def __init__(self, topics: int, _known: Known) -> None:
        self._reader = DetectionReader(topics)

    def frame_id(self, topic: int) -> str:
        return self._reader.frame_ids[topic]

    def read(self, batch: MessageBatch, robot: IntArray) -> Read:
        found = self._reader.read(batch)
        columns = (robot, found.stamp_ns, batch.log_ns)
        robots, stamps_ns, arrivals_ns = (np.repeat(column, found.count) for column in columns)
        return Read(
            DetectionRows(robots, stamps_ns, found.detection, arrivals_ns), found.stamp_ns, found.valid
        )


class _BrightnessChannel:
    """See `BrightnessRows`."""

    def __init__(self, topics: int, _known: Known) -> None:
        self._reader = EachReader(topics, decode_brightness)

    def frame_id(self, topic: int) -> str:
        return self._reader.frame_ids[topic]

    def read(self, batch: MessageBatch, robot: IntArray) -> Read:
        found = self._reader.read(batch)
        messages: list[BrightnessMessage] = found.messages
        readings = np.empty(len(messages), dtype=object)
        for k, message in enumerate(messages):
            readings[k] = message.readings

        def column(name: str) -> IntArray:
            return np.array([getattr(message, name) for message in messages], dtype=np.int64)

        rows = BrightnessRows(
            robot=robot[found.valid],
            stamp_ns=found.stamp_ns[found.valid],
            receiver=column("receiver"),
            transmitter=column("transmitter"),
            n=column("n"),
            power=column("power"),
            saturation=column("saturation"),
            readings=readings,
            arrival_ns=batch.log_ns[found.valid],
        )
        return Read(rows, found.stamp_ns, found.valid)


def has_heading(covariance: FloatArray) -> NDArray[np.bool_]:
    """Whether fixes with covariances (f, 3, 3) tell a heading (f,)."""
    return np.asarray((covariance[:, 2, 2] > 0.0) & (covariance[:, 2, 2] < HEADING_UNKNOWN))


class _FixChannel:
    """See `FixRows`; no heading was measured where its variance is no number, not positive, or very large."""

    def __init__(self, topics: int, known: Known) -> None:
        self._reader = EachReader(topics, decode_fix)
        self._map_frame = known.map_frame

    def frame_id(self, topic: int) -> str:
        return self._reader.frame_ids[topic]

    def read(self, batch: MessageBatch, robot: IntArray) -> Read:
        found = self._reader.read(batch)
        messages: list[FixMessage] = found.messages
        pose = np.array([message.pose for message in messages], dtype=float).reshape(-1, 3)
        covariance = np.array([message.covariance for message in messages]).reshape(-1, 3, 3)
        pose[~has_heading(covariance), 2] = np.nan
        stamp_ns, arrival_ns = found.stamp_ns[found.valid], batch.log_ns[found.valid]
        rows = FixRows(robot[found.valid], stamp_ns, pose, covariance, arrival_ns)
        at_home = np.array([m.frame_id == self._map_frame for m in messages], dtype=bool)
        foreign = {FOREIGN_FRAME: int(np.sum(~at_home))}
        return Read(chosen(rows, at_home), found.stamp_ns, found.valid, foreign)


class _AerialChannel:
    """See `AerialRows`."""

    def __init__(self, topics: int, known: Known) -> None:
        self._reader = EachReader(topics, decode_anonymous)
        self._map_frame = known.map_frame

    def frame_id(self, topic: int) -> str:
        return self._reader.frame_ids[topic]

    def read(self, batch: MessageBatch, robot: IntArray) -> Read:
        found = self._reader.read(batch)
        messages: list[AnonymousMessage] = found.messages
        foreign = np.array([m.frame_id != self._map_frame for m in messages], dtype=bool)
        too_many = np.array([m.detections.size > MAX_ANONYMOUS for m in messages], dtype=bool) & ~foreign
        kept = np.flatnonzero(~foreign & ~too_many)
        sizes = [messages[k].detections.size for k in kept]
        detections = np.concatenate([np.zeros(0, ANONYMOUS_DTYPE), *(messages[k].detections for k in kept)])
        rows = AerialRows(
            robot=np.repeat(robot[found.valid][kept], sizes),
            stamp_ns=np.repeat(found.stamp_ns[found.valid][kept], sizes),
            number=np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(size) for size in sizes)]),
            pose=np.column_stack([detections["x"], detections["y"], detections["theta"]]).astype(float),
            covariance=detections["covariance"].astype(float),
            arrival_ns=np.repeat(batch.log_ns[found.valid][kept], sizes),
        )
        dropped = {FOREIGN_AERIAL_FRAME: int(foreign.sum()), TOO_MANY: int(too_many.sum())}
        return Read(rows, found.stamp_ns, found.valid, dropped)


CreateChannel = Callable[[int, Known], Channel]

CHANNELS: dict[InputKind, CreateChannel] = {
    InputKind.ODOMETRY: _OdometryChannel,
    InputKind.DETECTIONS: _DetectionChannel,
    InputKind.BRIGHTNESS: _BrightnessChannel,
    InputKind.FIXES: _FixChannel,
    InputKind.AERIAL: _AerialChannel,
}
"""How each kind of a robot's own topics is read; made from the number of topics and what is known."""
