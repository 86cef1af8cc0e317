"""Out-of-sequence measurements: rollback to checkpoints and re-fusion.

States after some of the steps are stored as checkpoints. A late measurement rolls the filter back to the
last checkpoint before it, and all later steps are repeated; the result equals that of in-order arrival.
`state_period_s` assigns measurements to the closest stored state instead, as the e-puck paper (V-B) does.

Buffer of measurements sorted by stamp, into which late measurements are merged.

The order does not depend on the order of arrival: measurements with equal stamps are sorted by all their
fields. Measurements equal in all bits are duplicates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.filter.measurement_model import MEASUREMENT_DTYPE, Kind, MeasurementArray
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.timeline.settings import Settings, end_of_period, middle_of_period
from swarm_loc_estimator.timeline.verdicts import Verdict

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


Step = Callable[[SwarmState, MeasurementArray, NDArray[np.uint8], FloatArray], None]
HasBudget = Callable[[], bool]  # Returns True if there is time for another step

_CHECKPOINTS = 40
_FORGOTTEN_AT_ONCE = 4
_BEFORE_ALL, _AFTER_ALL = np.iinfo(np.int64).min, np.iinfo(np.int64).max


@dataclass(frozen=True)
class _Checkpoint:
    """State after the step `key`."""

    key: int
    state: SwarmState


class Timeline:
    """Buffered measurements with their verdicts, and the newest state.

    Args:
        settings: Horizon and periods of the steps.
        step: Fuses the measurements of one step into a state, see `Fusion.step`.
        state: Initial state.
        lookback_ns: Maximum time before its stamp at which late odometry may change measurements, which are
            kept longer than the horizon by this time.

    Attributes:
        state: Newest complete state.
        is_busy: True if the last `advance` left steps to compute.
    """

    def __init__(self, settings: Settings, step: Step, state: SwarmState, lookback_ns: int) -> None:
        self._step = step
        self._horizon_ns = round(settings.horizon_s * 1e9)
        self._state_period_ns = round(settings.state_period_s * 1e9)
        self._fusion_period_ns = round(settings.fusion_period_s * 1e9)
        waits = self._fusion_period_ns and state.tracked.size >= settings.policy.delay_from
        self._fusion_delay_ns = round(settings.fusion_delay_s * 1e9) if waits else None
        self._kept_ns = self._horizon_ns + lookback_ns
        self._spacing_ns = self._kept_ns // _CHECKPOINTS
        self.restart(state)

    def restart(self, state: SwarmState) -> None:
        """Drop all measurements and continue from `state`."""
        self.state = self._ahead = state
        self.is_busy = False
        self._head_key = _BEFORE_ALL
        self._checkpoints = [_Checkpoint(_BEFORE_ALL, state.copy())]
        self._new: list[MeasurementArray] = []
        self._withdrawn: list[MeasurementArray] = []
        self._redo_from_ns: int | None = None
        self._buffer = MeasurementBuffer()
        self.settled: NDArray[np.int64] = np.zeros(len(Verdict), dtype=np.int64)
        self.duplicates = 0
        self.too_old = 0

    @property
    def measurements(self) -> MeasurementArray:
        """Measurements (m,) within the horizon, sorted by stamp."""
        return self._buffer.measurements

    @property
    def verdicts(self) -> NDArray[np.uint8]:
        """Verdicts (m,) of the measurements."""
        return self._buffer.verdicts

    @property
    def nis(self) -> FloatArray:
        """Normalized innovation squared (m,) of the measurements."""
        return self._buffer.nis

    def add(self, measurements: MeasurementArray) -> None:
        """Add measurements (m,), to be fused by the next `advance`."""
        if measurements.size:
            self._new.append(measurements)

    def withdraw(self, measurements: MeasurementArray) -> None:
        """Remove measurements (m,) added before, and undo their effect at the next `advance`."""
        if measurements.size:
            self._withdrawn.append(measurements)

    @property
    def waiting(self) -> int:
        """Number of measurements waiting for the next `advance`."""
        return sum(measurements.size for measurements in self._new)

    def oldest_due_ns(self, otherwise_ns: int) -> int:
        """Stamp of the oldest measurement left to fuse, at most `otherwise_ns`."""
        due_ns = [otherwise_ns] if self._redo_from_ns is None else [otherwise_ns, self._redo_from_ns]
        due_ns += self._buffer.stamp_ns[self._count_until(self._head_key) :][:1].tolist()
        return min(due_ns)

    def invalidate(self, changed_from_ns: NDArray[np.int64]) -> None:
        """Mark steps of robots with changed tracks to be computed again.

        Args:
            changed_from_ns: (N,) instant after which each robot's track has changed.
        """
        rows = self._buffer.measurements
        first = _first_touched(
            self._buffer.stamp_ns, rows["observer"], rows["target"], changed_from_ns, self._fusion_period_ns
        )
        if first < len(self._buffer):
            self._redo_from(int(self._buffer.stamp_ns[first]))

    def verdict_counts(self) -> NDArray[np.int64]:
        """Number of measurements by verdict (len(Verdict),) since the last restart."""
        return self.settled + np.bincount(self.verdicts, minlength=len(Verdict))

    def advance(self, now_ns: int, has_budget: HasBudget = lambda: True) -> None:
        """Compute all steps affected by new or changed data, and drop data beyond the horizon.

        A large swarm fuses a period `fusion_delay_s` after its end, when most of its data have arrived. When
        `has_budget` returns False after a step, the next calls continue; new data wait until all is done.
        """
        if not self.is_busy:
            if self._new:
                self._merge(now_ns - self._horizon_ns)
            if self._withdrawn:
                self._remove(now_ns - self._horizon_ns)
            if self._redo_from_ns is not None:
                self._go_back(self._key(self._redo_from_ns))
                self._redo_from_ns = None
        due_ns = _AFTER_ALL if self._fusion_delay_ns is None else now_ns - self._fusion_delay_ns
        self.is_busy = not self._compute(due_ns, has_budget)
        if not self.is_busy:
            self.state = self._ahead
            self._forget_before(self._key(self.oldest_due_ns(now_ns - self._kept_ns)))

    def _key(self, stamp_ns: int) -> int:
        """Key of a stamp's step: the last stamp that belongs to the step."""
        return end_of_period(stamp_ns, self._fusion_period_ns) if self._fusion_period_ns else stamp_ns

    def _count_until(self, key: int) -> int:
        """Number of measurements in steps up to `key`."""
        return int(self._buffer.stamp_ns.searchsorted(key, side="right"))

    def _redo_from(self, stamp_ns: int) -> None:
        """Mark the step of a stamp and all later ones for the next `advance`."""
        self._redo_from_ns = stamp_ns if self._redo_from_ns is None else min(stamp_ns, self._redo_from_ns)

    def _merge(self, oldest_ns: int) -> None:
        """Merge new measurements into the buffer."""
        count, new = self.waiting, self._not_older(self._new, oldest_ns)
        self._new = []
        self.too_old += count - new.size
        merged = self._buffer.merge(new)
        self.duplicates += merged.duplicates
        if merged.first_ns is not None:
            self._redo_from(merged.first_ns)

    def _remove(self, oldest_ns: int) -> None:
        """Remove withdrawn measurements, unless their replacements were rejected as too old."""
        gone, self._withdrawn = self._not_older(self._withdrawn, oldest_ns), []
        first_ns = self._buffer.remove(gone)
        if first_ns is not None:
            self._redo_from(first_ns)

    def _not_older(self, parts: list[MeasurementArray], oldest_ns: int) -> MeasurementArray:
        """Select measurements (m,) whose stamps are not older than an instant.

        With `state_period_s`, stamps are rounded to the closest stored state.
        """
        rows, period = parts[0] if len(parts) == 1 else np.concatenate(parts), self._state_period_ns
        fresh = rows["stamp_ns"] >= oldest_ns
        if not fresh.all():
            rows = rows[fresh]
        if period:
            rows = rows.copy()
            stamp_ns = rows["stamp_ns"]  # detections of different aerial images must not be mixed
            nearest_ns = (stamp_ns + period // 2) // period * period
            rows["stamp_ns"] = np.where(rows["kind"] == Kind.ANONYMOUS, stamp_ns, nearest_ns)
        return rows

    def _go_back(self, key: int) -> None:
        """Roll back to the last checkpoint before step `key`, unless `key` is ahead."""
        if key <= self._head_key:
            while self._checkpoints[-1].key >= key:
                self._checkpoints.pop()
            self._head_key = self._checkpoints[-1].key
            self._ahead = self._checkpoints[-1].state.copy()

    def _compute(self, due_ns: int, has_budget: HasBudget) -> bool:
        """Compute steps that end until `due_ns` within the budget; return whether all are done."""
        buffer, begin = self._buffer, self._count_until(self._head_key)
        while begin < len(buffer):
            end = self._end_of_steps(begin)
            key = self._key(int(buffer.stamp_ns[end - 1]))
            if key > due_ns:
                break
            rows = slice(begin, end)
            self._step(self._ahead, buffer.measurements[rows], buffer.verdicts[rows], buffer.nis[rows])
            self._head_key = key
            if key - max(self._checkpoints[-1].key, -(2**62)) >= self._spacing_ns:
                self._checkpoints.append(_Checkpoint(key, self._ahead.copy()))
            begin = end
            if begin < len(buffer) and not has_budget():
                return False
        return True

    def _end_of_steps(self, begin: int) -> int:
        """End of the run of steps from `begin` to the next checkpoint, which are computed together."""
        stamps_ns, length_ns = self._buffer.stamp_ns, self._fusion_period_ns or self._spacing_ns
        last_ns = end_of_period(int(stamps_ns[begin]), length_ns)
        return (
            stamps_ns.size if stamps_ns[-1] <= last_ns else int(stamps_ns.searchsorted(last_ns, side="right"))
        )

    def _forget_before(self, key: int) -> None:
        """Drop data before step `key`, except one checkpoint and the measurements after it."""
        older = 0
        while older < len(self._checkpoints) and self._checkpoints[older].key < key:
            older += 1
        if older < _FORGOTTEN_AT_ONCE:
            return
        del self._checkpoints[: older - 1]
        passed = self._count_until(self._checkpoints[0].key)
        self.settled += np.bincount(self.verdicts[:passed], minlength=len(Verdict))
        self._buffer.drop_first(passed)


@cached_njit
def _first_touched(
    stamps_ns: NDArray[np.int64],
    observers: NDArray[np.int64],
    targets: NDArray[np.int64],
    changed_from_ns: NDArray[np.int64],
    period_ns: int,
) -> int:
    """First measurement (of m, by stamp) of a robot whose track (of N) changed before it; m if none.

    Changes before the prediction instant of its period count too. An anonymous detection may be of any
    robot.
    """
    if not stamps_ns.size:
        return 0
    earliest_ns = max(changed_from_ns.min(), stamps_ns[0] - 1) - period_ns
    for k in range(np.searchsorted(stamps_ns, earliest_ns, side="right"), stamps_ns.size):
        if observers[k] < 0 and targets[k] < 0:
            return k
        lookback_ns = stamps_ns[k]
        if period_ns:
            lookback_ns = max(lookback_ns, middle_of_period(stamps_ns[k], period_ns))
        for robot in (observers[k], targets[k]):
            if robot >= 0 and lookback_ns > changed_from_ns[robot]:
                return k
    return stamps_ns.size
