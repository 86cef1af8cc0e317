"""Signals that end a node."""

from __future__ import annotations

import signal

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
