"""The sweep that is measured has as many replays as it says, and evo finds the errors that we find."""

from __future__ import annotations

from pathlib import Path

import pytest

from swarm_loc_estimator.offline.sweep.sweep import read_sweep

sweep = pytest.importorskip("bench.sweep", exc_type=ImportError)


def test_both_sweeps_have_the_same_replays(tmp_path: Path) -> None:
    sweep.prepare(tmp_path, 0.5)
    one, two = (read_sweep(tmp_path / f"on{workers}.yaml") for workers in (1, 2))
    assert (one.workers, two.workers) == (1, 2)
    assert len(one.jobs) == sweep.REPLAYS
    assert [job.key for job in one.jobs] == [job.key for job in two.jobs]


def test_evo_finds_the_same_errors(tmp_path: Path) -> None:
    sweep.prepare(tmp_path, 5.0)
    assert sweep.evo_difference_m(tmp_path / sweep.NAMES[0], tmp_path) < 1e-9
