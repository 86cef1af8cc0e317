"""Measurements in the order of their stamps, whatever the order of arrival.

The state after some of the steps is kept (checkpoints). What arrives late takes the filter back to the
checkpoint before it, and everything since is computed again; so the result is that of an orderly arrival.
The e-puck paper's buffer (V-B) assigns a measurement to the closest stored state: `state_period_s` does that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.fusion import Verdict
from swarm_loc_estimator.core.measurements import MEASUREMENT_DTYPE, MeasurementArray
from swarm_loc_estimator.core.motion import UNCHANGED_NS
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.state import SwarmState

Step = Callable[[SwarmState, MeasurementArray, NDArray[np.uint8], FloatArray], None]

_CHECKPOINTS = 40
_BEFORE_ALL = np.iinfo(np.int64).min


@dataclass(frozen=True)
class _Checkpoint:
    """The state after the step `key`."""

    key: int
    state: SwarmState


class Timeline:
    """Buffered measurements with their verdicts, and the newest state.

    Args:
        settings: Horizon, and how stamps are grouped into steps.
        step: Fuses the measurements of one step into a state, see `Fusion.step`.
        state: Where to begin.
        reach_ns: How far before its stamp late odometry may change what measurements meant; those are kept
            so much longer than the horizon.
    """

    def __init__(self, settings: EstimatorSettings, step: Step, state: SwarmState, reach_ns: int) -> None:
        self._step = step
        self._horizon_ns = round(settings.horizon_s * 1e9)
        self._state_period_ns = round(settings.state_period_s * 1e9)
        self._fusion_period_ns = round(settings.fusion_period_s * 1e9)
        self._kept_ns = self._horizon_ns + reach_ns
        self._spacing_ns = self._kept_ns // _CHECKPOINTS
        self.restart(state)

    def restart(self, state: SwarmState) -> None:
        """Drop all measurements and go on from `state`."""
        self.state = state
        self._head_key = _BEFORE_ALL
        self._checkpoints = [_Checkpoint(_BEFORE_ALL, state.copy())]
        self._new: list[MeasurementArray] = []
        self._redo_from_ns: int | None = None
        self.measurements: MeasurementArray = np.zeros(0, dtype=MEASUREMENT_DTYPE)
        self.verdicts: NDArray[np.uint8] = np.zeros(0, dtype=np.uint8)
        self.nis: FloatArray = np.zeros(0)
        self.settled: NDArray[np.int64] = np.zeros(len(Verdict), dtype=np.int64)
        self.duplicates = 0
        self.too_old = 0

    def add(self, measurements: MeasurementArray) -> None:
        """Take measurements (m,) in; they count from the next `advance` on."""
        if measurements.size:
            self._new.append(measurements)

    @property
    def waiting(self) -> int:
        """How many measurements wait for the next `advance`."""
        return sum(measurements.size for measurements in self._new)

    def invalidate(self, changed_from_ns: NDArray[np.int64]) -> None:
        """Have the steps computed again whose robots' tracks have changed.

        Args:
            changed_from_ns: (N,) per robot the instant after which its track changed.
        """
        after = np.append(changed_from_ns, UNCHANGED_NS)  # NOBODY (-1) finds the last
        stamps = self.measurements["stamp_ns"]
        touched = stamps > np.minimum(
            after[self.measurements["observer"]], after[self.measurements["target"]]
        )
        if touched.any():
            first_ns = int(stamps[np.argmax(touched)])
            self._redo_from_ns = first_ns if self._redo_from_ns is None else min(first_ns, self._redo_from_ns)

    def verdict_counts(self) -> NDArray[np.int64]:
        """How many measurements got each verdict since the start (len(Verdict),)."""
        return self.settled + np.bincount(self.verdicts, minlength=len(Verdict))

    def advance(self, now_ns: int) -> None:
        """Compute all steps that new or changed data touch, and let go of what lies beyond the horizon."""
        first_new = self._merge(now_ns - self._horizon_ns)
        changed = [] if self._redo_from_ns is None else [self._key(self._redo_from_ns)]
        self._redo_from_ns = None
        self._compute_from(min([*changed, *first_new], default=None))
        self._forget_before(self._key(now_ns - self._kept_ns))

    def _key(self, stamp_ns: int) -> int:
        """The step that a stamp belongs to, as the stamp at which the step begins."""
        return stamp_ns - stamp_ns % self._fusion_period_ns if self._fusion_period_ns else stamp_ns

    def _keys(self, measurements: MeasurementArray) -> NDArray[np.int64]:
        stamps: NDArray[np.int64] = measurements["stamp_ns"]
        return stamps - stamps % self._fusion_period_ns if self._fusion_period_ns else stamps

    def _merge(self, oldest_ns: int) -> list[int]:
        """Sort new measurements in; return the key of the first one, if any."""
        if not self._new:
            return []
        new = np.concatenate(self._new)
        self._new = []
        if self._state_period_ns:
            period = self._state_period_ns
            new["stamp_ns"] = (new["stamp_ns"] + period // 2) // period * period
        in_time = new["stamp_ns"] >= oldest_ns
        self.too_old += int(np.sum(~in_time))
        new = new[in_time]
        if not new.size:
            return []
        first_ns = int(new["stamp_ns"].min())
        keep = int(np.searchsorted(self.measurements["stamp_ns"], first_ns))
        tail = np.concatenate([self.measurements[keep:], new])
        tail, duplicates = _in_order(tail)
        self.duplicates += duplicates
        self.measurements = np.concatenate([self.measurements[:keep], tail])
        self.verdicts = np.concatenate([self.verdicts[:keep], np.zeros(tail.size, dtype=np.uint8)])
        self.nis = np.concatenate([self.nis[:keep], np.full(tail.size, np.nan)])
        return [self._key(first_ns)]

    def _compute_from(self, key: int | None) -> None:
        """Go back to before step `key`, if it is not ahead, and do all steps that are due."""
        if key is None:
            return
        if key <= self._head_key:
            while self._checkpoints[-1].key >= key:
                self._checkpoints.pop()
            self._head_key = self._checkpoints[-1].key
            self.state = self._checkpoints[-1].state.copy()
        keys = self._keys(self.measurements)
        begin = int(np.searchsorted(keys, self._head_key, side="right"))
        due = keys[begin:]
        group = due // self._spacing_ns if not self._fusion_period_ns else due
        starts = np.flatnonzero(np.diff(group, prepend=group[:1] - 1))
        for low, high in zip(begin + starts, begin + np.append(starts[1:], due.size), strict=True):
            rows = slice(int(low), int(high))
            self._step(self.state, self.measurements[rows], self.verdicts[rows], self.nis[rows])
            self._head_key = int(keys[high - 1])
            if self._head_key - max(self._checkpoints[-1].key, -(2**62)) >= self._spacing_ns:
                self._checkpoints.append(_Checkpoint(self._head_key, self.state.copy()))

    def _forget_before(self, key: int) -> None:
        """Keep one checkpoint before step `key` and only the measurements after it."""
        older = sum(checkpoint.key < key for checkpoint in self._checkpoints)
        if older < 2:
            return
        del self._checkpoints[: older - 1]
        passed = int(np.searchsorted(self._keys(self.measurements), self._checkpoints[0].key, side="right"))
        self.settled += np.bincount(self.verdicts[:passed], minlength=len(Verdict))
        self.measurements, self.verdicts = self.measurements[passed:], self.verdicts[passed:]
        self.nis = self.nis[passed:]


def _in_order(measurements: MeasurementArray) -> tuple[MeasurementArray, int]:
    """Measurements in the order of their stamps, each once, and how many were repetitions.

    The order does not depend on that of arrival, not even among measurements that share a stamp.
    """
    keys = [measurements[name] for name in ("kind", "marker_id", "target", "observer", "stamp_ns")]
    order = np.lexsort(keys)
    if not _equal_to_the_one_before([key[order] for key in keys]).any():
        return measurements[order], 0
    numbers = [*measurements["value"].T, *measurements["alternative"].T]
    numbers += [measurements["covariance"][:, i, i] for i in range(3)]
    order = np.lexsort([*numbers, *keys])
    again = _equal_to_the_one_before([key[order] for key in [*numbers, *keys]])
    return measurements[order][~again], int(again.sum())


def _equal_to_the_one_before(columns: list[NDArray[Any]]) -> NDArray[np.bool_]:
    """Whether each row of the columns, each (m,), equals the row before it."""
    equal = np.zeros(columns[0].size, dtype=bool)
    equal[1:] = np.logical_and.reduce([column[1:] == column[:-1] for column in columns])
    return equal
