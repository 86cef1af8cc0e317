"""Many serialized messages at once: one buffer, and columns with the place of each message in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.common.arrays import IntArray

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


class SerializedMessage(NamedTuple):
    """One serialized message: number of its topic, bytes, and when it was recorded or arrived [ns]."""

    topic: int
    data: bytes
    log_ns: int


class MessageBatch(NamedTuple):
    """Messages (n,) of several topics."""

    data: npt.NDArray[np.uint8]  # (b,) bytes, read-only
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

    def chosen(self, rows: slice | npt.NDArray[np.intp] | npt.NDArray[np.bool_]) -> MessageBatch:
        """Some of them, in the same buffer."""
        return MessageBatch(
            self.data, self.topic[rows], self.log_ns[rows], self.offset[rows], self.length[rows]
        )

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
