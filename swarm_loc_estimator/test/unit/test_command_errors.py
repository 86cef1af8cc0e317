"""How commands end."""

import os
from argparse import ArgumentTypeError
from collections.abc import Callable
from pathlib import Path

import pytest

from swarm_loc_estimator.cli import calibrate, calibrate_ir, doctor, replay, survey
from swarm_loc_estimator.common.command_line import exit_with_message, file_to_write, folder_to_write
from swarm_loc_estimator.common.parameters import UserError


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (UserError("This is wrong."), 1, "This is wrong.\n"),
        (OSError(28, "No space left on device", "out/x.yaml"), 1, "out/x.yaml cannot be used: No space left"),
        (OSError("cannot mmap an empty file"), 1, "A file cannot be used: cannot mmap an empty file."),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_what_goes_wrong_ends_a_command_with_a_sentence(
    error: BaseException, status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    @exit_with_message
    def main() -> int:
        raise error

    assert main() == status
    said = capsys.readouterr().err
    assert said.startswith(words)
    assert said.count("\n") == bool(words)


def test_faults_of_the_program_are_not_hidden() -> None:
    @exit_with_message
    def main() -> int:
        raise KeyError

    with pytest.raises(KeyError):
        main()


@pytest.mark.parametrize("main", [replay.main, calibrate.main, calibrate_ir.main, survey.main])
def test_a_bag_that_is_not_there_is_said(
    main: Callable[[list[str]], int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "nope"), "--out", str(tmp_path / "out.yaml")]) == 1
    assert capsys.readouterr().err == f"There is no bag '{tmp_path / 'nope'}'.\n"


def test_folders_are_not_made_before_there_is_anything_to_write(tmp_path: Path) -> None:
    assert folder_to_write()(str(tmp_path / "a" / "b")) == tmp_path / "a" / "b"
    assert file_to_write(".mcap")(str(tmp_path / "a" / "b.mcap")) == tmp_path / "a" / "b.mcap"
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("run.bag", "must end in .yaml or .yml"),
        ("folder.yaml", "folder.yaml cannot be written: it is a folder"),
        ("link.yaml", "link.yaml cannot be written: it is a symbolic link"),
        ("nowhere.yaml", "nowhere.yaml cannot be written: it is a symbolic link"),
        ("pipe.yaml", "pipe.yaml cannot be written: it is no regular file"),
        ("gone/run.yml", "gone cannot be written: No such file"),
        ("file/run.yml", "file cannot be written: Not a directory"),
    ],
)
def test_a_file_that_cannot_be_written_is_said(name: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "link.yaml").symlink_to(tmp_path / "file")
    (tmp_path / "nowhere.yaml").symlink_to(tmp_path / "none")
    (tmp_path / "gone").symlink_to(tmp_path / "none")
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(ArgumentTypeError, match=said):
        file_to_write(".yaml", ".yml")(str(tmp_path / name))


@pytest.mark.parametrize(("main", "more"), [(doctor.main, []), (survey.main, ["--out", "out.yaml"])])
def test_a_folder_is_a_bag_whatever_its_name(
    main: Callable[[list[str]], int], more: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / "run.yaml"
    bag.mkdir()
    assert main([str(bag), *more]) == 1
    assert f"{bag / 'swarm.yaml'} cannot be read" in capsys.readouterr().err
