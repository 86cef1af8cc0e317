"""Folders for links go away with the process that made them, however it ends."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from swarm_loc_drivers.sim.link_host import link_folder

HOLD = """
import sys
from swarm_loc_drivers.sim.link_host import link_folder
with link_folder() as links:
    print(links, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Where folders are made, here and in other processes."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def test_a_folder_is_there_until_the_end(place: Path) -> None:
    with link_folder() as links:
        (Path(links) / "epuck1").symlink_to("/dev/null")
        assert list(place.iterdir()) == [Path(links)]
    assert not list(place.iterdir())


def test_what_a_killed_process_left_is_removed_and_what_a_living_one_has_is_not(place: Path) -> None:
    command = [sys.executable, "-c", HOLD]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        left = Path(other.stdout.readline().strip())
        (left / "epuck1").symlink_to("/dev/null")
        with link_folder() as links:
            assert set(place.iterdir()) == {left, Path(links)}
        other.kill()
        other.wait()
        assert list(place.iterdir()) == [left]
        with link_folder() as links:
            assert list(place.iterdir()) == [Path(links)]


def test_what_only_looks_like_one_is_left_alone(place: Path) -> None:
    (place / "target").mkdir()
    (place / "swarm_loc-link").symlink_to(place / "target")
    (place / "swarm_loc-file").touch()
    with link_folder():
        pass
    assert {path.name for path in place.iterdir()} == {"target", "swarm_loc-link", "swarm_loc-file"}
