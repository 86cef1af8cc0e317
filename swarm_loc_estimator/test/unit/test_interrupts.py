"""Commands that are interrupted or killed: their workers end with them, and one sentence says so."""

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from swarm_loc_estimator.common.launch import _TIED_TO_PARENT, start

PROGRAM = """
import sys
from swarm_loc_estimator.common.command_line import Program
sys.exit(Program("interrupted")())
"""
WAITS = """
import os, signal, time

def wait(*_):
    blocked = signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    os.write(1, f"{os.getpid()} {blocked}\\n".encode())
    time.sleep(1000)
"""
BESIDE = """
from interrupted_waits import wait
from swarm_loc_estimator.common.processes import process_beside, uninterrupted

def main():
    with process_beside() as beside:
        with uninterrupted():
            waiting = beside.submit(wait)
        waiting.result()
"""
SWEEP = """
from interrupted_waits import wait
import swarm_loc_estimator.offline.sweep.sweep as sweeping

def main():
    sweeping.outcome = wait
    list(sweeping._outcomes({"a": 1, "b": 2}, 2, sweeping.Backend()))
"""
ENDS = """
import atexit, signal

def main():
    atexit.register(signal.raise_signal, signal.SIGINT)
    print("done")
    return 7
"""
CALLED_BACK = """
import ctypes, signal

@ctypes.CFUNCTYPE(None)
def called():
    signal.raise_signal(signal.SIGINT)

def main():
    called()
    return 0
"""


def started(folder: Path, text: str) -> subprocess.Popen[str]:
    """A command whose module has a text, in a session of its own."""
    (folder / "interrupted.py").write_text(text, encoding="utf-8")
    (folder / "interrupted_waits.py").write_text(WAITS, encoding="utf-8")
    path = os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": path},
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize(("text", "count"), [(BESIDE, 1), (SWEEP, 2)])
def test_workers_end_with_their_command(
    text: str, count: int, number: signal.Signals, tmp_path: Path
) -> None:
    with started(tmp_path, text) as command:
        assert command.stdout is not None
        workers = [command.stdout.readline().split() for _ in range(count)]
        handles = [os.pidfd_open(int(worker)) for worker, _ in workers]
        if number == signal.SIGINT:
            os.killpg(command.pid, number)  # as a terminal does
        else:
            command.send_signal(number)
        _, said = command.communicate(timeout=60)
        for handle in handles:
            assert select.select([handle], [], [], 60.0)[0]  # it has ended
            os.close(handle)
    if number == signal.SIGINT:
        assert (command.returncode, said) == (130, "Stopped by SIGINT.\n")
    assert "Traceback" not in said
    assert all(blocked == "True" for _, blocked in workers)  # else Ctrl-C while they start is a traceback


def test_ctrl_c_where_a_compiler_has_called_back_is_not_swallowed(tmp_path: Path) -> None:
    with started(tmp_path, CALLED_BACK) as command:
        _, said = command.communicate(timeout=60)
    assert (command.returncode, said) == (130, "Stopped by SIGINT.\n")


def test_ctrl_c_while_python_ends_changes_nothing(tmp_path: Path) -> None:
    with started(tmp_path, ENDS) as command:
        output, said = command.communicate(timeout=60)
    assert (command.returncode, output, said) == (7, "done\n", "")


def test_a_program_of_a_graph_is_not_interrupted_before_it_asks_for_it() -> None:
    asked = "import signal, sys; sys.exit(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))"
    assert start([sys.executable, "-c", asked]).wait(60) == 1


def test_a_program_of_a_graph_that_was_killed_does_not_begin(tmp_path: Path) -> None:
    others = str(os.getppid())  # the graph's process, which is not the parent any more
    line = [sys.executable, "-S", "-c", _TIED_TO_PARENT, others, "/usr/bin/touch", str(tmp_path / "begun")]
    subprocess.run(line, check=True)
    assert not (tmp_path / "begun").exists()
