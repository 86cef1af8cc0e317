"""Commands: errors in one sentence, interrupts, options, the graph, and signals that end a node."""

import os
import re
import select
import signal
import subprocess
import sys
import time
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processor_wait import waited_s

from swarm_loc_estimator.cli import calibrate, calibrate_ir, doctor, replay, survey
from swarm_loc_estimator.cli.graph import check_graph
from swarm_loc_estimator.common.bags.bag_file import RawMessage
from swarm_loc_estimator.common.command_line import exit_with_message, file_to_write, folder_to_write
from swarm_loc_estimator.common.launch import (
    _TIED_TO_PARENT,
    GraphOptions,
    NodeSpec,
    graph_nodes,
    options_from,
    parsed_options,
    start,
)
from swarm_loc_estimator.common.parameters import ParameterError, UserError
from swarm_loc_estimator.nodes.playback import LONGEST_STEP_NS, STEP_S, PlayedSoFar, play


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (UserError("This is wrong."), 1, "This is wrong.\n"),
        (OSError(28, "No space left on device", "out/x.yaml"), 1, "out/x.yaml cannot be used: No space left"),
        (OSError("cannot mmap an empty file"), 1, "A file cannot be used: cannot mmap an empty file."),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_what_goes_wrong_ends_a_command_with_a_sentence(
    error: BaseException, status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    @exit_with_message
    def main() -> int:
        raise error

    assert main() == status
    said = capsys.readouterr().err
    assert said.startswith(words)
    assert said.count("\n") == bool(words)


def test_faults_of_the_program_are_not_hidden() -> None:
    @exit_with_message
    def main() -> int:
        raise KeyError

    with pytest.raises(KeyError):
        main()


@pytest.mark.parametrize("main", [replay.main, calibrate.main, calibrate_ir.main, survey.main])
def test_a_bag_that_is_not_there_is_said(
    main: Callable[[list[str]], int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "nope"), "--out", str(tmp_path / "out.yaml")]) == 1
    assert capsys.readouterr().err == f"There is no bag '{tmp_path / 'nope'}'.\n"


def test_folders_are_not_made_before_there_is_anything_to_write(tmp_path: Path) -> None:
    assert folder_to_write()(str(tmp_path / "a" / "b")) == tmp_path / "a" / "b"
    assert file_to_write(".mcap")(str(tmp_path / "a" / "b.mcap")) == tmp_path / "a" / "b.mcap"
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("run.bag", "must end in .yaml or .yml"),
        ("folder.yaml", "folder.yaml cannot be written: it is a folder"),
        ("link.yaml", "link.yaml cannot be written: it is a symbolic link"),
        ("nowhere.yaml", "nowhere.yaml cannot be written: it is a symbolic link"),
        ("pipe.yaml", "pipe.yaml cannot be written: it is no regular file"),
        ("gone/run.yml", "gone cannot be written: No such file"),
        ("file/run.yml", "file cannot be written: Not a directory"),
    ],
)
def test_a_file_that_cannot_be_written_is_said(name: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "link.yaml").symlink_to(tmp_path / "file")
    (tmp_path / "nowhere.yaml").symlink_to(tmp_path / "none")
    (tmp_path / "gone").symlink_to(tmp_path / "none")
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(ArgumentTypeError, match=said):
        file_to_write(".yaml", ".yml")(str(tmp_path / name))


