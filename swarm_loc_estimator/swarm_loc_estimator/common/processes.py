"""Worker processes: they end with the process that started them, which alone is interrupted by Ctrl-C."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context, resource_tracker

_PR_SET_PDEATHSIG = 1
# a process that watches semaphores removes those of a command that was stopped, and would warn of them
os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker")


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold back Ctrl-C; processes and threads that are started inside never get it."""
    resource_tracker.ensure_running()  # its start lets Ctrl-C through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with(parent: int, number: signal.Signals = signal.SIGKILL) -> None:
    """Let this process, a child of `parent`, get a signal when that ends, or has ended already."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:
        os.kill(os.getpid(), number)


@contextmanager
def process_beside() -> Iterator[Executor]:
    """One worker process; what it has not done when the body fails is not waited for."""
    with ProcessPoolExecutor(1, get_context("spawn"), end_with, (os.getpid(),)) as worker:
        try:
            yield worker
        except BaseException:
            for process in active_children():
                process.kill()
            raise
