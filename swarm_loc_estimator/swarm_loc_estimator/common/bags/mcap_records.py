"""The records of an MCAP file: unpacking a chunk, and finding the messages in it.

Format: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.bags.bag_file import MAX_LOG_NS
from swarm_loc_estimator.common.jit import cached_njit

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # Opcode and length
MESSAGE_HEAD = 22  # Bytes of channel, sequence, log time and publish time
OPCODES = frozenset({*map(int, Opcode), *range(0x80, 0x100)})
"""Of records; the last ones are applications' own, to be skipped."""
UNWANTED, UNKNOWN = -1, -2  # In place of the number of a topic: it is not asked for, or the channel has none
MAX_CHUNK = 1 << 30  # Unpacked chunks are at most so large [byte]; writers close them at a megabyte or so

_HEAD = struct.Struct("<QQQII")  # first and last time, size, checksum, length of the compression's name
_LENGTH = struct.Struct("<Q")
_RECORD_HEAD = RECORD.size
_IS_MESSAGE = int(Opcode.MESSAGE)
_STEP = 1 << 20


@dataclass
class Chunk:
    """Where a run of messages lies, and how to unpack it."""

    record: int  # Where its record begins
    offset: int  # Where its content begins
    stored: int  # How long that is
    first_ns: int  # Log time of its first message
    last_ns: int  # Log time of its last message
    compression: str = ""  # "", "zstd" or "lz4"
    size: int = 0  # Length of the content unpacked
    checksum: int = 0  # CRC32 of the content unpacked; 0: none
    whole: bool = True  # Whether nothing of it was cut off
    is_run: bool = False  # Whether its messages lie in no chunk, but one behind the other in the file


class MessageScan(NamedTuple):
    """How far the messages of a chunk were read."""

    wanted: int  # Messages of the topics that are asked for, those before included
    others: int  # Messages of other topics
    unknown: int  # Messages of channels without a topic
    untimed: int  # Messages whose log time cannot be
    offset: int  # Behind the last message


def parse_chunk(head: bytes, begin: int, length: int, *, whole: bool) -> Chunk | None:
    """What the head of a chunk's record says, whose content begins at `begin`; None: it is damaged."""
    if len(head) < _HEAD.size:
        return None
    first_ns, last_ns, size, checksum, name_length = _HEAD.unpack_from(head)
    behind_name = _HEAD.size + name_length
    if behind_name + _LENGTH.size > len(head):
        return None
    compression = head[_HEAD.size : behind_name].decode("ascii", "replace")
    (stored,) = _LENGTH.unpack_from(head, behind_name)
    data = behind_name + _LENGTH.size
    stored = min(stored, length - data)
    return Chunk(
        begin - RECORD.size, begin + data, stored, first_ns, last_ns, compression, size, checksum, whole
    )


def unpack(stored: bytes, chunk: Chunk) -> bytes:
    """The records of a chunk, one byte more than it should hold at most; of one cut off, what can be had.

    Raises:
        ValueError, RuntimeError, zstandard.ZstdError: It is damaged.
    """
    if chunk.compression == "" or chunk.is_run:
        return stored
    if chunk.size > MAX_CHUNK:
        raise ValueError(f"it should unpack to {chunk.size} bytes")
    if chunk.compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=chunk.size + 1))
    if chunk.compression != "zstd":
        raise ValueError(f"its compression {chunk.compression!r} is not known")
    data = bytearray()
    with zstandard.ZstdDecompressor().stream_reader(stored) as reader:
        while part := reader.read(min(_STEP, chunk.size + 1 - len(data))):
            data += part
    return bytes(data)


@cached_njit
def find_messages(
    data: NDArray[np.uint8], begin: int, numbers: IntArray, columns: IntArray, count: int
) -> MessageScan:
    """Note the messages from an offset on up to a record that is none, or is not whole.

    Args:
        data: Records.
        begin: Where to begin.
        numbers: Channel -> number of its topic, or UNWANTED, or UNKNOWN.
        columns: (4, n) written: topic, log time, offset and length of each message.
        count: How many stand there already.
    """
    offset, others, unknown, untimed = begin, 0, 0, 0
    while offset + _RECORD_HEAD + MESSAGE_HEAD <= data.size and data[offset] == _IS_MESSAGE:
        length = _number(data, offset + 1, 8)
        if length < MESSAGE_HEAD or length > data.size - offset - _RECORD_HEAD:
            break
        topic = numbers[_number(data, offset + _RECORD_HEAD, 2)]
        log_ns = _number(data, offset + _RECORD_HEAD + 6, 8)
        if topic == UNKNOWN:
            unknown += 1
        elif not 0 <= log_ns <= MAX_LOG_NS:
            untimed += 1
        elif topic == UNWANTED:
            others += 1
        else:
            columns[0, count] = topic
            columns[1, count] = log_ns
            columns[2, count] = offset + _RECORD_HEAD + MESSAGE_HEAD
            columns[3, count] = length - MESSAGE_HEAD
            count += 1
        offset += _RECORD_HEAD + length
    return MessageScan(count, others, unknown, untimed, offset)


@cached_njit
def _number(data: NDArray[np.uint8], offset: int, size: int) -> int:
    """A little-endian number; one beyond 63 bits is negative."""
    number: int = np.int64(0)
    for k in range(size):
        number |= np.int64(data[offset + k]) << np.int64(8 * k)
    return number
