"""The cache of compiled code: found again wherever the sources lie, and never used for other code."""

import hashlib
import os
import pickle
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from llvmlite import binding

USED = """
from typing import NamedTuple
from swarm_loc_estimator.common import jit as tool

import math
FACTOR = 1.5
OFFSETS = (0.0, 0.25)
ROOT = math.sqrt

class Record(NamedTuple):
    low: float
    high: float

@tool.cached_njit
def factor(record: Record) -> float:
    \"\"\"The factor.\"\"\"
    return FACTOR * record.low + OFFSETS[0] + rest(0.0)

@tool.cached_njit
def rest(zero: float, more: float = 0.0) -> float:
    return ROOT(zero) + more
"""
USING = """
import used
from swarm_loc_estimator.common.jit import cached_njit, is_precompiled, note_precompiled

@cached_njit
def doubled(record: used.Record) -> float:
    return 2.0 * used.factor(record)

def precompile() -> None:
    doubled(used.Record(1.0, 3.0))

was = is_precompiled(precompile)
print(was, doubled(used.Record(1.0, 3.0)), sum(doubled.stats.cache_hits.values()))
note_precompiled(precompile)
"""


def run(folder: Path, cache: Path, used: str = USED) -> list[str]:
    return run_with_errors(folder, cache, used).stdout.split()


def run_with_errors(folder: Path, cache: Path, used: str = USED) -> subprocess.CompletedProcess[str]:
    folder.mkdir(exist_ok=True)
    (folder / "used.py").write_text(used, encoding="utf-8")
    (folder / "using.py").write_text(USING, encoding="utf-8")
    env = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    # Without byte code: Python takes that of a source of the same second and size for its own.
    command = [sys.executable, "-B", str(folder / "using.py")]
    return subprocess.run(command, env=env, capture_output=True, text=True, check=True)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache in which the code of `USED` has been compiled."""
    folder = tmp_path_factory.mktemp("compiled")
    assert run(folder / "first", folder / "cache") == ["False", "3.0", "0"]
    return folder / "cache"


@pytest.fixture
def cache(tmp_path: Path, compiled: Path) -> Path:
    """A copy of it, for one test."""
    return shutil.copytree(compiled, tmp_path / "cache")


def test_code_is_found_again_in_another_folder_and_in_a_copy_of_the_cache(
    tmp_path: Path, cache: Path
) -> None:
    assert run(tmp_path / "another clone", cache)[1:] == ["3.0", "1"]
    copy = shutil.copytree(cache, tmp_path / "copy")
    assert run(tmp_path / "first", copy)[1:] == ["3.0", "1"]


def test_code_that_a_package_ships_is_used_unless_others_can_write_it(tmp_path: Path, compiled: Path) -> None:
    folder = tmp_path / "first"
    shipped = shutil.copytree(compiled / "swarm_loc_estimator", folder / "swarm_loc_compiled")
    assert run(folder, tmp_path / "cache") == ["True", "3.0", "1"]
    assert not list((tmp_path / "cache" / "swarm_loc_estimator").glob("*.nbc"))
    shipped.chmod(0o777)
    assert run(folder, tmp_path / "another cache") == ["False", "3.0", "0"]


def test_code_is_for_the_same_cpu_on_all_machines_that_have_its_features() -> None:
    features = {name for name, has in binding.get_host_cpu_features().items() if has}
    expected = "x86-64-v3" if {"avx2", "bmi2", "fma"} <= features else None
    if expected is None:
        pytest.skip("this CPU has less than x86-64-v3")
    core = "jit._core.registry.cpu_target.target_context.codegen()"
    script = f"from swarm_loc_estimator.common import jit; print({core}.magic_tuple()[1])"
    for given, found in (({}, expected), ({"NUMBA_CPU_NAME": "generic"}, "generic")):
        env, command = {**os.environ, **given}, [sys.executable, "-c", script]
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
        assert done.stdout.strip() == found


def test_docstrings_comments_and_lines_do_not_matter(tmp_path: Path, cache: Path) -> None:
    changed = "# a comment\n\n" + USED.replace("The factor.", "What a record is scaled by.")
    assert run(tmp_path / "first", cache, changed)[1:] == ["3.0", "1"]


@pytest.mark.parametrize(
    ("old", "new", "result"),
    [
        ("FACTOR = 1.5", "FACTOR = 2.5", "5.0"),
        ("FACTOR = 1.5", "FACTOR = 2", "4.0"),
        ("(0.0, 0.25)", "(0.25, 0.0)", "3.5"),
        ("+ OFFSETS[0]", "- OFFSETS[1]", "2.5"),
        ("    low: float\n    high: float", "    high: float\n    low: float", "9.0"),
        ("tool.cached_njit", "tool.reassociated_njit", "3.0"),
        ("more: float = 0.0", "more: float = 0.5", "4.0"),
        ("ROOT = math.sqrt", "ROOT = math.cos", "5.0"),
    ],
)
def test_a_change_of_what_is_called_is_noticed(
    tmp_path: Path, cache: Path, old: str, new: str, result: str
) -> None:
    assert old in USED
    assert run(tmp_path / "first", cache, USED.replace(old, new)) == ["False", result, "0"]


@pytest.mark.parametrize("damage", ["cut off", "one bit"])
def test_a_damaged_file_is_compiled_again(tmp_path: Path, cache: Path, damage: str) -> None:
    for file in cache.rglob("*.nbc"):
        data = bytearray(file.read_bytes())
        data[len(data) // 2] ^= 4
        file.write_bytes(data if damage == "one bit" else data[:100])
    assert run(tmp_path / "first", cache)[1:] == ["3.0", "0"]
    assert run(tmp_path / "first", cache)[1:] == ["3.0", "1"]


class Planted:
    """Data that run a command where they are read."""

    def __init__(self, mark: Path) -> None:
        self._command = f"touch '{mark}'"

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (self._command,)


def given_away(path: Path) -> None:
    """Make a path another user's, which only root can."""
    if os.geteuid():
        pytest.skip("only root can give files away")
    os.chown(path, 65534, 65534, follow_symlinks=False)


