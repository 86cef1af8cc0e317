"""What set-up understands of other programs' files and words."""

from __future__ import annotations

from pathlib import Path

import pytest

from workspace import host, install
from workspace.layout import STATE, VENV, WorkspaceError


@pytest.mark.parametrize(
    ("exported", "patched"),
    [
        ("/opt/python/cp311-cp311/include/python3.11;x", "/own/include;x"),
        (
            '"/opt/python/cp313-cp313/lib/python3.13/site-packages/numpy/_core/include"',
            '"/own/lib/numpy/_core/include"',
        ),
        ("/opt/python/cp311-cp311/include/python3.11m", "/opt/python/cp311-cp311/include/python3.11m"),
    ],
)
def test_foreign_python_paths_in_exports_become_own(exported: str, patched: str) -> None:
    own = {"include": "/own/include", "lib": "/own/lib"}
    assert install.FOREIGN_PATHS.sub(lambda match: own[match["rest"].split("/")[0]], exported) == patched


def test_a_sourced_ros_for_another_python_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _install_rclpy(tmp_path, "python3.9")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))

    with pytest.raises(WorkspaceError, match=r"is for python3\.9, this is .*PYTHON=/usr/bin/python3\.9\."):
        host.ros_prefix()


def test_a_sourced_ros_counts_and_this_workspace_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{VENV}:{tmp_path / 'none'}")
    assert host.ros_prefix() is None

    _install_rclpy(tmp_path, f"python3.{sys.version_info.minor}")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{VENV}:{tmp_path}")
    assert host.ros_prefix() == tmp_path


def test_missing_tools_are_named_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("CC", "CXX"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "make").touch(mode=0o755)

    with pytest.raises(
        WorkspaceError, match=r"^Missing on this machine: C compiler, C\+\+ compiler, cmake \(.*\)\.$"
    ):
        host.check_build_tools()


def test_byte_code_is_kept_where_nobody_wants_it_beside_the_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTHONPYCACHEPREFIX", raising=False)
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    env = install.base_environment()
    assert "PYTHONDONTWRITEBYTECODE" not in env
    assert Path(env["PYTHONPYCACHEPREFIX"]).is_relative_to(STATE)

    monkeypatch.delenv("PYTHONDONTWRITEBYTECODE")
    assert "PYTHONPYCACHEPREFIX" not in install.base_environment()


def _install_rclpy(prefix: Path, python: str) -> None:
    package = prefix / "lib" / python / "site-packages" / "rclpy"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
