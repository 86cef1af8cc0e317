"""The cache of compiled code: used again, and never for other sources than those it was made of."""

import fcntl
import os
import subprocess
import sys
import time
from pathlib import Path

USED = """
from swarm_loc_estimator.common.jit import compiled

@compiled
def factor() -> float:
    return {factor}
"""
USING = """
from pathlib import Path
from swarm_loc_estimator.common.jit import compiled, is_warm, note_warm
from used import factor

@compiled
def doubled() -> float:
    return 2.0 * factor()

here = Path(__file__)
print(is_warm(here), doubled(), sum(doubled.stats.cache_hits.values()))
note_warm(here)
"""


def run(folder: Path, cache: Path) -> list[str]:
    env = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    # Without byte code: Python takes that of a source of the same second and size for its own.
    command = [sys.executable, "-B", str(folder / "using.py")]
    return subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout.split()


def test_a_change_in_another_file_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "using.py").write_text(USING, encoding="utf-8")
    said = []
    for factor in ("1.5", "1.5", "2.5"):
        (tmp_path / "used.py").write_text(USED.format(factor=factor), encoding="utf-8")
        said.append(run(tmp_path, tmp_path / "cache"))
    assert said == [["False", "3.0", "0"], ["True", "3.0", "1"], ["False", "5.0", "0"]]


def test_caches_of_sources_long_gone_are_deleted(tmp_path: Path) -> None:
    (tmp_path / "using.py").write_text(USING, encoding="utf-8")
    (tmp_path / "used.py").write_text(USED.format(factor="1.5"), encoding="utf-8")
    cache = tmp_path / "cache" / "swarm_loc_estimator"
    for name, age_s in (("old", 31 * 86400.0), ("recent", 29 * 86400.0)):
        (cache / name / "source").mkdir(parents=True)
        (cache / name / "source" / "code.nbc").touch()
        os.utime(cache / name, times=(0.0, time.time() - age_s))
    run(tmp_path, tmp_path / "cache")
    assert not (cache / "old").exists()
    assert (cache / "recent" / "source" / "code.nbc").exists()
    (own,) = (one for one in cache.iterdir() if (one / "warm").exists())
    os.utime(own, times=(0.0, 0.0))
    assert run(tmp_path, tmp_path / "cache")[0] == "True"  # in use, however old
    assert own.stat().st_mtime > time.time() - 86400.0


SAVING = """
from pathlib import Path
from swarm_loc_estimator.common.jit import _cache_folder, compiled

@compiled
def one() -> float:
    return 1.0

print(_cache_folder(Path(__file__)), flush=True)
input()
print(one())
"""


def test_what_is_compiled_is_saved_by_one_process_at_a_time(tmp_path: Path) -> None:
    (tmp_path / "saving.py").write_text(SAVING, encoding="utf-8")
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, str(tmp_path / "saving.py")]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, env=env, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        folder = Path(process.stdout.readline().strip())
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
            while not waits_for_a_lock(process.pid):
                assert process.poll() is None
                time.sleep(0.01)
            assert not [*folder.rglob("*.nbi")]
        assert process.communicate()[0] == "1.0\n"
    assert [*folder.rglob("*.nbi")]


def waits_for_a_lock(pid: int) -> bool:
    lines = Path("/proc/locks").read_text(encoding="utf-8").splitlines()
    return any("->" in line and str(pid) in line.split() for line in lines)
