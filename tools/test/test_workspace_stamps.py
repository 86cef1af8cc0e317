"""A step's stamp says done only when it is."""

from __future__ import annotations

from pathlib import Path

import pytest

from workspace import stamps
from workspace.layout import ROOT


def test_a_cleared_stamp_is_as_if_never_written(tmp_path: Path) -> None:
    stamp = stamps.Stamp(tmp_path / "deep" / "stamp")
    assert stamp.read() is None
    stamp.write("abc")
    assert stamp.read() == "abc"
    stamp.clear()
    stamp.clear()
    assert stamp.read() is None


def test_a_write_that_breaks_off_leaves_the_old_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    stamps.write_whole(path, "old")

    def cut(_: int) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.fsync", cut)
    with pytest.raises(OSError, match="disk full"):
        stamps.write_whole(path, "new")

    assert path.read_text(encoding="utf-8") == "old"


def test_a_digest_sees_contents_names_and_facts() -> None:
    files = [ROOT / "pyproject.toml", ROOT / "Makefile"]
    digest = stamps.digest(files, "fact")

    assert digest == stamps.digest(reversed(files), "fact")
    assert digest != stamps.digest(files[:1], "fact")
    assert digest != stamps.digest(files, "facts")
    assert digest != stamps.digest(files, "fa", "ct")
