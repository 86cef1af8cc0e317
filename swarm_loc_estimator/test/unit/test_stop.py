"""Signals that end a node."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

running = pytest.importorskip("swarm_loc_estimator.ros.running", exc_type=ImportError)


def test_only_the_first_signal_interrupts() -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        stop = running.Stop()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        assert stop.requested
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


_BUSY = """
import signal
from swarm_loc_estimator.ros.running import Stop
stop = Stop()
stop.defer()
stop.leave_at_once()
signal.raise_signal(signal.SIGINT)
print("signalled", flush=True)
while True:
    pass
"""


def test_a_process_that_is_busy_ends_within_two_seconds_of_a_signal() -> None:
    with subprocess.Popen([sys.executable, "-c", _BUSY], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "signalled\n"
        begin_s = time.monotonic()
        assert process.wait(60.0) == 0
        assert time.monotonic() - begin_s < 2.0
