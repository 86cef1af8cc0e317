"""Signals that end a node."""

import os
import signal
import subprocess
import sys
import time

import pytest
from processor_wait import waited_s

running = pytest.importorskip("swarm_loc_estimator.common.node", exc_type=ImportError)


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
from swarm_loc_estimator.common.node import Stop
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
        begin_s, begin_waited_s = time.monotonic(), waited_s(process.pid)
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # its figures stay until it is reaped
        took_s = time.monotonic() - begin_s - (waited_s(process.pid) - begin_waited_s)
        assert process.wait() == 0
        assert took_s < 2.0


_COMPILING = """
import signal
from swarm_loc_estimator.common import node as running

def create():
    try:
        signal.raise_signal(signal.SIGTERM)
    except KeyboardInterrupt:
        pass  # as compilers do that have called back
    raise RuntimeError("nothing is compiled")

running._start_ros = lambda: None
running.run_node("compiling", create, leaves_at_once=True)
"""


def test_a_signal_while_the_node_is_made_ends_the_process_with_status_0() -> None:
    assert subprocess.run([sys.executable, "-c", _COMPILING], check=False).returncode == 0


_NEVER_DESTROYED = """
import threading
from swarm_loc_estimator.common import node as running

class Node:
    def run(self, stop):
        return 0

    def destroy_node(self):
        lock = threading.Lock()
        lock.acquire()
        lock.acquire()

running._SHUTDOWN_S = 0.2
running._start_ros = lambda: None
running.run_node("stuck", Node)
"""


def test_a_node_that_cannot_be_destroyed_ends_with_a_traceback() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _NEVER_DESTROYED], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "in destroy_node" in done.stderr
