"""Outputs of cameras' programs: whole or not at all, and never through a link of others."""

from collections.abc import Callable
from pathlib import Path

import pytest

from bench.shared.full_disk import full_after
from swarm_loc_estimator.common.files import FileError
from swarm_loc_vision.aerial.ground_control import FloorMarker, Ground, save_ground
from swarm_loc_vision.laser.calibration import LaserCalibration, save_laser
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.sheets import print_markers
from swarm_loc_vision.sheets.print_markers import board_page, save_pdf


def sheets(folder: Path) -> None:
    family = family_named("artoolkit_bch_thin")
    save_pdf([board_page(0, 3, 4, 40.0, family, "a4")], family, "a4", folder / "a.pdf")


def ground(folder: Path) -> None:
    markers = tuple(FloorMarker(k, 0.1 * k, 0.0) for k in range(100))
    save_ground(Ground(markers=markers, family=family_named("artoolkit_bch_thin")), folder / "a.yaml")


def laser(folder: Path) -> None:
    save_laser(folder / "laser.yaml", LaserCalibration())


WRITERS = [sheets, ground, laser]


@pytest.mark.parametrize("write", WRITERS)
def test_a_full_disk_leaves_the_old_file_and_is_said_with_the_path(
    write: Callable[[Path], None], tmp_path: Path
) -> None:
    write(tmp_path)
    (file,) = tmp_path.iterdir()
    old = file.read_bytes()
    with full_after(100), pytest.raises(FileError) as said:
        write(tmp_path)
    assert str(said.value) == f"{file} cannot be written: File too large."
    assert [one.read_bytes() for one in tmp_path.iterdir()] == [old]


@pytest.mark.parametrize("write", WRITERS)
def test_nothing_is_written_through_links(write: Callable[[Path], None], tmp_path: Path) -> None:
    write(tmp_path)
    (file,) = tmp_path.iterdir()
    other = file.rename(tmp_path / "other")
    other.write_text("of others")
    file.symlink_to(other)
    with pytest.raises(FileError, match="cannot be written: it is a symbolic link"):
        write(tmp_path)
    assert other.read_text() == "of others"


@pytest.mark.parametrize("more", [[], ["--out", "a/b.pdf"]])
def test_a_full_disk_is_found_before_markers_are_drawn(
    more: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with full_after(100_000), pytest.raises(SystemExit):
        print_markers.main(["--board", "2x2", *more])
    assert "cannot be written: File too large" in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == []


def test_a_link_in_the_way_of_a_board_is_found_before_markers_are_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a_board.yaml").symlink_to("elsewhere")
    assert print_markers.main(["--board", "2x2", "--out", str(tmp_path / "a.pdf")]) == 1
    assert "a_board.yaml cannot be written: it is a symbolic link" in capsys.readouterr().err
    assert not (tmp_path / "a.pdf").exists()
