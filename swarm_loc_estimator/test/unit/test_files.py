"""Outputs: whole or not at all, named where they cannot be written, and never through a link of others."""

import errno
import os
import select
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bench.shared.bags import copy_part
from bench.shared.full_disk import full_after
from swarm_loc_estimator.cli import calibrate, calibrate_ir, new, replay, replay_map, survey, sweep
from swarm_loc_estimator.common.bags.writer import BagWriter, Stream, write_streams
from swarm_loc_estimator.common.files import FileError, check_folder, replacing, write_whole
from swarm_loc_estimator.common.messages.cdr import POSE_STAMPED
from swarm_loc_estimator.common.yaml_tree import YamlTreeError, read_tree, write_tree
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.offline.export import write_mcap, write_tum
from swarm_loc_estimator.offline.replay import replay as run
from swarm_loc_estimator.offline.report.report import write_report
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.offline.sweep import sweep as sweeping
from swarm_loc_estimator.offline.sweep.report import Row, write_results

DEMO = Path(__file__).parents[3] / "bags" / "eight_one_robot_fast"


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files") / "short"
    copy_part(DEMO, folder, 3.0)
    shutil.copy(DEMO / "swarm.yaml", folder)
    return folder


@pytest.fixture(scope="module")
def result(short: Path) -> ReplayResult:
    return run(short)


ROW: Row = {"bag": "a", "seed": 1, "lost": 0.5, "position_rmse_m": 0.1, "heading_rmse_deg": 1.0, "nees": 3.0}
Write = Callable[[ReplayResult, Path], object]
WRITERS: dict[str, Write] = {
    "text": lambda _, folder: write_whole(folder / "a.txt", "x" * 100_000),
    "tree": lambda _, folder: write_tree({f"key{k}": k for k in range(10_000)}, folder / "a.yaml"),
    "report": write_report,
    "poses": lambda result, folder: replay.write_poses(result, folder / "poses.csv"),
    "tum": write_tum,
    "mcap": lambda result, folder: write_mcap(result, folder / "a.mcap"),
    "map": lambda _, folder: save_map(OccupancyMap(np.zeros(2), 0.02, np.zeros((300, 300))), folder / "map"),
    "results": lambda _, folder: write_results([{**ROW, "failure": "x" * 100}] * 200, ["lost"], folder),
}
EACH = pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)


@EACH
def test_a_full_disk_leaves_the_old_files_and_is_said_with_the_path(
    write: Write, result: ReplayResult, tmp_path: Path
) -> None:
    write(result, tmp_path / "out")
    old = {file: file.read_bytes() for file in (tmp_path / "out").iterdir()}
    with full_after(100), pytest.raises(FileError) as said:
        write(result, tmp_path / "out")
    assert {file: file.read_bytes() for file in (tmp_path / "out").iterdir()} == old
    assert str(said.value).endswith(" cannot be written: File too large.")
    assert str(tmp_path / "out") in str(said.value)

    with full_after(100), pytest.raises(FileError):
        write(result, tmp_path / "new")
    assert [*(tmp_path / "new").iterdir()] == []


