"""Out-of-sequence measurements: rollback to checkpoints and re-fusion.

States after some of the steps are stored as checkpoints. A late measurement rolls the filter back to the
last checkpoint before it, and all later steps are repeated; the result equals that of in-order arrival.
`state_period_s` assigns measurements to the closest stored state instead, as the e-puck paper (V-B) does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.filter.measurement_model import Kind, MeasurementArray
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.timeline.buffer import MeasurementBuffer
from swarm_loc_estimator.timeline.scheduling import end_of_period, middle_of_period
from swarm_loc_estimator.timeline.settings import Settings
from swarm_loc_estimator.timeline.verdicts import Verdict

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
