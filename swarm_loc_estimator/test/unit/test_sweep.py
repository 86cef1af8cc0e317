"""Sweeps: the grid, what is refused, resumed runs, failed jobs, the same table from any number of workers."""

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from bench.shared.bags import copy_part
from swarm_loc_estimator.cli.sweep import main
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.offline.recorded_bag import Loss
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.sweep import sweep as sweeping
from swarm_loc_estimator.offline.sweep.report import Row, _span, write_results
from swarm_loc_estimator.offline.sweep.sweep import (
    FIGURES,
    Backend,
    BackendError,
    Job,
    SweepFileError,
    outcome,
    read_sweep,
    workers,
)
from swarm_loc_estimator.timeline.settings import Settings

DEMO = Path(__file__).parents[3] / "bags" / "eight_one_robot_fast"
GRID = "settings: {horizon_s: [0.1, 2]}\nlost: [0, 0.3]\nseeds: [1, 2]\nworkers: 1\n"


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweep") / "short"
    copy_part(DEMO, folder, 3.0)
    shutil.copy(DEMO / "swarm.yaml", folder)
    return folder


@pytest.fixture
def folder(short: Path, tmp_path: Path) -> Path:
    """A folder with this bag, to which other files may be added."""
    shutil.copytree(short, tmp_path / "short")
    return tmp_path


def written(folder: Path, text: str, name: str = "sweep.yaml") -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def run(file: Path, *more: str) -> int:
    return main([str(file), "--out", str(file.parent / "out"), *more])


def table(folder: Path) -> str:
    return (folder / "out" / "table.csv").read_text(encoding="utf-8")


def finished(folder: Path) -> Path:
    return folder / "out" / "jobs.jsonl"


def test_every_combination_is_a_job_in_the_order_of_the_file(folder: Path) -> None:
    shutil.copytree(folder / "short", folder / "again")
    written(folder, "fileversion: 1\nrobots: {alone: {}}", "other.yaml")
    bags = "bags: [short, 'a*', '*']\nswarms: [short/swarm.yaml, other.yaml]\n"
    sweep = read_sweep(written(folder, bags + GRID))
    assert len(sweep.jobs) == 2 * 2 * 2 * 3  # where nothing is lost, seeds do not matter
    assert [*sweep.jobs[0].cells] == ["bag", "swarm", "horizon_s", "lost", "seed"]
    rows = [tuple(job.cells.values()) for job in sweep.jobs]
    assert rows[:4] == [
        ("short", "short/swarm.yaml", 0.1, 0.0, None),
        ("short", "short/swarm.yaml", 0.1, 0.3, 1),
        ("short", "short/swarm.yaml", 0.1, 0.3, 2),
        ("short", "short/swarm.yaml", 2.0, 0.0, None),
    ]
    assert rows[6][:2] == ("short", "other.yaml")
    assert rows[12][:2] == ("again", "short/swarm.yaml")
    assert sweep.varied == ("swarm", "horizon_s", "lost")
    assert (sweep.jobs[4].settings.horizon_s, sweep.jobs[4].loss.share, sweep.jobs[4].loss.seed) == (
        2.0,
        0.3,
        1,
    )
    assert len({job.key for job in sweep.jobs}) == 12  # both bags have the same content


