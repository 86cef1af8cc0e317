"""Decoding of messages with readings of many robots; an invalid reading does not affect the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.messages.cdr import CdrError
from swarm_loc_estimator.common.messages.detections import SharedMessage
from swarm_loc_estimator.common.messages.message_batch import MessageBatch
from swarm_loc_estimator.sensors.sensor import InputKind, Known, chosen, joined

MAX_READINGS = 100_000  # Maximum number of readings per message; larger messages are dropped
MAX_OF_ONE = 1_000  # Maximum number of readings of one robot per message, equal to the queue of its own topic
TOO_MANY = "shared_too_many"  # Reason to drop messages beyond these limits
OTHER_SWARM = "other_swarm"  # Reason to drop readings of a sender with another list of robots
UNKNOWN_ROBOT = "unknown_robot"  # Reason to drop a reading with an invalid robot index
BAD_STAMP = "bad_stamp"  # Reason to drop a reading with 10^9 or more nanoseconds in its stamp

FOREIGN_FRAME = "fix_frame"  # Reason to drop a reading that is not in the frame `map`


class SharedColumns(NamedTuple):
    """Decoded messages (n,) with readings of many robots."""

    stamp_ns: IntArray  # (n,) stamps of the messages
    valid: NDArray[np.bool_]  # (n,) True if the message is complete and of the right type
    rows: Any  # The readings
    dropped: Mapping[str, int]  # Number of unusable readings of valid messages by reason


class SharedReader:
    """Decodes messages with readings of many robots each.

    Args:
        topics: Number of topics.
        known: Expected contents.
        decode: Decodes a message.
        rows_of: Converts a message and arrivals (n,) to readings.
        nothing: Empty readings.
        in_map: True if readings must be in the frame `map`.
    """

    def __init__(
        self,
        topics: int,
        known: Known,
        *,
        decode: Callable[[bytes], SharedMessage],
        rows_of: Callable[[SharedMessage, IntArray], Any],
        nothing: Any,
        in_map: bool = False,
    ) -> None:
        self._known = known
        self._decode = decode
        self._rows_of = rows_of
        self._nothing = nothing
        self._in_map = in_map
        self.frame_ids = [""] * topics

    def read(self, batch: MessageBatch) -> SharedColumns:
        """Decode messages (n,) in order of arrival."""
        stamp_ns, valid = np.zeros(batch.size, dtype=np.int64), np.ones(batch.size, dtype=bool)
        parts = [self._nothing]
        dropped: Counter[str] = Counter()
        for k, (topic, arrival_ns, data) in enumerate(batch.messages()):
            try:
                message = self._decode(data)
            except CdrError:
                valid[k] = False
                continue
            stamp_ns[k], self.frame_ids[topic] = message.stamp_ns, message.frame_id
            if fault := self._fault(message):
                dropped[fault] += message.robot.size
            else:
                rows = self._rows_of(message, np.full(message.robot.size, arrival_ns))
                parts.append(self._sound(rows, dropped))
        return SharedColumns(stamp_ns, valid, joined(parts), +dropped)

    def _fault(self, message: SharedMessage) -> str:
        """Reason to drop all readings of a message; "" if there is none."""
        if message.swarm != self._known.swarm:
            return OTHER_SWARM
        robot = message.robot[message.robot < self._known.robots]
        if message.robot.size > MAX_READINGS or np.bincount(robot).max(initial=0) > MAX_OF_ONE:
            return TOO_MANY
        return FOREIGN_FRAME if self._in_map and message.frame_id != self._known.map_frame else ""

    def _sound(self, rows: Any, dropped: Counter[str]) -> Any:
        """Select readings of known robots with valid stamps; count the others in `dropped`."""
        unknown, unstamped = rows.robot >= self._known.robots, rows.stamp_ns < 0
        dropped[UNKNOWN_ROBOT] += int(np.sum(unknown))
        dropped[BAD_STAMP] += int(np.sum(unstamped & ~unknown))
        return chosen(rows, ~(unknown | unstamped))


def _shared_columns(
    found: SharedColumns, _batch: MessageBatch, _robot: IntArray, _known: Known
) -> tuple[Any, Mapping[str, int]]:
    """Readings and drop counts of a `SharedReader`."""
    return found.rows, found.dropped


def shared_kind(
    own: InputKind,
    topic: str,
    message_type: str,
    decode: Callable[[bytes], SharedMessage],
    rows_of: Callable[[SharedMessage, IntArray], Any],
    nothing: Any,
) -> InputKind:
    """Create the kind of a topic with readings of many robots, which replaces their own topics.

    Args:
        own: Kind of the replaced topics.
        topic: Full name of the topic.
        message_type: Message type.
        decode: Decodes a message.
        rows_of: Converts a message and arrivals (n,) to readings.
        nothing: Empty readings.
    """
    return replace(
        own,
        name=f"swarm_{own.name}",
        topic=topic,
        message_type=message_type,
        create_reader=partial(
            SharedReader, decode=decode, rows_of=rows_of, nothing=nothing, in_map=own.in_map
        ),
        columns_of=_shared_columns,
        of_each=False,
        of_cameras=False,
        stands_for=own.name,
    )
