"""A buffer of measurements in the order of their stamps, into which late ones are merged.

The order is that of the stamps and does not depend on that of arrival, not even among measurements that share
a stamp: these are ordered by all their numbers. What is equal to the last bit is a repetition.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.filter.measurement_model import MEASUREMENT_DTYPE, MeasurementArray

_WORDS = MEASUREMENT_DTYPE.itemsize // 8  # every field is made of 8-byte numbers, the stamp is the first


_FIRST = (
    "stamp_ns",
    "observer",
    "target",
    "marker_id",
    "command",
    "kind",
    "covariance",
    "alternative",
    "value",
)
"""Fields that order measurements of one stamp before all others."""


def _words_in_order() -> tuple[IntArray, NDArray[np.bool_]]:
    """All words (w,), the weightiest first, and (w,) whether each is a float."""
    fields: Any = MEASUREMENT_DTYPE.fields
    words: list[int] = []
    floats: list[bool] = []
    for name in [*_FIRST, *(name for name in fields if name not in _FIRST)]:
        field, begin = fields[name][:2]
        places = range(begin // 8, (begin + field.itemsize) // 8)
        words += reversed(places)
        floats += [field.base.kind == "f"] * len(places)
    return np.array(words, dtype=np.int64), np.array(floats, dtype=bool)


_ORDER, _IS_FLOAT = _words_in_order()
_FIRST_CAPACITY = 1024
_Columns = tuple[IntArray, IntArray, NDArray[np.uint8], FloatArray]
"""Rows as words (n, w), their stamps (n,), verdicts and normalised innovations squared."""


class Merged(NamedTuple):
    """What `MeasurementBuffer.merge` did.

    Attributes:
        first_ns: Stamp of the first measurement that was not there yet; None when there is none.
        duplicates: Repetitions.
    """

    first_ns: int | None
    duplicates: int


class MeasurementBuffer:
    """Measurements that come and go like a queue, but may enter anywhere.

    What was computed of a measurement goes with it; of new ones nothing is as yet.
    """

    def __init__(self) -> None:
        self._begin = self._end = 0
        self._allocate(_FIRST_CAPACITY)

    def __len__(self) -> int:
        return self._end - self._begin

    @property
    def stamp_ns(self) -> IntArray:
        """(m,) not decreasing."""
        return self._stamp_ns[self._begin : self._end]

    @property
    def measurements(self) -> MeasurementArray:
        """(m,) of MEASUREMENT_DTYPE in order."""
        return self._rows[self._begin : self._end]

    @property
    def verdicts(self) -> NDArray[np.uint8]:
        """(m,) to be written."""
        return self._verdicts[self._begin : self._end]

    @property
    def nis(self) -> FloatArray:
        """(m,) to be written."""
        return self._nis[self._begin : self._end]

    def merge(self, new: MeasurementArray) -> Merged:
        """Sort measurements (k,) in."""
        self._make_room(new.size)
        words = np.ascontiguousarray(new).view(np.int64).reshape(-1, _WORDS)
        columns = self._words, self._stamp_ns, self._verdicts, self._nis
        count, first_ns = _merge(columns, self._begin, self._end, words)
        self._end += count
        return Merged(first_ns if count else None, new.size - count)

    def remove(self, gone: MeasurementArray) -> int | None:
        """Take measurements (k,) out; return the stamp of the first that was there, None when none was."""
        words = np.ascontiguousarray(gone).view(np.int64).reshape(-1, _WORDS)
        first_ns = None
        for one in words[np.argsort(words[:, 0], kind="stable")]:
            place = _lower_bound(self._words, self._stamp_ns, self._begin, self._end, one)
            if place == self._end or _compared(self._words[place], one) != 0:
                continue
            first_ns = int(one[0]) if first_ns is None else first_ns
            for column in (self._words, self._stamp_ns, self._verdicts, self._nis):
                column[place : self._end - 1] = column[place + 1 : self._end].copy()
            self._end -= 1
        return first_ns

    def drop_first(self, count: int) -> None:
        """Forget the oldest ones."""
        self._begin += count

    def _allocate(self, capacity: int) -> None:
        self._words = np.zeros((capacity, _WORDS), dtype=np.int64)
        self._rows: MeasurementArray = self._words.view(MEASUREMENT_DTYPE)[:, 0]
        self._stamp_ns = np.zeros(capacity, dtype=np.int64)
        self._verdicts = np.zeros(capacity, dtype=np.uint8)
        self._nis: FloatArray = np.full(capacity, np.nan)

    def _make_room(self, count: int) -> None:
        """Have space for so many more: those forgotten give theirs back, or all becomes twice as large."""
        if self._end + count <= self._stamp_ns.size:
            return
        size, old = len(self), slice(self._begin, self._end)
        words, stamp_ns = self._words[old].copy(), self._stamp_ns[old].copy()
        verdicts, nis = self._verdicts[old].copy(), self._nis[old].copy()
        if 2 * (size + count) > self._stamp_ns.size:
            self._allocate(4 * (size + count))
        self._words[:size], self._stamp_ns[:size] = words, stamp_ns
        self._verdicts[:size], self._nis[:size] = verdicts, nis
        self._begin, self._end = 0, size


@cached_njit
def _merge(columns: _Columns, begin: int, end: int, new: IntArray) -> tuple[int, int]:
    """Merge new rows into those from `begin` to `end`, which have room behind.

    Returns:
        How many it has more now, and the stamp of the first one it has more.
    """
    rows, stamps_ns, verdicts, nis = columns
    order = np.argsort(new[:, 0], kind="mergesort")
    for k in range(1, order.size):  # those that share a stamp
        row, place = order[k], k
        while place > 0 and _compared(new[row], new[order[place - 1]]) < 0:
            order[place] = order[place - 1]
            place -= 1
        order[place] = row
    kept = 0
    for k in range(order.size):
        row = order[k]
        if kept and _compared(new[row], new[order[kept - 1]]) == 0:
            continue
        place = _lower_bound(rows, stamps_ns, begin, end, new[row])
        if place < end and _compared(rows[place], new[row]) == 0:
            continue
        order[kept] = row
        kept += 1
    old, place = end - 1, end + kept - 1
    for k in range(kept - 1, -1, -1):
        row = order[k]
        while old >= begin and _compared(new[row], rows[old]) < 0:
            _copy(rows[place], rows[old])
            stamps_ns[place], verdicts[place], nis[place] = stamps_ns[old], verdicts[old], nis[old]
            old -= 1
            place -= 1
        _copy(rows[place], new[row])
        stamps_ns[place], verdicts[place], nis[place] = new[row, 0], 0, math.nan
        place -= 1
    return kept, new[order[0], 0] if kept else 0


@cached_njit
def _lower_bound(rows: IntArray, stamps_ns: IntArray, begin: int, end: int, one: IntArray) -> int:
    """The first place in rows[begin:end] that does not come before a row."""
    place: int = begin + np.searchsorted(stamps_ns[begin:end], one[0])
    while place < end and _compared(rows[place], one) < 0:
        place += 1
    return place


@cached_njit
def _compared(one: IntArray, other: IntArray) -> int:
    """-1 when one row comes before the other, 1 when behind it, 0 when they are equal."""
    for k in range(_ORDER.size):
        a, b = one[_ORDER[k]], other[_ORDER[k]]
        if a != b:
            both_negative = _IS_FLOAT[k] and a < 0 and b < 0  # a float's sign stands apart from its size
            return -1 if (a < b) != both_negative else 1
    return 0


@cached_njit
def _copy(target: IntArray, source: IntArray) -> None:
    for i in range(target.size):
        target[i] = source[i]