@pytest.mark.parametrize("place", ["folder", "file", "link"])
@pytest.mark.parametrize("fault", ["all", "group", "owner"])
def test_code_that_others_could_have_planted_does_not_run(
    tmp_path: Path, cache: Path, place: str, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    code, mark = pickle.dumps(Planted(tmp_path / "ran")), tmp_path / "ran"
    files, folder = [*cache.rglob("*.nbc")], cache / "swarm_loc_estimator"
    for file in files:
        file.write_bytes(hashlib.sha256(code).digest() + code)
    if place == "link":
        folder.rename(tmp_path / "elsewhere")
        folder.symlink_to(tmp_path / "elsewhere")
    for path in files if place == "file" else [folder]:
        if fault == "owner":
            given_away(path)
        else:
            path.chmod(0o777 if fault == "all" else 0o775)

    said = run_with_errors(tmp_path / "first", cache)
    assert said.stdout.split()[1:] == ["3.0", "0"]
    assert not mark.exists()
    assert said.stderr.count("that others than this user and root own or can write") == 1
    if place == "file":  # replaced by own ones
        assert run_with_errors(tmp_path / "first", cache).stderr == ""
    else:  # that in the home is used
        assert (tmp_path / "home/.cache/swarm_loc_estimator").stat().st_mode & 0o777 == 0o700
        assert run(tmp_path / "first", cache)[2] == "1"


@pytest.mark.parametrize("umask", [0o002, 0o000, 0o077])
def test_own_code_is_found_again_whatever_the_umask(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        assert run(tmp_path / "first", tmp_path / "new")[2] == "0"
        assert run(tmp_path / "first", tmp_path / "new")[2] == "1"
    finally:
        os.umask(before)


def test_without_a_safe_folder_code_is_kept_for_one_process(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    for folder in (cache / "swarm_loc_estimator", tmp_path / "home/.cache/swarm_loc_estimator"):
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o777)
    assert run(tmp_path / "first", cache) == ["False", "3.0", "0"]
    assert not [*tmp_path.glob("swarm_loc_estimator_*")]


def test_processes_that_compile_at_once_leave_whole_files(tmp_path: Path, compiled: Path) -> None:
    cache = tmp_path / "cache"
    env = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-B", str(compiled.parent / "first" / "using.py")]
    together = [subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) for _ in range(4)]
    assert {process.communicate()[0].split()[1] for process in together} == {"3.0"}
    assert [process.returncode for process in together] == [0] * 4
    assert not [*cache.rglob("*.part")]
    assert run(tmp_path / "first", cache)[1:] == ["3.0", "1"]


def test_code_that_nobody_has_used_for_a_month_is_deleted(tmp_path: Path, cache: Path) -> None:
    folder = cache / "swarm_loc_estimator"
    for name, age_s in (("old", 31 * 86400.0), ("recent", 29 * 86400.0)):
        (folder / f"{name}.nbc").touch()
        os.utime(folder / f"{name}.nbc", times=(0.0, time.time() - age_s))
    own = {file for file in folder.iterdir() if file.stem not in {"old", "recent"}}
    for file in own:
        os.utime(file, times=(0.0, time.time() - 40 * 86400.0))
    used = [file for file in own if file.name.startswith(("doubled", "precompiled"))]
    assert run(tmp_path / "first", cache)[2] == "1"
    assert not (folder / "old.nbc").exists()
    assert (folder / "recent.nbc").exists()
    assert all(file.stat().st_mtime > time.time() - 86400.0 for file in used)
