"""Compiled code: the cache, its wheel, and what is compiled at start."""

import hashlib
import json
import os
import pickle
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast
from zipfile import ZipFile

import numpy as np
import pytest
from compiled_code import compiled_since, printed_by_process, signatures
from llvmlite import binding

from bench.shared.bags import SharedHead, copy_part, encode_shared_detections, encode_shared_numbers
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE, swarm_key
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.mapping.mapper_feed import fix_covariance
from swarm_loc_estimator.mapping.settings import MapperSettings
from swarm_loc_estimator.nodes.load import Thinning
from swarm_loc_estimator.nodes.mapper_precompile import precompile as precompile_mapper
from swarm_loc_estimator.offline.map_replay import replay_map
from swarm_loc_estimator.offline.recorded_bag import read_bag, unwatched
from swarm_loc_estimator.precompile import Size, precompile, size_of
from swarm_loc_estimator.sensors.inputs import Batch, Ingest
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings

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


BAGS = Path(__file__).parents[3] / "bags"
SECOND = 1_000_000_000
SPAN_NS = 12 * SECOND
RECORDED = ("aerial_five", "droplets_twenty", "eight_five_robots")


# Each of these takes as long to import as numpy; that of linear algebra is loaded with compiled code.
SLOW = tuple(f"scipy.{part}" for part in ("interpolate", "ndimage", "optimize", "spatial", "special"))


class EnoughError(Exception):
    """The beginning of a bag is enough."""


@pytest.mark.parametrize("size", ["small", "large", "sparse"])
def test_nothing_is_compiled_once_data_come(size: Size) -> None:
    assert printed_by_process(__file__, size) == []


def test_robots_that_see_markers_start_without_the_slow_parts_of_scipy() -> None:
    started = (
        "from swarm_loc_estimator.precompile import precompile\n"
        "precompile('small', False)\n"
        f"import sys; print([part for part in {SLOW} if part in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", started], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(
    ("name", "settings", "size"),
    [
        ("eight_five_robots", Settings(), "small"),
        ("droplets_twenty", Settings(), "large"),
        ("droplets_twenty", Settings(sparse_from=20), "sparse"),
        ("droplets_twenty", Settings(sparse_from=20, fusion_period_s=0.0), "large"),
    ],
)
def test_what_is_compiled_follows_the_size_of_the_swarm(name: str, settings: Settings, size: Size) -> None:
    assert size_of(load_swarm(BAGS / name / "swarm.yaml"), settings) == size


def compiled_late(size: Size) -> list[str]:
    """What is compiled when robots are replayed though all is warm; in a process of its own."""
    for infrared in (False, True):
        precompile(size, infrared)
    before = signatures()
    eight = BAGS / "eight_five_robots"
    if size == "sparse":
        estimate(eight, Settings(sparse_from=2))
        estimate(eight, Settings(sparse_from=2), relayed=True)
        estimate(BAGS / "droplets_twenty", Settings(sparse_from=2))
    elif size == "large":
        together = Settings(fusion_period_s=0.1, policy=Policy(large_from=2))
        for name in RECORDED:
            estimate(BAGS / name, together)
        estimate(eight, together, relayed=True)
    else:
        for name in RECORDED:
            estimate(BAGS / name, Settings(policy=Policy(large_from=100)))
        estimate(eight, Settings(), late=True)
        estimate(eight, Settings(), moved_landmarks=True)
        estimate(eight, Settings(), relayed=True)
    return compiled_since(before)


def estimate(
    bag: Path, settings: Settings, *, late: bool = False, moved_landmarks: bool = False, relayed: bool = False
) -> None:
    """Estimate the beginning of a bag as the node does; relayed: by shared topics, half of it left out."""
    swarm = load_swarm(bag / "swarm.yaml")
    if moved_landmarks:
        marks = (replace(mark, x=mark.x + 0.3 * (k % 3)) for k, mark in enumerate(swarm.landmarks))
        swarm = replace(swarm, landmarks=tuple(marks))
    estimator, begun_ns = Estimator(swarm, settings), list[int]()
    thinning, ingest = Thinning(len(swarm.robots)), Ingest(swarm)

    def take(inputs: Batch) -> None:
        begun_ns.append(inputs.begin_ns)
        if inputs.begin_ns - begun_ns[0] > SPAN_NS:
            raise EnoughError
        rows = inputs["odometry"]
        turned = type(rows)(*(column[::-1].copy() for column in rows))
        inputs = replace(inputs, rows={**inputs.rows, "odometry": turned}) if late else inputs
        if relayed:
            inputs = thinning.thin(shared(inputs, ingest, swarm), 0.5).messages
        estimator.receive(inputs)
        estimator.tick(inputs.end_ns)
        estimator.contradictions(inputs.end_ns)
        estimator.recent()

    _quietly(lambda: read_bag(bag, swarm, take, unwatched))


