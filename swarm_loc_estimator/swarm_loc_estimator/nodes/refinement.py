"""Refine the description by the first minutes of a run, on request, as `calibrate --self` does by a bag.

The description in use stays as it is: another one is written beside it, and what differs is said.
"""

from __future__ import annotations

import os
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from multiprocessing import active_children, get_context
from pathlib import Path

import numpy as np

from swarm_loc_estimator.common.processes import end_with, uninterrupted
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.swarm.swarm import Swarm

KEPT_S, KEPT_BYTES = 300.0, 64_000_000  # Time and memory from which on no more inputs are kept
_SENSORS = ("odometry", "imu", "detections", "ranges")
Answer = tuple[bool, str]  # Whether a description was written, and what to say


class Refinement:
    """Keeps the first inputs of a run, and fits a description to them in a process of its own when asked."""

    def __init__(self) -> None:
        self._parts: list[Batch] = []
        self._bytes = 0
        self._worker: ProcessPoolExecutor | None = None
        self._fit: Future[Answer] | None = None

    def keep(self, inputs: Batch) -> None:
        """Keep what a fit uses, of the first minutes."""
        begin_ns = self._parts[0].begin_ns if self._parts else inputs.begin_ns
        if self._bytes > KEPT_BYTES or inputs.end_ns - begin_ns > KEPT_S * 1e9:
            return
        rows = {name: inputs.rows[name] for name in _SENSORS if name in inputs.rows}
        # copied, lest they keep the messages that they were read from
        rows = {name: type(one)(*map(np.array, one)) for name, one in rows.items() if one.robot.size}
        if rows:
            self._parts.append(Batch(inputs.begin_ns, inputs.end_ns, rows))
            self._bytes += sum(column.nbytes for one in rows.values() for column in one)

    def forget(self) -> None:
        """Begin again: the clock was set."""
        self._parts, self._bytes = [], 0

    def ask(self, swarm: Swarm, path: Path) -> Answer:
        """Begin to fit the description of a path, or say how far that is, and once what it has given."""
        if self._fit is None:
            if not self._parts:
                return False, "Nothing is refined: no message was received yet."
            context = get_context("spawn")
            with uninterrupted():
                self._worker = ProcessPoolExecutor(1, context, _begin, (os.getpid(),))
                self._fit = self._worker.submit(_refined, [*self._parts], swarm, path)
            kept_s = 1e-9 * (self._parts[-1].end_ns - self._parts[0].begin_ns)
            return False, f"The first {kept_s:.0f} s are being fitted; ask again for what they give."
        if not self._fit.done():
            return False, "The fit is not finished; ask again for what it gives."
        try:
            return self._fit.result()
        except BrokenProcessPool:
            return False, "Nothing is refined: the process that fits was killed, perhaps for its memory."
        finally:
            self.stop()

    def stop(self) -> None:
        """End a fit."""
        if self._worker is not None:
            for process in active_children():
                process.kill()
            self._worker.shutdown(wait=False)
        self._worker = self._fit = None


def _begin(parent: int) -> None:
    end_with(parent)
    os.nice(10)


def _refined(parts: list[Batch], swarm: Swarm, path: Path) -> Answer:
    refine = import_module("swarm_loc_estimator.offline.calibration.fit").refined  # large, and not of nodes
    answer: Answer = refine(parts, swarm, path)
    return answer
