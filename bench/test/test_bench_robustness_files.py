"""Outputs on full disks, and with things in the way: nothing is cut, and careless commands are seen."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bench.robustness.commands import COMMANDS, Command
from bench.robustness.files import KINDS, Place, Trials, place

CARELESS = """
import sys
from pathlib import Path

def write():
    Path(sys.argv[1]).write_bytes(bytes(range(256)) * 40)
"""
CAREFUL = """
import sys
from pathlib import Path
from swarm_loc_estimator.common.command_line import exit_with_message
from swarm_loc_estimator.common.files import write_whole

@exit_with_message
def write():
    write_whole(Path(sys.argv[1]), "".join(map(str, range(4000))))
    return 0
"""


@pytest.fixture(scope="module")
def here() -> Iterator[Place]:
    with place() as one:
        yield one


@pytest.mark.parametrize("name", ["new", "generate_bag_eight"])
def test_real_commands_leave_nothing_cut(name: str, here: Place) -> None:
    trials = Trials(next(one for one in COMMANDS if one.name == name), here)
    sizes = trials.spread(20)
    trials.full_at(np.random.default_rng(len(name)).choice(sizes, 2, replace=False))
    trials.in_the_way()
    assert trials.counts["tried"] > 4
    assert not trials.faults


@pytest.mark.parametrize(("text", "faults"), [(CARELESS, {*KINDS} - {"tried"}), (CAREFUL, set())])
def test_what_a_careless_command_does_is_counted(
    text: str, faults: set[str], here: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "careless").mkdir()
    (tmp_path / "careless/start.py").write_text(text, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    trials = Trials(Command("careless write", "{out}/a", "a"), here)
    trials.full_at(trials.spread(3))
    trials.in_the_way()
    assert {kind for kind in KINDS if trials.counts[kind]} - {"tried"} == faults