def shared(inputs: Batch, ingest: Ingest, swarm: Swarm) -> Batch:
    """The same by topics that all robots share."""
    key, now_ns = swarm_key(robot.name for robot in swarm.robots), inputs.end_ns
    odometry, seen = (
        SharedHead(now_ns, "odom", key, rows.robot, rows.stamp_ns)
        for rows in (inputs["odometry"], inputs["detections"])
    )
    seen_detections = inputs["detections"].detection if seen.robot.size else np.zeros(0, DETECTION_DTYPE)
    messages = {
        "swarm/odom": encode_shared_numbers(odometry, inputs["odometry"].pose),
        "swarm/detections": encode_shared_detections(seen, seen_detections),
    }
    batch = MessageBatch.of(
        [SerializedMessage(ingest.handle_of[name], data, now_ns) for name, data in messages.items()]
    )
    (relayed,) = ingest.read(batch)
    return relayed


def _quietly(work: Callable[[], object]) -> None:
    try:
        work()
    except EnoughError:
        return


BAG = Path(__file__).parents[3] / "bags" / "pushbots_two"
FREQUENCIES = {"pushbot1": 1000.0, "pushbot2": 1050.0}


def test_nothing_is_compiled_once_robots_report() -> None:
    assert printed_by_process(__file__) == []


def compiled_late_by_mapper() -> list[str]:
    precompile_mapper()
    before = signatures()
    swarm = load_swarm(BAG / "swarm.yaml")
    with TemporaryDirectory() as folder:
        begin = Path(folder, "begin")
        copy_part(BAG, begin, 80.0)  # the rest of the bag calls the same functions
        mapper, feed, _ = replay_map(begin, swarm, MapperSettings(), FREQUENCIES, lambda _share, _what: None)
    for index in range(len(swarm.robots)):
        number = feed.number(index)
        goal = None if number is None else mapper.goal(number)
        if number is not None and goal is not None:
            fix_covariance(mapper.covariance(number))
        mapper.visits.on(mapper.occupancy())
    return compiled_since(before)


if __name__ == "__main__":
    late = compiled_late(cast("Size", sys.argv[1])) if sys.argv[1:] else compiled_late_by_mapper()
    json.dump(late, sys.stdout)


PACKAGE = Path(__file__).parents[2]
FAST = PACKAGE.parent / "bags" / "eight_one_robot_fast"
BUILD = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
SWARM_LOC = """
import sys

class Refused:
    def find_spec(self, name, path=None, target=None):
        package = name.partition(".")[0]
        if package.endswith("_msgs") or package in {"ament_index_python", "launch", "rclpy", *REFUSED}:
            raise ModuleNotFoundError(f"{name} is refused", name=name)

sys.meta_path.insert(0, Refused())
from swarm_loc_estimator.start import swarm_loc

def run(*arguments):
    sys.argv[:] = ["/somewhere/bin/swarm-loc", *arguments]
    try:
        return swarm_loc()
    except SystemExit as end:
        return end.code
"""
COMMANDS = {
    *("calibrate", "calibrate_ir", "doctor", "import_droplets", "import_mrclam", "new"),
    *("replay", "replay_map", "schema", "survey", "sweep"),
}
NODES = {"estimator_node", "localizer_bridge", "mapper_node", "markers_node", "play", "watch_node"}
STARTERS = {"demo", "graph", "watch"}  # Commands that start nodes


