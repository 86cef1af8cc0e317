"""Run a graph as child processes that live and die together, for machines without `ros2 launch`."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ament_index_python.packages import PackageNotFoundError, get_package_prefix

from swarm_loc_estimator.common.errors import UserError
from swarm_loc_estimator.common.launching.graph import NodeSpec

GRACE_S = 5.0
"""How long processes get to end after SIGINT, and again after SIGTERM."""

STOP_SIGNALS = {signal.SIGINT, signal.SIGTERM}
AWAITED_SIGNALS = STOP_SIGNALS | {signal.SIGCHLD}

_TIED_TO_PARENT = """
import ctypes, os, signal, sys
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGCHLD})
signal.signal(signal.SIGINT, signal.SIG_DFL)  # shells start background jobs with it ignored
PR_SET_PDEATHSIG = 1
ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
os.execv(sys.argv[1], sys.argv[1:])
"""
"""What a process does before it becomes the wanted one; between fork and exec only C code would be safe."""


class GraphError(UserError):
    """A graph cannot start; the text is one sentence."""


@dataclass(frozen=True)
class Child:
    """A process of the graph."""

    spec: NodeSpec
    process: subprocess.Popen[bytes]


def executable_path(package: str, executable: str) -> Path:
    """Where a package's executable is installed.

    Raises:
        GraphError: No such package or executable.
    """
    try:
        path = Path(get_package_prefix(package), "lib", package, executable)
    except PackageNotFoundError as error:
        raise GraphError(f"There is no package '{package}' in this environment.") from error
    if not os.access(path, os.X_OK):
        raise GraphError(f"There is no executable '{executable}' in package '{package}'.")
    return path


def node_command(node: NodeSpec) -> list[str]:
    """Program and arguments of a node.

    Raises:
        GraphError: There is no such executable.
    """
    return [str(executable_path(node.package, node.executable)), *node.ros_arguments()]


def run_graph(nodes: Sequence[NodeSpec], say: Callable[[str], None]) -> int:
    """Run nodes until a required one ends or this process gets SIGINT or SIGTERM; then end all of them.

    Args:
        nodes: The nodes, in the order in which they start.
        say: Takes a line for the user.

    Returns:
        0 after a signal, else the exit status of the required node that ended (128 + n after signal n).

    Raises:
        GraphError: An executable is missing; nothing was started.
    """
    commands = [node_command(node) for node in nodes]
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, AWAITED_SIGNALS)
    children: list[Child] = []
    try:
        for node, command in zip(nodes, commands, strict=True):
            children.append(Child(node, start(command)))
            say(f"{node.full_name}: started as process {children[-1].process.pid}")
        return _watch(children, say)
    finally:
        stop(children, say)
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


def start(command: Sequence[str], output: IO[bytes] | None = None) -> subprocess.Popen[bytes]:
    """Start a process that a terminal's Ctrl-C does not reach directly and that dies with this one.

    Args:
        command: Program and arguments.
        output: Where it writes to; None for where this process does.
    """
    return subprocess.Popen(
        [sys.executable, "-S", "-c", _TIED_TO_PARENT, *command],
        stdout=output,
        stderr=output,
        start_new_session=True,
    )


def _watch(children: Sequence[Child], say: Callable[[str], None]) -> int:
    """Wait for the end: of a required process, or asked for by a signal."""
    running = list(children)
    while True:
        for child in [c for c in running if c.process.poll() is not None]:
            running.remove(child)
            status = _shell_status(child.process.returncode)
            say(f"{child.spec.full_name}: ended with status {status}")
            if child.spec.required or not running:
                return status
        received = signal.sigwait(AWAITED_SIGNALS)
        if received in STOP_SIGNALS:
            say(f"stopping on {signal.Signals(received).name}")
            return 0


def stop(children: Sequence[Child], say: Callable[[str], None]) -> None:
    """End what still runs: asked, then told, then killed."""
    for stop_signal, patience_s in (
        (signal.SIGINT, GRACE_S),
        (signal.SIGTERM, GRACE_S),
        (signal.SIGKILL, None),
    ):
        running = [child for child in children if child.process.poll() is None]
        for child in running:
            if stop_signal != signal.SIGINT:
                say(f"{child.spec.full_name}: does not end, {stop_signal.name}")
            child.process.send_signal(stop_signal)
        _wait_for_all(running, patience_s)


def _wait_for_all(children: Sequence[Child], patience_s: float | None) -> None:
    """Wait until all have ended or patience has."""
    deadline = None if patience_s is None else time.monotonic() + patience_s
    for child in children:
        try:
            child.process.wait(None if deadline is None else max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            return


def _shell_status(returncode: int) -> int:
    return 128 - returncode if returncode < 0 else returncode
