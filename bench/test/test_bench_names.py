"""Every benchmark's name leads to a module that can be run."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec

import pytest

from bench.__main__ import BENCHMARKS


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