def python(
    code: str, *arguments: str, path: Path = PACKAGE, refused: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run code after `SWARM_LOC` where nothing of ROS can be imported, with a package from a folder."""
    env = {name: value for name, value in os.environ.items() if name != "AMENT_PREFIX_PATH"}
    program = f"REFUSED = {refused.split()}\n{SWARM_LOC}\n{code}"
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(
        command, env={**env, "PYTHONPATH": str(path)}, capture_output=True, text=True, check=False, cwd=path
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> ZipFile:
    """The wheel, built of a copy of the package that has nothing beside it."""
    folder = tmp_path_factory.mktemp("wheel")
    copy = folder / "package"
    shutil.copytree(
        PACKAGE, copy, ignore=shutil.ignore_patterns("test", "__pycache__", "*.egg-info", "build")
    )
    subprocess.run([sys.executable, "-c", BUILD, folder], cwd=copy, check=True, capture_output=True)
    (built,) = folder.glob("swarm_loc_estimator-*-py3-none-any.whl")
    return ZipFile(built)


def test_a_wheel_has_all_files_of_the_package(wheel: ZipFile) -> None:
    root = PACKAGE / "swarm_loc_estimator"
    files = {path for path in root.rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    files |= set((root / "common" / "messages" / "msg").iterdir())
    names = {str(path.relative_to(PACKAGE)) for path in files}
    assert names == {name for name in wheel.namelist() if name.startswith("swarm_loc_estimator/")}
    assert "swarm_loc_estimator/common/messages/msg/SwarmPose.msg" in names


def test_it_has_one_program_and_the_license(wheel: ZipFile) -> None:
    (entries,) = [name for name in wheel.namelist() if name.endswith("/entry_points.txt")]
    assert wheel.read(entries).decode().split() == [
        *("[console_scripts]", "swarm-loc", "=", "swarm_loc_estimator.start:swarm_loc")
    ]
    assert [name for name in wheel.namelist() if name.endswith("/LICENSE")]


def test_it_replays_a_bag_with_its_plots_without_ros(wheel: ZipFile, tmp_path: Path) -> None:
    wheel.extractall(tmp_path / "site")
    shutil.copytree(FAST, tmp_path / "bag")
    out = tmp_path / "out"
    code = "status = run('replay', *sys.argv[1:]); print(swarm_loc.__globals__['__file__']); sys.exit(status)"
    done = python(code, str(tmp_path / "bag"), "--out", str(out), path=tmp_path / "site")
    assert done.returncode == 0, done.stderr
    assert "NEES" in done.stdout
    assert done.stdout.splitlines()[-1] == str(tmp_path / "site" / "swarm_loc_estimator" / "start.py")
    made = {"errors.png", "overview.png", "poses.csv", "report.html", "report.txt"}
    assert {path.name for path in out.iterdir()} == made


def test_swarm_loc_lists_all_commands_and_loads_little() -> None:
    code = "run(*sys.argv[1:]); print(*sys.modules, file=sys.stderr)"
    listed, asked = python(code), python(code, "--help")
    assert listed.stdout == asked.stdout
    without, _, with_ros = listed.stdout.partition("With ROS 2:")
    assert {line.split()[0] for line in without.splitlines() if line.startswith("  ")} == COMMANDS
    assert {line.split()[0] for line in with_ros.splitlines() if line} == NODES | STARTERS
    assert "  replay           Replay a bag through the estimator: poses, " in without
    assert not {"numpy", "swarm_loc_estimator.cli"} & set(listed.stderr.split())


def test_commands_run_without_ros_and_the_others_say_that_they_need_it() -> None:
    names = sorted(COMMANDS | NODES | STARTERS)
    code = "print(*[name for name in sys.argv[1:] if run(name, '--help') == 1], file=sys.stderr)"
    done = python(code, *names)
    *sentences, failed = done.stderr.splitlines()
    assert set(failed.split()) == NODES | {"demo"}
    assert [one.split(":")[0] for one in sentences] == [
        f"swarm-loc {name} needs ROS 2 and this workspace, built and sourced" for name in failed.split()
    ]
    for name in COMMANDS:
        assert f"usage: swarm-loc {name} [-h]" in done.stdout


@pytest.mark.parametrize("name", ["graph", "watch"])
def test_commands_that_start_nodes_say_so_once_they_start_them(name: str) -> None:
    done = python("sys.exit(run(*sys.argv[1:]))", name, str(FAST / "swarm.yaml"))
    assert done.returncode == 1
    (sentence,) = done.stderr.splitlines()
    assert sentence.startswith(f"swarm-loc {name} needs ROS 2")


def test_a_bag_without_the_libraries_for_bags_ends_with_one_sentence() -> None:
    done = python("sys.exit(run(*sys.argv[1:]))", "replay", str(FAST), refused="rosbags mcap")
    assert done.returncode == 1
    assert done.stderr == (
        "swarm-loc replay needs the Python package rosbags, which is not installed:"
        " pip install lz4 mcap rosbags zstandard.\n"
    )


def test_an_unknown_command_is_one_sentence() -> None:
    done = python("sys.exit(run(*sys.argv[1:]))", "reply")
    assert (done.returncode, done.stderr) == (
        2,
        "swarm-loc has no command 'reply'; swarm-loc --help lists them.\n",
    )
