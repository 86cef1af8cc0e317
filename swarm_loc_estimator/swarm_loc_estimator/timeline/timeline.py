"""Out-of-sequence measurements: a sorted buffer, rollback to checkpoints and re-fusion.

Measurements wait in a buffer sorted by stamp, into which late ones are merged. States after some of the steps
are stored as checkpoints. A late measurement rolls the filter back to the last checkpoint before it, and all
later steps are repeated; the result equals that of in-order arrival.

A large swarm fuses the measurements of a fusion period as one batch. A period is closed at its end, (t, t +
T]: a measurement at the instant of fusion belongs to the period that ends then.

The order does not depend on the order of arrival: measurements with equal stamps are sorted by all their
columns but the arrival. Measurements equal in all of them are duplicates.
"""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.filter.measurements import (
    Command,
    CommandKind,
    Measurements,
    Verdict,
    concatenate,
    select,
)
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.timeline.settings import Settings

Stamps = TypeVar("Stamps", int, IntArray)

_FIRST_CAPACITY = 1024


def end_of_period(stamp_ns: Stamps, period_ns: int) -> Stamps:
    """End of the period of a stamp, or of stamps (m,): the next multiple of its length."""
    return -(-stamp_ns // period_ns) * period_ns


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
        return self._columns.stamp_ns[self._begin : self._end]

    @property
    def sides(self) -> tuple[IntArray, IntArray]:
        """Observers and targets (m,)."""
        rows = slice(self._begin, self._end)
        return self._columns.observer[rows], self._columns.target[rows]

    def part(self, begin: int, end: int) -> Measurements:
        """Measurements from one index to another, sorted."""
        return select(self._columns, slice(self._begin + begin, self._begin + end))

    @property
    def verdicts(self) -> NDArray[np.uint8]:
        """(m,) to be written."""
        return self._verdicts[self._begin : self._end]

    @property
    def nis(self) -> FloatArray:
        """(m,) to be written."""
        return self._nis[self._begin : self._end]

    def merge(self, new: Measurements) -> tuple[int, int | None]:
        """Insert measurements (k,); return how many were no duplicates, and the stamp of the first."""
        self._make_room(new.size)
        count, first_ns = _merge(self._columns, self._verdicts, self._nis, self._begin, self._end, new)
        self._end += count
        return count, first_ns if count else None

    def remove(self, gone: Measurements) -> int | None:
        """Remove measurements (k,); return the stamp of the first one found, None if none was found."""
        first_ns = None
        for k in np.argsort(gone.stamp_ns, kind="stable").tolist():
            first = self._begin + int(self.stamp_ns.searchsorted(gone.stamp_ns[k]))
            place = _lower_bound(self._columns, first, self._end, gone, k)
            if place == self._end or _compared(self._columns, place, gone, k) != 0:
                continue
            first_ns = int(gone.stamp_ns[k]) if first_ns is None else first_ns
            for column in (*self._columns, self._verdicts, self._nis):
                column[place : self._end - 1] = column[place + 1 : self._end].copy()
            self._end -= 1
        return first_ns

    def drop_first(self, count: int) -> None:
        """Remove the oldest measurements."""
        self._begin += count

    def _allocate(self, capacity: int) -> None:
        self._columns = Measurements.empty(capacity)
        self._verdicts = np.zeros(capacity, dtype=np.uint8)
        self._nis: FloatArray = np.full(capacity, np.nan)

    def _make_room(self, count: int) -> None:
        """Reserve space for `count` rows: reuse that of removed rows, or double the capacity."""
        if self._end + count <= self._verdicts.size:
            return
        size = len(self)
        kept: list[Any] = [one.copy() for one in (*self.part(0, size), self.verdicts, self.nis)]
        if 2 * (size + count) > self._verdicts.size:
            self._allocate(4 * (size + count))
        columns: list[Any] = [*self._columns, self._verdicts, self._nis]
        for column, values in zip(columns, kept, strict=True):
            column[:size] = values
        self._begin, self._end = 0, size


@cached_njit
def _merge(
    columns: Measurements,
    verdicts: NDArray[np.uint8],
    nis: FloatArray,
    begin: int,
    end: int,
    new: Measurements,
) -> tuple[int, int]:
    """Merge measurements into rows with space after them; return how many, and the stamp of the first."""
    # Sort the new rows: by stamp, then those with equal stamps by all columns.
    order = np.argsort(new.stamp_ns, kind="mergesort")
    for k in range(1, order.size):
        row, place = order[k], k
        while place > 0 and _compared(new, row, new, order[place - 1]) < 0:
            order[place] = order[place - 1]
            place -= 1
        order[place] = row
    # Find their places; leave out duplicates, among themselves and of the buffer.
    kept, places = 0, begin + np.searchsorted(columns.stamp_ns[begin:end], new.stamp_ns[order])
    for k in range(order.size):
        row = order[k]
        if kept and _compared(new, row, new, order[kept - 1]) == 0:
            continue
        place = _lower_bound(columns, places[k], end, new, row)
        if place < end and _compared(columns, place, new, row) == 0:
            continue
        order[kept], places[kept] = row, place
        kept += 1
    order, places = order[:kept], places[:kept]
    # Insert column by column: a call with all columns for each row would cost more than the copies.
    _insert(columns.stamp_ns, new.stamp_ns, order, places, end, 1)
    _insert(columns.received_from, new.received_from, order, places, end, 1)
    _insert(columns.observer, new.observer, order, places, end, 1)
    _insert(columns.target, new.target, order, places, end, 1)
    _insert(columns.landmark, new.landmark, order, places, end, 1)
    _insert(columns.mount, new.mount, order, places, end, 1)
    _insert(columns.model, new.model, order, places, end, 1)
    _insert(columns.reading, new.reading, order, places, end, 1)
    _insert(columns.has_heading, new.has_heading, order, places, end, 1)
    _insert(columns.has_second, new.has_second, order, places, end, 1)
    _insert(columns.stamp_variance, new.stamp_variance, order, places, end, 1)
    _insert(columns.gate, new.gate, order, places, end, 1)
    _insert(columns.sensor.reshape(-1), new.sensor.reshape(-1), order, places, end, 3)
    _insert(columns.marker.reshape(-1), new.marker.reshape(-1), order, places, end, 3)
    _insert(columns.height.reshape(-1), new.height.reshape(-1), order, places, end, 2)
    _insert(columns.reference.reshape(-1), new.reference.reshape(-1), order, places, end, 3)
    _insert(columns.value.reshape(-1), new.value.reshape(-1), order, places, end, 3)
    _insert(columns.second.reshape(-1), new.second.reshape(-1), order, places, end, 3)
    _insert(columns.covariance.reshape(-1), new.covariance.reshape(-1), order, places, end, 9)
    _insert(columns.systematic_share.reshape(-1), new.systematic_share.reshape(-1), order, places, end, 3)
    _insert(columns.arrival_ns, new.arrival_ns, order, places, end, 1)
    _insert(verdicts, np.zeros(new.stamp_ns.size, dtype=np.uint8), order, places, end, 1)
    _insert(nis, np.full(new.stamp_ns.size, math.nan), order, places, end, 1)
    return kept, new.stamp_ns[order[0]] if kept else 0


@cached_njit
def _insert(
    column: NDArray[Any], values: NDArray[Any], order: IntArray, places: IntArray, end: int, width: int
) -> None:
    """Insert rows `order` of values before places of a column; both are flat, `width` numbers a row."""
    old = end - 1
    for k in range(order.size - 1, -1, -1):
        while old >= places[k]:
            for i in range(width):
                column[(old + k + 1) * width + i] = column[old * width + i]
            old -= 1
        for i in range(width):
            column[(places[k] + k) * width + i] = values[order[k] * width + i]


@inlined_njit
def _lower_bound(columns: Measurements, place: int, end: int, new: Measurements, k: int) -> int:
    """Index of the first row from `place` to `end` that is not less than row k of others."""
    while place < end and _compared(columns, place, new, k) < 0:
        place += 1
    return place


@inlined_njit
def _compared(a: Measurements, i: int, b: Measurements, j: int) -> int:
    """Compare row i of measurements with row j of others: -1 if it is less, 1 if greater, 0 if equal."""
    order = _sign(a.stamp_ns[i], b.stamp_ns[j]) or _sign(a.observer[i], b.observer[j])
    order = order or _sign(a.target[i], b.target[j]) or _sign(a.reading[i], b.reading[j])
    return order or _sign(a.model[i], b.model[j]) or _compared_further(a, i, b, j)


@cached_njit
def _compared_further(a: Measurements, i: int, b: Measurements, j: int) -> int:
    """The same for measurements that their first columns do not tell apart: they contradict each other."""
    order = 0
    for r in range(2, -1, -1):
        order = order or _vectors_compared(a.covariance[i, r], b.covariance[j, r])
    order = order or _vectors_compared(a.second[i], b.second[j]) or _vectors_compared(a.value[i], b.value[j])
    order = order or _sign(a.received_from[i], b.received_from[j]) or _sign(a.landmark[i], b.landmark[j])
    order = order or _sign(a.mount[i], b.mount[j]) or _sign(a.has_heading[i], b.has_heading[j])
    order = order or _sign(a.has_second[i], b.has_second[j])
    order = order or _sign(a.stamp_variance[i], b.stamp_variance[j]) or _sign(a.gate[i], b.gate[j])
    order = order or _vectors_compared(a.sensor[i], b.sensor[j])
    order = order or _vectors_compared(a.marker[i], b.marker[j])
    order = order or _vectors_compared(a.height[i], b.height[j])
    order = order or _vectors_compared(a.reference[i], b.reference[j])
    return order or _vectors_compared(a.systematic_share[i], b.systematic_share[j])


@cached_njit
def _vectors_compared(a: FloatArray, b: FloatArray) -> int:
    """Compare vectors, last components first."""
    order = 0
    for i in range(a.size - 1, -1, -1):
        order = order or _sign(a[i], b[i])
    return order


@inlined_njit
def _sign(a: float, b: float) -> int:
    return int(a > b) - int(a < b)


Step = Callable[[SwarmState, Measurements, Sequence[Command], NDArray[np.uint8], FloatArray], None]
HasBudget = Callable[[], bool]  # Returns True if there is time for another step

_CHECKPOINTS = 40
_FORGOTTEN_AT_ONCE = 4
_BEFORE_ALL, _AFTER_ALL = np.iinfo(np.int64).min, np.iinfo(np.int64).max


class Timeline:
    """Buffered measurements with their verdicts, and the newest state, from an initial one on.

    A step fuses its measurements into a state, see `Fusion.step`. Measurements are kept longer than the
    horizon by `lookback_ns`, the maximum time before its stamp at which late odometry may change them.
    """

    def __init__(self, settings: Settings, step: Step, state: SwarmState, lookback_ns: int) -> None:
        self._step = step
        self._horizon_ns = round(settings.horizon_s * 1e9)
        self._fusion_period_ns = round(settings.fusion_period_s * 1e9)
        waits = self._fusion_period_ns and state.tracked.size >= settings.policy.delay_from
        self._fusion_delay_ns = round(settings.fusion_delay_s * 1e9) if waits else None
        self._kept_ns = self._horizon_ns + lookback_ns
        self._spacing_ns = self._kept_ns // _CHECKPOINTS
        self.restart(state)

    def restart(self, state: SwarmState) -> None:
        """Drop all measurements and continue from `state`."""
        self.state = self._ahead = state  # The newest complete one, and the one that steps change
        self.is_busy = False  # Whether the last `advance` left steps to compute
        self._head_key = _BEFORE_ALL
        # The step after which a state was copied, by the last stamp that belongs to it, and the copy.
        self._checkpoints = [(_BEFORE_ALL, state.copy())]
        self._new: list[Measurements] = []
        self._withdrawn: list[Measurements] = []
        self._new_commands: list[Command] = []
        self._commands: list[Command] = []
        self._redo_from_ns: int | None = None
        self.buffer = MeasurementBuffer()  # Measurements within the horizon
        self.settled: IntArray = np.zeros(len(Verdict), dtype=np.int64)
        self.duplicates = 0
        self.too_old = 0

    def add(self, measurements: Measurements) -> None:
        """Add measurements (m,), to be fused by the next `advance`."""
        if measurements.size:
            self._new.append(measurements)

    def command(self, command: Command) -> None:
        """Add a command, to be executed at its stamp by the next `advance`."""
        self._new_commands.append(command)

    def withdraw(self, measurements: Measurements) -> None:
        """Remove measurements (m,) added before, and undo their effect at the next `advance`."""
        if measurements.size:
            self._withdrawn.append(measurements)

    @property
    def waiting(self) -> int:
        """Number of measurements and commands waiting for the next `advance`."""
        return sum(measurements.size for measurements in self._new) + len(self._new_commands)

    def oldest_due_ns(self, otherwise_ns: int) -> int:
        """Stamp of the oldest measurement left to fuse, at most `otherwise_ns`."""
        due_ns = [otherwise_ns] if self._redo_from_ns is None else [otherwise_ns, self._redo_from_ns]
        due_ns += self.buffer.stamp_ns[self._count_until(self._head_key) :][:1].tolist()
        due_ns += [one.stamp_ns for one in self._commands if one.stamp_ns > self._head_key]
        return min(due_ns)

    def invalidate(self, changed_from_ns: IntArray) -> None:
        """Mark steps of robots whose tracks have changed after an instant (N,) to be computed again."""
        stamp_ns = self.buffer.stamp_ns
        first = _first_touched(stamp_ns, *self.buffer.sides, changed_from_ns)
        if first < len(self.buffer):
            self._redo_from(int(stamp_ns[first]))
        for command in self._commands:
            if command.stamp_ns > changed_from_ns[command.robot]:
                self._redo_from(command.stamp_ns)
                break

    def verdict_counts(self) -> IntArray:
        """Number of measurements by verdict (len(Verdict),) since the last restart."""
        return self.settled + np.bincount(self.buffer.verdicts, minlength=len(Verdict))

    def advance(self, now_ns: int, has_budget: HasBudget = lambda: True) -> None:
        """Compute all steps affected by new or changed data, and drop data beyond the horizon.

        A large swarm fuses a period `fusion_delay_s` after its end, when most of its data have arrived. When
        `has_budget` returns False after a step, the next calls continue; new data wait until all is done.
        """
        if not self.is_busy:
            if self._new:
                self._merge(now_ns - self._horizon_ns)
            if self._new_commands:
                self._order(now_ns - self._horizon_ns)
            if self._withdrawn:  # unless their replacements are rejected as too old
                gone, self._withdrawn = self._not_older(self._withdrawn, now_ns - self._horizon_ns), []
                if (first_ns := self.buffer.remove(gone)) is not None:
                    self._redo_from(first_ns)
            if self._redo_from_ns is not None:
                # roll back to the last checkpoint before the step, unless that is ahead
                key, self._redo_from_ns = self._key(self._redo_from_ns), None
                if key <= self._head_key:
                    while self._checkpoints[-1][0] >= key:
                        self._checkpoints.pop()
                    self._head_key, checkpoint = self._checkpoints[-1]
                    self._ahead = checkpoint.copy()
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
        return int(self.buffer.stamp_ns.searchsorted(key, side="right"))

    def _redo_from(self, stamp_ns: int) -> None:
        """Mark the step of a stamp and all later ones for the next `advance`."""
        self._redo_from_ns = stamp_ns if self._redo_from_ns is None else min(stamp_ns, self._redo_from_ns)

    def _merge(self, oldest_ns: int) -> None:
        """Merge new measurements into the buffer."""
        given, new = sum(one.size for one in self._new), self._not_older(self._new, oldest_ns)
        self._new = []
        self.too_old += given - new.size
        inserted, first_ns = self.buffer.merge(new)
        self.duplicates += new.size - inserted
        if first_ns is not None:
            self._redo_from(first_ns)

    def _order(self, oldest_ns: int) -> None:
        """Insert new commands by their stamps."""
        for given in self._new_commands:
            if given.kind == CommandKind.NEW_MAP:
                given = given._replace(stamp_ns=max(given.stamp_ns, oldest_ns))  # noqa: PLW2901
            if given.stamp_ns < oldest_ns:
                self.too_old += 1
                continue
            insort(self._commands, given, key=lambda one: (one.stamp_ns, one.robot))
            self._redo_from(given.stamp_ns)
        self._new_commands = []

    def _not_older(self, parts: list[Measurements], oldest_ns: int) -> Measurements:
        """Select measurements (m,) whose stamps are not older than an instant."""
        rows = concatenate(parts)
        fresh = rows.stamp_ns >= oldest_ns
        return rows if fresh.all() else select(rows, fresh)

    def _compute(self, due_ns: int, has_budget: HasBudget) -> bool:
        """Compute steps that end until `due_ns` within the budget; return whether all are done."""
        buffer = self.buffer
        while True:
            # A run of steps up to the next checkpoint, which are computed together.
            begin = self._count_until(self._head_key)
            commands = [one for one in self._commands if one.stamp_ns > self._head_key]
            stamps_ns = [*buffer.stamp_ns[begin : begin + 1].tolist(), *(one.stamp_ns for one in commands)]
            if not stamps_ns:
                return True
            last_ns = end_of_period(min(stamps_ns), self._fusion_period_ns or self._spacing_ns)
            end = self._count_until(last_ns)
            commands = [one for one in commands if one.stamp_ns <= last_ns]
            newest_ns = [one.stamp_ns for one in commands] + buffer.stamp_ns[begin:end][-1:].tolist()
            key = self._key(max(newest_ns))
            if key > due_ns:
                return True
            # Fuse, and store a checkpoint if the last one is old.
            rows, measurements = slice(begin, end), buffer.part(begin, end)
            self._head_key = key
            try:
                self._step(self._ahead, measurements, commands, buffer.verdicts[rows], buffer.nis[rows])
            except Exception:  # the state is half updated: the next call returns to a checkpoint
                self._redo_from(min(stamps_ns))
                self.is_busy = False
                raise
            if key - max(self._checkpoints[-1][0], -(2**62)) >= self._spacing_ns:
                self._checkpoints.append((key, self._ahead.copy()))
            if end < len(buffer) and not has_budget():
                return False

    def _forget_before(self, key: int) -> None:
        """Drop data before step `key`, except one checkpoint and the measurements after it."""
        older = 0
        while older < len(self._checkpoints) and self._checkpoints[older][0] < key:
            older += 1
        if older < _FORGOTTEN_AT_ONCE:
            return
        del self._checkpoints[: older - 1]
        passed = self._count_until(self._checkpoints[0][0])
        self._commands = [one for one in self._commands if one.stamp_ns > self._checkpoints[0][0]]
        self.settled += np.bincount(self.buffer.verdicts[:passed], minlength=len(Verdict))
        self.buffer.drop_first(passed)


@cached_njit
def _first_touched(
    stamps_ns: IntArray,
    observers: IntArray,
    targets: IntArray,
    changed_from_ns: IntArray,
) -> int:
    """First measurement (of m, by stamp) of a robot whose track (of N) changed before it; m if none.

    An anonymous detection may be of any robot.
    """
    if not stamps_ns.size:
        return 0
    earliest_ns = max(changed_from_ns.min(), stamps_ns[0] - 1)
    for k in range(np.searchsorted(stamps_ns, earliest_ns, side="right"), stamps_ns.size):
        if observers[k] < 0 and targets[k] < 0:
            return k
        for robot in (observers[k], targets[k]):
            if robot >= 0 and stamps_ns[k] > changed_from_ns[robot]:
                return k
    return stamps_ns.size
