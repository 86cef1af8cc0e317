"""Buffer of measurements sorted by stamp, into which late measurements are merged.

The order does not depend on the order of arrival: measurements with equal stamps are sorted by all their
fields. Measurements equal in all bits are duplicates.
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
"""First sort keys of measurements with equal stamps."""


def _words_in_order() -> tuple[IntArray, NDArray[np.bool_]]:
    """Indices (w,) of all words, most significant sort key first, and (w,) True for floats."""
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
"""Rows as words (n, w), their stamps (n,), verdicts and normalized innovations squared."""


class Merged(NamedTuple):
    """Result of `MeasurementBuffer.merge`."""

    first_ns: int | None  # Stamp of the first new measurement; None if there is none
    duplicates: int  # Number of duplicates


class MeasurementBuffer:
    """Sorted queue of measurements: removed at the front, inserted anywhere.

    Verdicts and NIS move with their measurements; those of new measurements are OPEN and NaN.
    """

    def __init__(self) -> None:
        self._begin = self._end = 0
        self._allocate(_FIRST_CAPACITY)

    def __len__(self) -> int:
        return self._end - self._begin

    @property
    def stamp_ns(self) -> IntArray:
        """Stamps (m,), sorted."""
        return self._stamp_ns[self._begin : self._end]

    @property
    def measurements(self) -> MeasurementArray:
        """Measurements (m,) of MEASUREMENT_DTYPE, sorted."""
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
        """Insert measurements (k,)."""
        self._make_room(new.size)
        words = np.ascontiguousarray(new).view(np.int64).reshape(-1, _WORDS)
        columns = self._words, self._stamp_ns, self._verdicts, self._nis
        count, first_ns = _merge(columns, self._begin, self._end, words)
        self._end += count
        return Merged(first_ns if count else None, new.size - count)

    def remove(self, gone: MeasurementArray) -> int | None:
        """Remove measurements (k,); return the stamp of the first one found, None if none was found."""
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
        """Remove the oldest measurements."""
        self._begin += count

    def _allocate(self, capacity: int) -> None:
        self._words = np.zeros((capacity, _WORDS), dtype=np.int64)
        self._rows: MeasurementArray = self._words.view(MEASUREMENT_DTYPE)[:, 0]
        self._stamp_ns = np.zeros(capacity, dtype=np.int64)
        self._verdicts = np.zeros(capacity, dtype=np.uint8)
        self._nis: FloatArray = np.full(capacity, np.nan)

    def _make_room(self, count: int) -> None:
        """Reserve space for `count` rows: reuse that of removed rows, or double the capacity."""
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
    """Merge new rows into rows `begin` to `end`; space behind them must be reserved.

    Returns:
        Number of inserted rows, and the stamp of the first one.
    """
    rows, stamps_ns, verdicts, nis = columns
    order = np.argsort(new[:, 0], kind="mergesort")
    for k in range(1, order.size):  # sort rows with equal stamps
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
    """Index of the first row in rows[begin:end] that is not less than a row."""
    place: int = begin + np.searchsorted(stamps_ns[begin:end], one[0])
    while place < end and _compared(rows[place], one) < 0:
        place += 1
    return place


@cached_njit
def _compared(one: IntArray, other: IntArray) -> int:
    """Compare two rows: -1 if `one` is less than `other`, 1 if greater, 0 if equal."""
    for k in range(_ORDER.size):
        a, b = one[_ORDER[k]], other[_ORDER[k]]
        if a != b:
            both_negative = _IS_FLOAT[k] and a < 0 and b < 0  # floats are sign and magnitude
            return -1 if (a < b) != both_negative else 1
    return 0


@cached_njit
def _copy(target: IntArray, source: IntArray) -> None:
    for i in range(target.size):
        target[i] = source[i]
