"""Arrays that grow in a temporary file and are memory-mapped at the end."""

from __future__ import annotations

import mmap
import tempfile
import weakref
from collections.abc import Hashable
from typing import Any

import numpy as np
import numpy.typing as npt

_COPY_BYTES = 1 << 20


class Spool:
    """Rows by key in one temporary file, which is deleted with the last array that maps it.

    The rows take no memory of the process, only pages of the file that the system may drop.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="replay_")  # noqa: SIM115 # for as long as this lives
        weakref.finalize(self, self._file.close)
        self._end = 0
        self._blocks: dict[Hashable, list[tuple[int, int]]] = {}

    def append(self, key: Hashable, rows: npt.NDArray[Any]) -> None:
        """Append rows (k, ...) to those of the same key."""
        data = np.ascontiguousarray(rows).tobytes()
        blocks = self._blocks.setdefault(key, [])
        blocks.append((self._end, len(data)))
        self._file.write(data)
        self._end += len(data)

    def array(self, key: Hashable, dtype: npt.DTypeLike, *shape: int) -> npt.NDArray[Any]:
        """All rows of a key (k, *shape), read-only; the key is then empty."""
        blocks = self._blocks.pop(key, [])
        size = sum(length for _, length in blocks)
        begin = -(-self._end // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
        if not size:
            return np.zeros((0, *shape), dtype=dtype)
        self._file.seek(begin)
        self._end = begin
        for offset, length in blocks:
            self._copy(offset, length)
        self._file.flush()
        mapped = mmap.mmap(self._file.fileno(), size, access=mmap.ACCESS_READ, offset=begin)
        return np.frombuffer(mapped, dtype=dtype).reshape(-1, *shape)

    def _copy(self, offset: int, length: int) -> None:
        """Copy a block to the end of the file."""
        for start in range(offset, offset + length, _COPY_BYTES):
            self._file.seek(start)
            data = self._file.read(min(_COPY_BYTES, offset + length - start))
            self._file.seek(self._end)
            self._file.write(data)
            self._end += len(data)