@pytest.mark.parametrize(("main", "more"), [(doctor.main, []), (survey.main, ["--out", "out.yaml"])])
def test_a_folder_is_a_bag_whatever_its_name(
    main: Callable[[list[str]], int], more: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / "run.yaml"
    bag.mkdir()
    assert main([str(bag), *more]) == 1
    assert f"{bag / 'swarm.yaml'} cannot be read" in capsys.readouterr().err


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


BAG = Path(__file__).parents[3] / "bags" / "eight_one_robot_slow"
SWARM_FILE = str(BAG / "swarm.yaml")


def test_texts_become_options() -> None:
    texts = {"swarm_file": "swarm.yaml", "bag": "", "rate": "2", "use_sim_time": "true", "parameter_file": ""}
    assert options_from(GraphOptions, texts) == GraphOptions("swarm.yaml", rate=2.0, use_sim_time=True)


@pytest.mark.parametrize("rate", ["abc", "0", "-1", "nan", "inf", "1e9"])
def test_a_number_that_cannot_be_is_told_with_its_name_and_range(rate: str) -> None:
    sentence = re.escape(f"argument rate = '{rate}' must be a number in [0.01, 1000].")
    with pytest.raises(ParameterError, match=sentence):
        options_from(GraphOptions, {"swarm_file": "swarm.yaml", "rate": rate})


def test_an_option_that_must_be_set_is_named() -> None:
    with pytest.raises(ParameterError, match="argument swarm_file is not set"):
        options_from(GraphOptions, {"swarm_file": ""})


def test_files_that_can_be_used_pass(tmp_path: Path) -> None:
    parameters = tmp_path / "parameters.yaml"
    parameters.write_text("/**: {estimator: {ros__parameters: {window_s: 1.0}}}\n", encoding="utf-8")
    check_graph(GraphOptions(SWARM_FILE, bag=str(BAG), parameter_file=str(parameters)))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (GraphOptions("missing.yaml"), "missing.yaml"),
        (GraphOptions(SWARM_FILE, bag="missing_bag"), "missing_bag"),
        (GraphOptions(SWARM_FILE, parameter_file="missing_parameters.yaml"), "missing_parameters.yaml"),
        (GraphOptions(SWARM_FILE, parameter_file=SWARM_FILE), "has no ros__parameters"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_in_one_sentence(options: GraphOptions, named: str) -> None:
    with pytest.raises((UserError, OSError), match=named) as told:
        check_graph(options)
    assert "\n" not in str(told.value)


def test_a_live_graph_is_the_estimator_on_the_wall_clock() -> None:
    (estimator,) = graph_nodes(GraphOptions("swarm.yaml"))

    assert (estimator.package, estimator.executable) == ("swarm_loc_estimator", "estimator_node")
    assert estimator.parameters == {"swarm_file": "swarm.yaml", "use_sim_time": False}


def test_a_bag_brings_its_player_and_its_clock() -> None:
    estimator, player = graph_nodes(GraphOptions("swarm.yaml", bag="bags/eight", rate=4.0))

    assert estimator.parameters["use_sim_time"] is True
    assert player.executable == "play"
    assert player.parameters == {"bag": "bags/eight", "rate": 4.0, "wait_for_subscribers": 1}


def test_arguments_keep_types_spaces_and_order() -> None:
    node = NodeSpec(
        "package",
        "executable",
        "node",
        namespace="epuck1",
        parameters={"file": "a b: c.yaml", "on": True, "count": 5, "gain": 5.0, "code": "012"},
        parameter_file="all.yaml",
    )

    assert node.ros_arguments() == [
        *("--ros-args", "-r", "__node:=node", "-r", "__ns:=/epuck1", "--params-file", "all.yaml"),
        *("-p", 'file:="a b: c.yaml"', "-p", "on:=true", "-p", "count:=5"),
        *("-p", "gain:=5.0", "-p", 'code:="012"'),
    ]


def test_the_command_line_becomes_options() -> None:
    line = ["swarm.yaml", "--bag", "bags/eight", "--rate", "2", "--params-file", "all.yaml"]

    expected = GraphOptions("swarm.yaml", "bags/eight", 2.0, parameter_file="all.yaml")
    assert parsed_options(GraphOptions, None, line) == expected


SECOND = 1_000_000_000
T0_NS = 500 * SECOND


class Player:
    """What is published, and when; `slow_s` passes with the first message."""

    def __init__(self, slow_s: float = 0.0) -> None:
        self._now_s = 0.0
        self.told_ns = 0
        self.sent: list[tuple[int, float]] = []
        self.clock: list[int] = []
        self._slow_s = slow_s

    def publish(self, message: RawMessage) -> None:
        """Keep log time and wall time; the clock is never behind."""
        assert message[2] <= self.told_ns
        self.sent.append((message[2], self._now_s))
        self._now_s += self._slow_s
        self._slow_s = 0.0

    def publish_clock(self, now_ns: int) -> None:
        """Keep the clock."""
        self.told_ns = now_ns
        self.clock.append(now_ns)

    def pass_time(self, seconds: float) -> None:
        """Something takes so long."""
        self._now_s += seconds

    def now_s(self) -> float:
        """The test's own clock."""
        return self._now_s

    def wait_until(self, instant_s: float) -> None:
        """Let time pass."""
        self._now_s = max(self._now_s, instant_s)


def bag(*offsets_s: float) -> list[RawMessage]:
    return [("t", "x", T0_NS + round(offset * SECOND), b"") for offset in offsets_s]


def played(player: Player, messages: list[RawMessage], rate: float, begin_s: float = 0.0) -> PlayedSoFar:
    so_far = PlayedSoFar()
    begin_ns = T0_NS + round(begin_s * SECOND)
    play(messages, begin_ns, rate, player, so_far)
    return so_far


@pytest.mark.parametrize("rate", [0.5, 1.0, 7.0, 300.0])
def test_messages_go_out_in_time_at_any_rate(rate: float) -> None:
    player = Player()
    offsets = [0.0, 0.1, 0.1, 0.35, 20.0, 20.0001]
    so_far = played(player, bag(*offsets), rate)
    for (_, wall_s), offset in zip(player.sent, offsets, strict=True):
        assert offset / rate - 1e-9 <= wall_s <= offset / rate + STEP_S + 1e-9
    assert so_far.messages == 6
    assert so_far.latest_s <= STEP_S + 1e-9


def test_time_is_told_in_small_steps_also_where_the_bag_is_silent() -> None:
    player = Player()
    played(player, bag(0.0, 30.0), 300.0)
    steps = [b - a for a, b in zip(player.clock, player.clock[1:], strict=False)]
    assert player.clock[0] == T0_NS
    assert min(steps) > 0
    assert max(steps) <= LONGEST_STEP_NS


def test_the_clock_starts_when_the_first_message_has_been_found() -> None:
    player = Player()

    def slow_to_open(messages: list[RawMessage]) -> Iterator[RawMessage]:
        player.pass_time(1.0)
        yield from messages

    so_far = PlayedSoFar()
    play(slow_to_open(bag(-0.5, 0.1, 0.3)), T0_NS, 1.0, player, so_far)
    assert [wall_s for _, wall_s in player.sent] == pytest.approx([1.1, 1.3], abs=STEP_S + 1e-9)
    assert so_far.latest_s <= STEP_S + 1e-9


def test_being_late_once_does_not_shift_what_follows() -> None:
    player = Player(slow_s=1.0)
    so_far = played(player, bag(0.0, 0.2, 0.9, 3.0), 1.0)
    wall_s = [wall_s for _, wall_s in player.sent]
    assert wall_s[1] == wall_s[2] == 1.0
    assert wall_s[3] == pytest.approx(3.0, abs=STEP_S)
    assert so_far.latest_s == pytest.approx(0.8)
    assert "at most 800.0 ms late" in so_far.summary()


def test_the_beginning_can_be_left_out() -> None:
    player = Player()
    so_far = played(player, bag(0.0, 1.0, 2.0), 1.0, begin_s=0.5)
    assert [log_ns - T0_NS for log_ns, _ in player.sent] == [SECOND, 2 * SECOND]
    assert player.sent[0][1] == pytest.approx(0.5, abs=STEP_S)
    assert so_far.bag_ns == round(1.5 * SECOND)


RECKON = """
import os
import swarm_loc_estimator.filter.joint_filter
import numpy as np
square = np.ones((500, 500))
square @ square
np.linalg.solve(square + 500.0 * np.eye(500), square)
print(len(os.listdir("/proc/self/task")))
"""


def test_blas_starts_no_threads() -> None:
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", RECKON], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "1"


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
