"""A step's stamp says done only when it is."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

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


@pytest.mark.parametrize(("patience_s", "said"), [(0.0, "Another set-up of this workspace"), (60.0, "")])
def test_only_a_long_wait_for_another_setup_is_reported(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    patience_s: float,
    said: str,
) -> None:
    monkeypatch.setattr(stamps, "STATE", tmp_path)
    reported, entered = threading.Event(), threading.Event()
    monkeypatch.setattr("builtins.print", _noting(print, reported))

    def second() -> None:
        with stamps.only_one(patience_s):
            entered.set()

    with stamps.only_one(60.0):
        waiting = threading.Thread(target=second)
        waiting.start()
        assert not said or reported.wait(30.0)
        assert not entered.is_set()
    waiting.join(30.0)
    assert entered.is_set()
    assert capsys.readouterr().out.startswith(said)
    assert reported.is_set() == bool(said)


def _noting(function: Callable[..., None], called: threading.Event) -> Callable[..., None]:
    def noting(*arguments: object, **options: Any) -> None:
        function(*arguments, **options)
        called.set()

    return noting
