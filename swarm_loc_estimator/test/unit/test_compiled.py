"""The cache of compiled code: used again, and never for other sources than those it was made of."""

import os
import subprocess
import sys
from pathlib import Path

USED = """
from swarm_loc_estimator.core.compiled import compiled

@compiled
def factor() -> float:
    return {factor}
"""
USING = """
from pathlib import Path
from swarm_loc_estimator.core.compiled import compiled, is_warm, note_warm
from used import factor

@compiled
def doubled() -> float:
    return 2.0 * factor()

here = Path(__file__).parent
print(is_warm(here), doubled(), sum(doubled.stats.cache_hits.values()))
note_warm(here)
"""


def run(folder: Path, cache: Path) -> list[str]:
    env = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, str(folder / "using.py")]
    return subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout.split()


def test_a_change_in_another_file_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "using.py").write_text(USING, encoding="utf-8")
    said = []
    for factor in ("1.5", "1.5", "2.5"):
        (tmp_path / "used.py").write_text(USED.format(factor=factor), encoding="utf-8")
        said.append(run(tmp_path, tmp_path / "cache"))
    assert said == [["False", "3.0", "0"], ["True", "3.0", "1"], ["False", "5.0", "0"]]
