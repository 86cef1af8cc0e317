"""What rosbag2 and others compress beyond the chunks of MCAP: whole files, and single messages."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from numpy.typing import NDArray

from swarm_loc_estimator.common.bags.bag_file import BagError, ReadErrors
from swarm_loc_estimator.common.messages.message_batch import MessageBatch, SerializedMessage

if TYPE_CHECKING:
    from collections.abc import Iterator

PACKED = (".zstd", ".zst", ".lz4")  # Suffixes of compressed files, as in bag_0.db3.zstd
MAX_MESSAGE = 1 << 28  # Unpacked messages are at most so large [byte]

_STEP = 1 << 20
_MAX_BATCH = 1 << 26
_ZSTD = b"\x28\xb5\x2f\xfd"  # no message of ROS 2 begins so: its first byte is 0
_ERRORS = (zstandard.ZstdError, EOFError, RuntimeError)


def unpack_file(path: Path, folder: Path, losses: list[str]) -> Path:
    """Unpack a compressed file into a folder; of a damaged one, the part before the damage.

    Args:
        path: The file, with a suffix of `PACKED`.
        folder: Where to write.
        losses: One sentence is added about a damaged file.

    Raises:
        BagError: It is no file, or needs more than half of the free disk space.
    """
    if not path.is_file():
        raise BagError(f"{path} is no file.")  # to open a pipe would wait for ever
    unpacked, room = folder / path.stem, shutil.disk_usage(folder).free // 2
    with path.open("rb") as packed, unpacked.open("wb") as file:
        try:
            for part in _unpacked_parts(packed, path.suffix):
                room -= len(part)
                if room < 0:
                    raise BagError(f"{path} unpacks to more than half of the free space in {folder.parent}.")
                file.write(part)
        except _ERRORS as error:
            losses.append(f"{path.name}: its compression is damaged ({error}); the part before was read.")
    return unpacked


def _unpacked_parts(packed: BinaryIO, suffix: str) -> Iterator[bytes]:
    """The content of a compressed file."""
    if suffix == ".lz4":
        source = lz4.frame.LZ4FrameFile(packed)
    else:
        source = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
    while part := source.read1(_STEP):  # read would lose what stands before an early end
        yield part


def unpack_messages(batches: Iterator[MessageBatch], losses: ReadErrors) -> Iterator[MessageBatch]:
    """Unpack the messages that are compressed one by one; what cannot be unpacked is counted and left out."""
    damaged = 0
    for batch in batches:
        packed = _is_packed(batch)
        if not packed.any():
            yield batch
            continue
        messages, size = [], 0
        for is_packed, (topic, log_ns, data) in zip(packed.tolist(), batch.messages(), strict=True):
            content = _unpacked_message(data) if is_packed else data
            if content is None:
                damaged += 1
                continue
            messages.append(SerializedMessage(topic, content, log_ns))
            size += len(content)
            if size > _MAX_BATCH:
                yield MessageBatch.of(messages)
                messages, size = [], 0
        yield MessageBatch.of(messages)
    if damaged:
        losses.add(f"{damaged} messages whose compression is damaged were skipped.")


def _is_packed(batch: MessageBatch) -> NDArray[np.bool_]:
    """Whether each message (n,) begins like a zstd frame."""
    packed = batch.length >= len(_ZSTD)
    for k, byte in enumerate(_ZSTD):
        packed[packed] = batch.data[batch.offset[packed] + k] == byte
    return packed


def _unpacked_message(data: bytes) -> bytes | None:
    """An unpacked message; None if it is damaged or too large."""
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            content = reader.read(MAX_MESSAGE + 1)
    except zstandard.ZstdError:
        return None
    return content if len(content) <= MAX_MESSAGE else None
