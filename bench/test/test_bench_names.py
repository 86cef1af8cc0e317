"""Benchmarks can be run by their names; readers find the same before their speed is compared."""

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from bench.__main__ import BENCHMARKS
from bench.peers import reading
from bench.shared.bags import copy_part
from bench.shared.common import DEMO_BAG
from swarm_loc_estimator.common.messages.cdr import DETECTIONS, ODOMETRY


@pytest.mark.parametrize("module", BENCHMARKS.values())
def test_a_benchmark_can_be_run(module: str) -> None:
    spec = find_spec(module)
    assert spec is not None
    assert spec.submodule_search_locations is None or find_spec(f"{module}.__main__") is not None


def test_a_name_that_is_none_is_answered_by_those_that_are() -> None:
    command = [sys.executable, "-m", "bench", "nonsense"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.startswith("'nonsense' is no benchmark; there are aerial, ")


@pytest.fixture
def second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The first second of the demo's bag."""
    monkeypatch.setattr(reading, "REPEATS", 1)
    copy_part(DEMO_BAG, tmp_path / "second", 1.0)
    return tmp_path / "second"


def test_a_second_of_the_demo_is_measured_with_all_readers(second: Path) -> None:
    results = {kind: reading.measure(second, kind, times=2) for kind in (ODOMETRY, DETECTIONS)}
    reading.report(results, second)
    figures = json.loads((second / "bench" / "reading.json").read_text(encoding="utf-8"))
    readers = {"mcap.this", "mcap.mcap", "mcap.rosbags", "sqlite3.this", "sqlite3.rosbags"}
    assert {key.partition(".")[2].rpartition(".")[0] for key in figures} == readers
    assert all(value > 0.0 for value in figures.values())
    assert (second / "reading.png").exists()


def test_a_reader_that_finds_something_else_is_not_compared(
    second: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forgetful(recording: reading.Recording) -> reading.Figures:
        found = reading.with_rosbags(recording)
        return found._replace(numbers=found.numbers[1:])

    monkeypatch.setitem(reading.READERS["mcap"], "forgetful", forgetful)
    with pytest.raises(RuntimeError, match=r"forgetful reads something else from .* as mcap"):
        reading.measure(second, ODOMETRY, times=1)
