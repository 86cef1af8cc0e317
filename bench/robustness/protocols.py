"""Drivers of all protocols while the bytes of their robots are corrupted: one stream, and what came of it."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from bench.robustness.robots import PROTOCOLS, Run
from bench.robustness.wire import NONSENSE, PARTIAL, Wire
from bench.shared.common import ProgressLine

_CONNECT_S, _NONSENSE_S, _RECOVER_S, _STEADY_S, _STOP_S = 4.0, 4.0, 8.0, 0.5, 8.0
_PARTIAL_S = 1.5
_SHARES = (1e-4, 0.1)  # Shares of corrupted bytes, evenly by magnitude
_VELOCITY = (0.02, 0.0, 0.5)
_CHUNK = 20  # Streams that a process runs at once


class Outcome(NamedTuple):
    """What came of a stream."""

    traceback: str  # Of a defect of the driver; "": none
    is_dead: bool  # Whether the driver's thread has ended, or never connects again
    false_connected_s: float  # Longest time in which it was connected although nothing made sense [s]
    recovery_s: float  # From the end of the corruption until odometry comes again [s]
    still_moves: bool  # Whether the robot moves after the driver has stopped it


class Stream:
    """A robot whose bytes are corrupted for a while, see `Wire`; the seed decides how."""

    def __init__(self, protocol: str, seed: int, kind: str = "") -> None:
        self.rng = np.random.default_rng([seed, list(PROTOCOLS).index(protocol)])
        kinds = NONSENSE if self.rng.random() < 0.5 else PARTIAL
        self.kind = kind or str(self.rng.choice(kinds))
        share = float(np.exp(self.rng.uniform(*np.log(_SHARES))))
        self._wire = Wire(self.kind, share, self.rng)
        self._phase, self._since_s = "connect", 0.0
        self._connected_s = self._false_s = self._recovery_s = 0.0
        self._received = 0
        self._is_dead = False
        self._run = Run(protocol, self._watch)
        # Other bytes may be commands that hang a robot, as long images do.
        self._run.hears_wrong = bool(self.rng.random() < 0.3) and self.kind in {"lost", "doubled", "swapped"}
        self._since_s = self._run.now_s

    def run(self) -> Outcome:
        """Run it."""
        self._run.drive(_VELOCITY)
        text = ""
        with np.errstate(all="raise"):
            try:
                self._run.go()
            except Exception:  # noqa: BLE001 # what ends a thread is the result
                text, self._is_dead = traceback.format_exc(), True
        text = text or "".join(self._run.driver.defects.values())
        moves = any(self._run.body.rates) and not self._run.driver.may_run
        return Outcome(text, self._is_dead, self._false_s, self._recovery_s, moves)

    def _watch(self) -> None:
        """Go on to the next phase when it is time."""
        run, phase = self._run, self._phase
        now_s, is_connected = run.now_s, not run.driver.trouble
        passed_s = now_s - self._since_s
        if phase == "connect" and (run.received > 10 or passed_s > _CONNECT_S):
            self._enter("corrupt")
            run.wire, self._connected_s = self._wire, now_s
        elif phase == "corrupt":
            self._connected_s = self._connected_s if is_connected else now_s
            if self.kind in NONSENSE:
                self._false_s = max(self._false_s, now_s - self._connected_s)
            if passed_s > (_NONSENSE_S if self.kind in NONSENSE else _PARTIAL_S):
                self._enter("recover")
                run.wire, self._received = None, run.received
        elif phase == "recover":
            is_back = is_connected and run.received > self._received + 5
            if is_back or passed_s > _RECOVER_S:
                self._recovery_s, self._is_dead = passed_s, self._is_dead or not is_back
                self._enter("steady")
        elif phase == "steady" and passed_s > _STEADY_S:
            run.stop()
            self._enter("stop")
        elif phase == "stop" and passed_s > _STOP_S:
            raise RuntimeError(f"the driver does not end, {run.driver.trouble}")

    def _enter(self, phase: str) -> None:
        self._phase, self._since_s = phase, self._run.now_s


def _outcome(protocol: str, seed: int) -> Outcome:
    return Stream(protocol, seed).run()


def measure(streams: int, say: ProgressLine, note: Callable[[dict[str, float]], None]) -> dict[str, float]:
    """Figures of so many streams of each protocol; notes those of each, and prints each new traceback."""
    figures: dict[str, float] = {}
    found: list[Outcome] = []
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        for protocol in PROTOCOLS:
            ones = []
            for one in pool.map(_outcome, repeat(protocol, streams), range(streams), chunksize=_CHUNK):
                ones.append(one)
                say(f"{protocol} {len(ones) // _CHUNK * _CHUNK} of {streams}")
            of_protocol = _figures(f"protocols.{protocol}", ones)
            for text in sorted({one.traceback for one in ones} - {one.traceback for one in found} - {""}):
                print(text)
            note(of_protocol)
            figures |= of_protocol
            found += ones
    return _figures("protocols", found) | figures


def _figures(name: str, ones: list[Outcome]) -> dict[str, float]:
    return {
        f"{name}.streams": len(ones),
        f"{name}.dead_threads": sum(one.is_dead for one in ones),
        f"{name}.tracebacks": sum(bool(one.traceback) for one in ones),
        f"{name}.false_connected_s": max(one.false_connected_s for one in ones),
        f"{name}.recovery_s": max(one.recovery_s for one in ones),
        f"{name}.moving_after_stop": sum(one.still_moves for one in ones),
    }
