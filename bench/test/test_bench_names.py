"""Benchmarks can be run by their names; readers and sweeps find the same before their speed is compared."""

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import cast

import pytest

from bench.__main__ import BENCHMARKS
from bench.peers import reading
from bench.shared.bags import copy_part
from bench.shared.common import DEMO_BAG
from swarm_loc_estimator.common.messages.cdr import DETECTIONS, ODOMETRY
from swarm_loc_estimator.offline.sweep.sweep import read_sweep


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


@pytest.fixture
def sweep() -> ModuleType:
    """The benchmark of sweeps, where Ray is installed."""
    return cast("ModuleType", pytest.importorskip("bench.sweep", exc_type=ImportError))


def test_both_sweeps_have_the_same_replays(tmp_path: Path, sweep: ModuleType) -> None:
    sweep.prepare(tmp_path, 0.5)
    one, two = (read_sweep(tmp_path / f"on{workers}.yaml") for workers in (1, 2))
    assert (one.workers, two.workers) == (1, 2)
    assert len(one.jobs) == sweep.REPLAYS
    assert [job.key for job in one.jobs] == [job.key for job in two.jobs]


def test_evo_finds_the_same_errors(tmp_path: Path, sweep: ModuleType) -> None:
    sweep.prepare(tmp_path, 5.0)
    assert sweep.evo_difference_m(tmp_path / sweep.NAMES[0], tmp_path) < 1e-9