def test_a_job_is_another_when_anything_changes_that_determines_its_result(folder: Path) -> None:
    def key(text: str = "") -> str:
        return read_sweep(written(folder, f"bags: [{bag}]\n{text}")).jobs[0].key

    bag = "short"
    first = key()
    assert first == key("settings: {horizon_s: [2.0]}")  # the default
    assert len({first, key("settings: {horizon_s: [1.9]}"), key("lost: [0.1]")}) == 3
    bag = "mapped"
    shutil.copytree(folder / "short", folder / bag)
    with (folder / bag / "swarm.yaml").open("a", encoding="utf-8") as description:
        description.write("map: floor.yaml\n")
    keys = set()
    for size in (4, 5):
        save_map(OccupancyMap(np.zeros(2), 0.1, np.ones((size, size))), folder / bag / "floor.yaml")
        keys.add(key())
    assert len({first, *keys}) == 3
    bag = "described"
    shutil.copytree(folder / "short", folder / bag)
    described = folder / bag / "swarm.yaml"
    text = described.read_text(encoding="utf-8")
    described.write_text(text + "# a comment\n", encoding="utf-8")
    assert key() == first
    bag = "renamed"
    shutil.copytree(folder / "short", folder / bag)
    (folder / bag / "swarm.yaml").write_text("fileversion: 1\nrobots: {alone: {}}", encoding="utf-8")
    assert key() != first
    bag = "longer"
    copy_part(DEMO, folder / bag, 3.5)
    shutil.copy(DEMO / "swarm.yaml", folder / bag)
    assert key() != first


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the file lacks bags"),
        ("bags: []", "bags is [] but must be a list of at least one value, each once"),
        ("bags: short", "bags is 'short' but must be a list"),
        ("bags: [shirt]", "bags[0] is 'shirt' but must be a bag or a pattern of bags"),
        ("bags: [short, 'x*']", "bags[1] is 'x*' but must be a bag or a pattern of bags"),
        ("seed: [1]", "'seed' is not a known key; the nearest one is 'seeds'"),
        ("settings: {horizon: [1]}", "'settings.horizon' is not a known key; the nearest one is"),
        ("settings: {horizon_s: 1}", "settings.horizon_s is 1 but must be a list"),
        ("settings: {horizon_s: [1, 99]}", "parameter settings.horizon_s[1] = 99.0 must lie in [0.05, 60] s"),
        ("lost: [0, 1]", "parameter lost[1] = 1.0 must lie in [0, 0.99]"),
        ("fit: {trials: 9}", "fit lacks ranges"),
        ("fit: {trials: 9, ranges: {}}", "must name at least one setting"),
        ("fit: {trials: 1, ranges: {horizon_s: [1, 2]}}", "must lie in [2, 10000]"),
        (
            "fit: {trials: 9, ranges: {horizon_s: [2, 1]}}",
            "fit.ranges.horizon_s is [2, 1] but must be its least and its greatest value",
        ),
        (
            "fit: {trials: 9, ranges: {horizon_s: [1, 99]}}",
            "parameter fit.ranges.horizon_s = 99.0 must lie in [0.05, 60] s",
        ),
        (
            "settings: {horizon_s: [1]}\nfit: {trials: 9, ranges: {horizon_s: [1, 2]}}",
            "must be of a number that is not in settings, too",
        ),
        (
            "fit: {minimize: nees, trials: 9, ranges: {horizon_s: [1, 2]}}",
            "fit.minimize is 'nees' but must be one of position_rmse_m,",
        ),
        ("lost: [0.1, 0.1]", "lost is [0.1, 0.1] but must be a list of at least one value"),
        ("settings: {horizon_s: [1, 1.0]}", "settings.horizon_s is [1, 1.0] but must be a list"),
        ("lost: [0.1]\nseeds: [0.5]", "parameter seeds[0] = 0.5 must be a whole number"),
        ("seeds: [1]", "seeds choose which messages are lost, but lost names no share above 0"),
        ("workers: 0", "parameter workers = 0 must lie in [1, 4096]"),
    ],
)
def test_what_cannot_be_run_is_one_sentence(
    folder: Path, text: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if text and "bags" not in text:
        text = f"bags: [short]\n{text}"
    assert run(written(folder, text)) == 1
    error = capsys.readouterr().err
    assert said in error
    assert error.startswith(str(folder / "sweep.yaml"))
    assert error.count("\n") == 1
    assert not (folder / "out").exists()


def test_a_sweep_has_a_limit(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweeping, "MAX_JOBS", 5)
    with pytest.raises(SweepFileError, match="it makes 6 replays but must make at most 5"):
        read_sweep(written(folder, "bags: [short]\n" + GRID))


def test_one_and_two_workers_make_the_same_table(folder: Path) -> None:
    assert run(written(folder, "bags: [short]\n" + GRID)) == 0
    alone = table(folder)
    rows = [line.split(",") for line in alone.splitlines()]
    assert len(rows) == 7
    assert rows[0] == ["bag", "swarm", "horizon_s", "lost", "seed", *FIGURES, "failure"]
    result = replay(folder / "short")
    assert rows[4][:5] == ["short", "short/swarm.yaml", "2", "0", ""]
    assert rows[4][7] == f"{result.overall.position_rmse:.6g}"
    assert len({row[7] for row in rows[1:]}) > 3
    assert {path.name for path in (folder / "out").iterdir()} == {
        *("horizon_s.png", "lost.png", "jobs.jsonl", "sweep.html", "table.csv")
    }
    shutil.rmtree(folder / "out")
    assert run(written(folder, "bags: [short]\n" + GRID.replace("workers: 1", "workers: 2"))) == 0
    assert table(folder) == alone


def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    ran: list[str] = []

    def watched(job: Job) -> sweeping.Line:
        ran.append(job.key)
        return outcome(job)

    monkeypatch.setattr(sweeping, "outcome", watched)
    return ran


@pytest.mark.parametrize("tail", ["", '[1]\n{"figures": 1}\n\0\0'])
def test_a_run_that_was_killed_goes_on(folder: Path, tail: str, monkeypatch: pytest.MonkeyPatch) -> None:
    file = written(folder, "bags: [short]\n" + GRID)
    assert run(file) == 0
    whole = table(folder)
    lines = finished(folder).read_text(encoding="utf-8").splitlines(keepends=True)
    ran = counted(monkeypatch)
    finished(folder).write_text("".join(lines[:4]) + (tail or lines[4][:-9]), encoding="utf-8")
    (folder / "out" / "table.csv").unlink()
    assert run(file) == 0
    assert len(ran) == 2
    assert table(folder) == whole
    assert run(file) == 0
    assert len(ran) == 2
    assert table(folder) == whole


def test_a_failed_job_is_a_row_and_runs_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(folder / "short", folder / "broken")
    (stored,) = (folder / "broken").glob("*.mcap")
    content = stored.read_bytes()
    stored.write_bytes(b"nothing")
    file = written(folder, "bags: [broken, short]\nworkers: 1")
    assert run(file) == 1
    assert "1 of 2 replays failed, the first: " in capsys.readouterr().err
    failed, good = (line.split(",", 2) for line in table(folder).splitlines()[1:])
    assert failed[0] == "broken"
    assert stored.name in failed[2]
    assert good[2].endswith(",")
    page = (folder / "out" / "sweep.html").read_text(encoding="utf-8")
    assert "1 replays failed" in page
    ran = counted(monkeypatch)
    assert run(file) == 1
    assert len(ran) == 1
    stored.write_bytes(content)
    assert run(file) == 0
    assert table(folder).splitlines()[1].split(",")[4:] == good[2].split(",")[2:]


def test_a_fault_of_the_program_ends_one_job(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def faulty(*_: object, **__: object) -> None:
        raise ZeroDivisionError("by\nzero")

    monkeypatch.setattr(sweeping, "replay", faulty)
    assert run(written(folder, "bags: [short]\nworkers: 1")) == 1
    assert table(folder).splitlines()[1].endswith(",ZeroDivisionError: by zero")


def test_ctrl_c_ends_a_sweep_with_what_is_finished(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = written(folder, "bags: [short]\n" + GRID)
    done: list[Job] = []

    def interrupted(job: Job) -> sweeping.Line:
        done.append(job)
        if len(done) > 2:
            raise KeyboardInterrupt
        return outcome(job)

    monkeypatch.setattr(sweeping, "outcome", interrupted)
    assert run(file) == 130
    assert finished(folder).read_text(encoding="utf-8").count("\n") == 2


RANGES = "{horizon_s: [0.05, 3], lost_heading_sigma: [0.3, 2]}"
FIT = f"lost: [0.3]\nworkers: 1\nfit: {{trials: 10, ranges: {RANGES}}}\n"


def test_a_fit_finds_no_worse_values_than_the_defaults(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("optuna")
    file = written(folder, "bags: [short]\n" + FIT)
    assert run(file) == 0
    said, first = capsys.readouterr().out, table(folder)
    lines = [line.split(",") for line in first.splitlines()]
    head, body = lines[0], lines[1:]
    assert len(body) == 10
    assert head[:6] == ["bag", "swarm", "horizon_s", "lost_heading_sigma", "lost", "seed"]
    errors = [float(row[head.index("position_rmse_m")]) for row in body]
    best = body[errors.index(min(errors))]
    assert f"--set horizon_s={best[2]} --set lost_heading_sigma={best[3]}" in said
    assert f"{min(errors):.6g}, {errors[0]:.6g} with the defaults" in said
    assert (folder / "out" / "horizon_s.png").exists()

    stored = finished(folder).read_bytes()
    finished(folder).write_bytes(stored[: len(stored) // 2])
    assert run(file) == 0
    assert table(folder) == first
    again = replay(folder / "short", settings=Settings(horizon_s=float(best[2])), loss=Loss(0.3, 1))
    assert again.overall.position_rmse == pytest.approx(min(errors), rel=0.02)


def test_a_fit_without_ground_truth_has_no_best_values(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("optuna")
    monkeypatch.setattr(sweeping, "outcome", lambda job: {"key": job.key, "figures": dict.fromkeys(FIGURES)})
    assert run(written(folder, "bags: [short]\n" + FIT)) == 1
    assert capsys.readouterr().err == "No trial has position_rmse_m of all its replays.\n"


@pytest.mark.parametrize("package", ["ray", "dask", "optuna"])
def test_a_missing_package_is_one_sentence(
    folder: Path, package: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in ("ray", "distributed", "optuna"):
        monkeypatch.setitem(sys.modules, module, None)
    fit, more = (FIT, []) if package == "optuna" else ("", ["--backend", package])
    assert run(written(folder, f"bags: [short]\n{fit}"), *more) == 1
    error = capsys.readouterr().err
    assert f"pip install 'swarm_loc_estimator[{package}]'" in error
    assert error.count("\n") == 1


def listening() -> set[tuple[str, str]]:
    """Sockets of this machine that listen: address and port, and inode."""
    lines = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{name}").read_text().splitlines()
    ]
    return {(line[1], line[9]) for line in lines if line[3] == "0A"}


def test_a_cluster_of_ray_that_is_started_here_listens_on_loopback_only() -> None:
    pytest.importorskip("ray")
    before = listening()
    with workers(1, Backend("ray")):
        opened = {place.partition(":")[0] for place, _ in listening() - before}
    assert opened
    loopback = {"0100007F", f"{'0' * 24}01000000", f"{'0' * 16}FFFF00000100007F"}
    assert opened <= loopback


@pytest.mark.parametrize(("address", "setting"), [(None, "0"), ("127.0.0.1:1", None)])
def test_ray_is_imported_for_this_machine_only_unless_a_cluster_is_given(
    address: str | None, setting: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the test above, where Ray is not installed."""

    def found(*_: str) -> None:
        raise BackendError(str(os.environ.get("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER")))

    monkeypatch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "1")
    monkeypatch.delenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER")
    monkeypatch.setattr(sweeping, "loaded", found)
    with pytest.raises(BackendError, match=f"^{setting}$"), workers(1, Backend("ray", address)):
        pass


def test_a_cluster_needs_a_back_end(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(written(folder, "bags: [short]"), "--cluster", "here:1") == 1
    assert "--cluster is for --backend ray or dask" in capsys.readouterr().err


def test_a_cluster_of_ray_where_nobody_answers_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", ModuleType("ray"))
    monkeypatch.setitem(sys.modules, "ray.util.joblib.ray_backend", ModuleType("ray_backend"))
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    for address in (f"127.0.0.1:{port}", "127.0.0.1", "127.0.0.1:no"):
        assert run(written(folder, "bags: [short]"), "--backend", "ray", "--cluster", address) == 1
        assert capsys.readouterr().err.startswith(f"--cluster {address} is not reached: ")


def test_a_replay_needs_nothing_of_sweeps() -> None:
    code = "import sys, swarm_loc_estimator.cli.replay; print('joblib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def rows(values: Callable[[str, int | None], float | None]) -> list[Row]:
    empty = dict.fromkeys(FIGURES)
    return [
        {
            "bag": bag,
            "lost": 0.2 * (seed is not None),
            "seed": seed,
            **empty,
            column: values(bag, seed),
            "failure": None,
        }
        for bag in "ab"
        for seed in (None, 1, 2)
        for column in ("position_sigma_m",)
    ]


def test_without_truth_the_page_shows_what_the_estimator_reports(tmp_path: Path) -> None:
    found = rows(lambda _, seed: 0.1 + 0.1 * (seed or 0))
    page = write_results(found, ["lost"], tmp_path).read_text(encoding="utf-8")
    assert "No ground truth to compare with" in page
    assert page.count("<img") == 1
    assert "0.2,1,,,,,,,,,,,0.2," in (tmp_path / "table.csv").read_text(encoding="utf-8")


def test_bands_are_those_of_seeds_alone() -> None:
    found: list[Row] = [{"seed": None, "x": 1.0}, {"seed": 1, "x": 3.0}, {"seed": 2, "x": 7.0}]
    np.testing.assert_array_equal(_span([found, found[:1], []], "x").T, [[2, 3, 4], [1, 1, 1], [np.nan] * 3])
