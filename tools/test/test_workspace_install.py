"""What set-up understands of other programs' files and words."""

import re
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from workspace import host, install
from workspace.layout import REQUIREMENTS, STATE, VENV, WorkspaceError


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


def locked(python: str) -> dict[str, str]:
    """Name -> version of what the lock installs for a version of Python on Linux; all have hashes."""
    environment = {"python_version": python, "python_full_version": f"{python}.1", "sys_platform": "linux"}
    found: dict[str, str] = {}
    for entry in re.split(r"\n(?=\S)", install.LOCK.read_text(encoding="utf-8")):
        requirement = Requirement(entry.partition(" \\\n")[0])
        assert "--hash=sha256:" in entry
        if requirement.marker is None or requirement.marker.evaluate(
            {**environment, "platform_system": "Linux"}
        ):
            (pin,) = requirement.specifier
            assert pin.operator == "=="
            found[canonicalize_name(requirement.name)] = pin.version
    return found


@pytest.mark.parametrize("python", ["3.10", "3.11", "3.12", "3.13"])
def test_the_lock_has_a_version_within_each_range(python: str) -> None:
    versions = locked(python)
    for group in ("ros", "workspace"):
        text = (REQUIREMENTS / f"{group}.txt").read_text(encoding="utf-8")
        for line in (one for one in text.splitlines() if one and not one.startswith("#")):
            requirement = Requirement(line)
            assert requirement.specifier.contains(versions[canonicalize_name(requirement.name)]), line


@pytest.mark.parametrize("case", ["wheels", "wheels and extra", "sourced", "no lock"])
def test_wheels_are_installed_by_their_hashes_where_the_lock_fits(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []
    monkeypatch.setattr(install, "_run_installer", lambda command, *_: commands.append([*map(str, command)]))
    monkeypatch.setattr(host, "ros_prefix", lambda: tmp_path if case == "sourced" else None)
    if case == "no lock":
        monkeypatch.setattr(install, "LOCK", tmp_path / "none")
    groups = ("workspace",) if case == "sourced" else ("ros", "workspace")
    install._install((*groups, "docs") if "extra" in case else groups, host.ros_prefix())

    text = [" ".join(one) for one in commands]
    assert len(text) == 2 + ("extra" in case)
    is_locked = case.startswith("wheels")
    assert [("--require-hashes --no-deps" in one) for one in text[:2]] == [is_locked] * 2
    assert ("workspace.lock" in text[1], "workspace.txt" in text[1]) == (is_locked, not is_locked)
    if "extra" in case:
        assert "docs.txt" in text[2]
        assert "workspace" not in text[2].partition("--requirement")[2]
    assert ("lock" in install._wanted(groups)) == is_locked


def _install_rclpy(prefix: Path, python: str) -> None:
    package = prefix / "lib" / python / "site-packages" / "rclpy"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
