"""Decode messages that carry what many robots have sent; one bad reading does not take the others with it."""

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

MAX_READINGS = 100_000
"""A message with more readings is dropped whole: no swarm sends so many at once."""
MAX_OF_ONE = 1_000
"""One with more of the same robot is dropped whole, too: as many as of its own topic wait for a tick."""
TOO_MANY = "shared_too_many"
"""Why such a message is dropped."""
OTHER_SWARM = "other_swarm"
"""Why readings are dropped whose sender has robots other than these, or in another order."""
UNKNOWN_ROBOT = "unknown_robot"
"""Why a reading is dropped whose index is no robot's."""
BAD_STAMP = "bad_stamp"
"""Why one is whose stamp has a second and more of nanoseconds."""

FOREIGN_FRAME = "fix_frame"
"""Why a reading that is not in `map` is dropped."""


class SharedColumns(NamedTuple):
    """What messages (n,) with readings of many robots hold.

    Attributes:
        stamp_ns: (n,) their stamps.
        valid: (n,) whether the bytes were a whole message of the type.
        rows: The readings.
        dropped: Reason -> how many readings were whole, but cannot be used.
    """

    stamp_ns: IntArray
    valid: NDArray[np.bool_]
    rows: Any
    dropped: Mapping[str, int]


class SharedReader:
    """Decodes messages with readings of many robots each.

    Args:
        topics: How many.
        known: The swarm.
        decode: Reads a message.
        rows_of: Makes rows of readings and their arrivals (n,).
        nothing: No rows.
        in_map: Whether readings must be in the frame `map`.
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
        """Why no reading of a message can be used; "" when they can."""
        if message.swarm != self._known.swarm:
            return OTHER_SWARM
        robot = message.robot[message.robot < self._known.robots]
        if message.robot.size > MAX_READINGS or np.bincount(robot).max(initial=0) > MAX_OF_ONE:
            return TOO_MANY
        return FOREIGN_FRAME if self._in_map and message.frame_id != self._known.map_frame else ""

    def _sound(self, rows: Any, dropped: Counter[str]) -> Any:
        """The readings of known robots with valid stamps; the others are counted."""
        unknown, unstamped = rows.robot >= self._known.robots, rows.stamp_ns < 0
        dropped[UNKNOWN_ROBOT] += int(np.sum(unknown))
        dropped[BAD_STAMP] += int(np.sum(unstamped & ~unknown))
        return chosen(rows, ~(unknown | unstamped))


def _shared_columns(
    found: SharedColumns, _batch: MessageBatch, _robot: IntArray, _known: Known
) -> tuple[Any, Mapping[str, int]]:
    """The readings that a `SharedReader` found."""
    return found.rows, found.dropped


def shared_kind(
    own: InputKind,
    topic: str,
    message_type: str,
    decode: Callable[[bytes], SharedMessage],
    rows_of: Callable[[SharedMessage, IntArray], Any],
    nothing: Any,
) -> InputKind:
    """The kind of a topic that carries the readings of many robots in place of their own topics.

    Args:
        own: The kind of a robot's own topics.
        topic: Its whole name.
        message_type: Of its messages.
        decode: Reads a message.
        rows_of: Makes rows of readings and their arrivals (n,).
        nothing: No rows.
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
        stands_for=own.name,
    )
