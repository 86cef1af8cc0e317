"""A graph's processes live and die together.

All processes share one output pipe, so its end says that none of them is left.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from swarm_loc_estimator.common import launch as processes
from swarm_loc_estimator.common.launch import NodeSpec

TAKES_SIGINT = """#!{0}
import os, signal
signal.pthread_sigmask(signal.SIG_UNBLOCK, {{signal.SIGINT}})
os.execlp("sh", "sh", "-c", {1!r})
"""
"""As the executables of this project do, when they have begun."""
PROGRAMS = {
    "forever": "trap 'echo asked; exit 0' INT\necho up\nwhile :; do sleep 0.2 & wait; done\n",
    "deaf": "trap '' INT\necho up > {fifo}\nexec sleep 60\n",
    "failing": "read line < {fifo}\nexit 7\n",
    "short": "exit 0\n",
}

RUN_GRAPH = """
import sys
from swarm_loc_estimator.common.launch import NodeSpec
from swarm_loc_estimator.common.launch import run_graph
nodes = [NodeSpec("fake", name, name, required=name != "short") for name in sys.argv[1:]]
sys.exit(run_graph(nodes, lambda line: print(f"{line}\\n", end="", flush=True)))
"""


@pytest.fixture(autouse=True)
def _fake_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package `fake` with executables that end well, badly, or never."""
    marker = tmp_path / "share/ament_index/resource_index/packages/fake"
    programs = tmp_path / "lib/fake"
    for folder in (marker.parent, programs):
        folder.mkdir(parents=True)
    marker.touch()
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "python").symlink_to(sys.executable)  # whose folder may have a space in its name
    for name, lines in PROGRAMS.items():
        text = TAKES_SIGINT.format(tmp_path / "python", lines.format(fifo=tmp_path / "fifo"))
        (programs / name).write_text(text, encoding="utf-8")
        (programs / name).chmod(0o755)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts a graph of `fake` executables by their names, with SIGINT `ignored`; it ends with the test."""
    with ExitStack() as stack:

        def started(*names: str, ignored: bool = False) -> subprocess.Popen[str]:
            command = [sys.executable, "-c", RUN_GRAPH, *names]
            if ignored:
                command = ["sh", "-c", 'trap "" INT; exec "$@"', "sh", *command]
            graph = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            stack.callback(graph.kill)
            return graph

        yield started


def _read_until(graph: subprocess.Popen[str], line: str, count: int = 1) -> None:
    assert graph.stdout is not None
    while count:
        text = graph.stdout.readline()
        assert text, f"the graph ended before it said '{line}'"
        count -= text.strip() == line


def test_a_required_node_that_ends_takes_the_others_along(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "GRACE_S", 2.0)  # enough to die of SIGTERM, on a busy machine, too
    said: list[str] = []
    nodes = [NodeSpec("fake", "deaf", "one"), NodeSpec("fake", "failing", "two")]

    assert processes.run_graph(nodes, said.append) == 7
    assert "two: ended with status 7" in said
    assert said[-1] == "one: does not end, SIGTERM"


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("ignored", [False, True], ids=["", "background"])
def test_a_signal_ends_every_node(
    stop: signal.Signals, ignored: bool, start: Callable[..., subprocess.Popen[str]]
) -> None:
    graph = start("forever", "short", "forever", ignored=ignored)
    _read_until(graph, "up", 2)
    graph.send_signal(stop)
    rest, _ = graph.communicate(timeout=60)

    assert rest.splitlines().count("asked") == 2
    assert graph.returncode == 0


def test_a_killed_graph_leaves_no_orphan(start: Callable[..., subprocess.Popen[str]]) -> None:
    graph = start("forever", "forever")
    _read_until(graph, "up", 2)
    graph.kill()
    graph.communicate(timeout=60)

    assert graph.returncode == -signal.SIGKILL


@pytest.mark.parametrize(
    ("package", "executable", "message"),
    [
        ("fake", "nothing", r"There is no executable 'nothing' in package 'fake'\."),
        ("nothing", "forever", r"There is no package 'nothing' in this environment\."),
    ],
)
def test_what_is_missing_is_said_before_anything_starts(package: str, executable: str, message: str) -> None:
    said: list[str] = []
    nodes = [NodeSpec("fake", "forever", "one"), NodeSpec(package, executable, "two")]

    with pytest.raises(processes.GraphError, match=message):
        processes.run_graph(nodes, said.append)
    assert not said