@EACH
def test_a_file_is_not_cut_wherever_the_disk_ends(write: Write, result: ReplayResult, tmp_path: Path) -> None:
    write(result, tmp_path / "out")
    largest = max(file.stat().st_size for file in (tmp_path / "out").iterdir())
    for count in [*np.random.default_rng(4).integers(largest // 2, largest, 6).tolist(), largest - 1]:
        with full_after(count), pytest.raises(FileError):
            write(result, tmp_path / "new")


@EACH
def test_nothing_is_written_through_links(write: Write, result: ReplayResult, tmp_path: Path) -> None:
    write(result, tmp_path / "out")
    for file in [*(tmp_path / "out").iterdir()]:
        (tmp_path / "other").write_text("of others")
        file.unlink()
        file.symlink_to(tmp_path / "other")
        with pytest.raises(FileError, match="cannot be written: it is a symbolic link") as said:
            write(result, tmp_path / "out")
        assert str(file) in str(said.value)
        assert (tmp_path / "other").read_text() == "of others"
        file.unlink()


@pytest.mark.parametrize("full_bytes", [0, 100, 20_000])
def test_a_bag_is_whole_or_not_there(full_bytes: int, tmp_path: Path) -> None:
    noise = np.random.default_rng(3).bytes
    stream = Stream("a", POSE_STAMPED, np.arange(400), [noise(100) for _ in range(400)])
    with full_after(full_bytes), pytest.raises(FileError, match="bag cannot be written: File too large"):
        write_streams(tmp_path / "bag", [stream])
    assert [*tmp_path.iterdir()] == []


HOLD = """
import sys
from swarm_loc_estimator.common.files import temporary_folder
with temporary_folder("links-") as folder:
    (folder / "epuck1").symlink_to("/dev/null")
    print(folder, flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_temporary_folder_goes_with_its_process(number: signal.Signals, tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    ) as process:
        assert process.stdout is not None
        folder = Path(process.stdout.readline().strip())
        assert [*tmp_path.iterdir()] == [folder]
        (remover,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        handle = os.pidfd_open(int(remover))
        process.send_signal(number)
    assert select.select([handle], [], [], 60.0)[0]  # it has ended
    os.close(handle)
    assert not folder.exists()


def test_a_file_that_is_written_has_no_name(tmp_path: Path) -> None:
    with replacing(tmp_path / "a") as part:
        part.write_text("whole")
        assert not [*tmp_path.iterdir()]
    assert (tmp_path / "a").read_text() == "whole"


def test_a_file_system_without_nameless_files_has_whole_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = os.open

    def without(path: Path, flags: int, *mode: int) -> int:
        if flags & os.O_TMPFILE == os.O_TMPFILE:
            raise OSError(errno.EOPNOTSUPP, "not supported")
        return opened(path, flags, *mode)

    monkeypatch.setattr(os, "open", without)
    with replacing(tmp_path / "a") as part:
        part.write_text("whole")
        assert [*tmp_path.iterdir()] == [part]
    assert [*tmp_path.iterdir()] == [tmp_path / "a"]


def test_a_bag_appears_with_all_its_files(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        (bag.folder / "swarm.yaml").touch()
        bag.add_topic("a", POSE_STAMPED)
        assert not (tmp_path / "bag").exists()
    assert {path.name for path in (tmp_path / "bag").iterdir()} == {"bag.mcap", "metadata.yaml", "swarm.yaml"}
    assert [*tmp_path.iterdir()] == [tmp_path / "bag"]

    def full(_: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(FileError, match="other cannot be written: No space left"):
        write_streams(tmp_path / "other", [Stream("a", POSE_STAMPED, np.arange(1), [b""])], add=full)
    assert [*tmp_path.iterdir()] == [tmp_path / "bag"]


@pytest.mark.parametrize("room", [0, 3, 8])
def test_a_line_of_a_sweep_is_whole_or_not_there(room: int, tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(b"line\n")
    with (tmp_path / "log").open("ab", buffering=0) as file:
        with full_after(5 + room), pytest.raises(OSError, match="File too large"):
            sweeping._append(file, b"new line\n")
        assert (tmp_path / "log").read_bytes() == b"line\n"
        sweeping._append(file, b"new line\n")
    assert (tmp_path / "log").read_bytes() == b"line\nnew line\n"


@pytest.mark.parametrize("main", [calibrate.main, calibrate_ir.main, survey.main])
def test_a_link_at_the_picture_is_found_before_the_work_begins(
    main: Callable[[list[str]], int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.png").symlink_to("elsewhere")
    (tmp_path / "a").symlink_to("elsewhere")
    with pytest.raises(SystemExit):
        main([str(tmp_path / "none"), "--out", str(tmp_path / "a.yaml")])
    assert f"{tmp_path / 'a.png'} cannot be written: it is a symbolic link" in capsys.readouterr().err


def test_what_fails_inside_is_passed_on_and_leaves_nothing(tmp_path: Path) -> None:
    def fail(part: Path) -> None:
        part.touch()
        raise KeyError

    with pytest.raises(KeyError), replacing(tmp_path / "a") as part:
        fail(part)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    ("main", "more"),
    [
        (replay.main, ["--out", "FOLDER"]),
        (replay.main, ["--tum", "FOLDER"]),
        (replay.main, ["--mcap", "FOLDER/a.mcap"]),
        (replay.main, ["--learned", "FOLDER/a.yaml"]),
        (replay_map.main, ["--out", "FOLDER"]),
        (sweep.main, ["--out", "FOLDER"]),
        (calibrate.main, ["--out", "FOLDER/a.yaml"]),
        (survey.main, ["--out", "FOLDER/a.yaml"]),
    ],
)
def test_a_full_disk_is_found_before_the_work_begins(
    main: Callable[[list[str]], int], more: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [one.replace("FOLDER", str(tmp_path)) for one in more]
    with full_after(100_000), pytest.raises(SystemExit):
        main([str(tmp_path / "none"), *options])
    said = capsys.readouterr().err.splitlines()[-1]
    assert f"{tmp_path} cannot be written: File too large" in said


@pytest.mark.parametrize("name", ["report.html", "paths.png", "poses.csv", "report.txt"])
def test_links_in_the_folder_of_a_report_are_found_before_the_work_begins(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "unrelated").symlink_to("elsewhere")
    check_folder(tmp_path, "*.txt")
    (tmp_path / name).symlink_to("elsewhere")
    with pytest.raises(SystemExit):
        replay.main([str(tmp_path / "none"), "--out", str(tmp_path)])
    assert f"{tmp_path / name} cannot be written: it is a symbolic link" in capsys.readouterr().err


def test_a_new_description_is_whole_or_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with full_after(100):
        assert new.main([str(tmp_path / "lab" / "swarm.yaml"), "--yes"]) == 1
    assert "cannot be written: File too large" in capsys.readouterr().err
    assert [*(tmp_path / "lab").iterdir()] == []


def test_a_folder_in_place_of_a_file_is_named_once(tmp_path: Path) -> None:
    with pytest.raises(YamlTreeError) as refused:
        read_tree(tmp_path)
    assert str(refused.value) == f"{tmp_path} cannot be read: it is no regular file."
