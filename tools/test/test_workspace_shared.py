"""Clones of one user share built packages of messages, by what these are built from."""

import os
import shutil
from pathlib import Path

import pytest

from workspace import build, install, shared, stamps
from workspace.layout import ROOT


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache/swarm_loc_workspace"


def test_another_folder_takes_a_kept_package_as_if_built_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = tmp_path / "here", tmp_path / "a folder"
    script, library = here / "package/lib/tool", here / "package/lib/tool.so"
    script.parent.mkdir(parents=True)
    script.write_text(f'prefix="{here}/package"\n', encoding="utf-8")
    script.chmod(0o755)
    library.write_bytes(f"\0{here}/x.c\0".encode())
    (here / "package/lib/linked").symlink_to(script)
    monkeypatch.setattr(shared, "ROOT", here)
    shared.keep("key", here / "package")
    shutil.rmtree(here)

    monkeypatch.setattr(shared, "ROOT", there)
    assert not shared.take("other", there / "package")
    assert shared.take("key", there / "package")

    taken = there / "package/lib"
    assert (taken / "tool").read_text(encoding="utf-8") == f'prefix="{there}/package"\n'
    assert (taken / "tool").stat().st_mode & 0o111
    assert (taken / "linked").read_text(encoding="utf-8") == (taken / "tool").read_text(encoding="utf-8")
    assert (taken / "tool.so").read_bytes() == f"\0{here}/x.c\0".encode()


def test_what_is_kept_twice_or_damaged_hurts_nobody(tmp_path: Path, cache: Path) -> None:
    built = tmp_path / "package"
    built.mkdir()
    (built / "a").touch()
    shared.keep("key", built)
    shared.keep("key", built)
    assert [folder.name for folder in cache.iterdir()] == ["key"]

    (cache / "key/b").symlink_to("nowhere")
    assert not shared.take("key", tmp_path / "taken")
    assert not (tmp_path / "taken").exists()


@pytest.mark.parametrize("place", ["", "key", "key/lib", "key/lib/a"])
@pytest.mark.parametrize("fault", ["mode", "group", "owner"])
def test_what_others_can_write_is_neither_taken_nor_kept_there(
    tmp_path: Path, cache: Path, place: str, fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "package/lib").mkdir(parents=True)
    (tmp_path / "package/lib/a").touch(0o666)
    before = os.umask(0)
    shared.keep("key", tmp_path / "package")
    os.umask(before)
    assert shared.take("key", tmp_path / "first")
    if fault == "owner":
        if os.geteuid():
            pytest.skip("only root can give files away")
        os.chown(cache / place, 65534, 65534)
    else:
        (cache / place).chmod(0o777 if fault == "mode" else 0o775)

    assert not shared.take("key", tmp_path / "second")
    assert not (tmp_path / "second").exists()
    assert "is not used, since others" in capsys.readouterr().out
    shared.keep("key", tmp_path / "package")
    assert shared.take("key", tmp_path / "third") == bool(place)


def test_a_link_of_others_to_a_cache_is_not_followed(tmp_path: Path, cache: Path) -> None:
    if os.geteuid():
        pytest.skip("only root can give files away")
    (tmp_path / "package").mkdir()
    shared.keep("key", tmp_path / "package")
    cache.rename(tmp_path / "elsewhere")
    cache.symlink_to(tmp_path / "elsewhere")
    assert shared.take("key", tmp_path / "first")
    os.chown(cache, 65534, 65534, follow_symlinks=False)
    assert not shared.take("key", tmp_path / "second")


def test_the_key_follows_messages_and_versions_but_not_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(install, "versions", lambda: "wheels 1")
    here = build.shared_key("swarm_loc_msgs")
    for module in (build, stamps):
        monkeypatch.setattr(module, "ROOT", tmp_path)
    shutil.copytree(ROOT / "swarm_loc_msgs", tmp_path / "swarm_loc_msgs")

    assert build.shared_key("swarm_loc_msgs") == here
    (tmp_path / "swarm_loc_msgs/README.md").write_text("other words", encoding="utf-8")
    assert build.shared_key("swarm_loc_msgs") == here
    monkeypatch.setattr(install, "versions", lambda: "wheels 2")
    assert build.shared_key("swarm_loc_msgs") not in (here, "")
    monkeypatch.setattr(install, "versions", lambda: "wheels 1")
    with monkeypatch.context() as other_generators:
        other_generators.setattr(build, "PYTHON_ONLY", tmp_path / "swarm_loc_msgs/README.md")
        assert build.shared_key("swarm_loc_msgs") not in (here, "")
    assert build.shared_key("swarm_loc_msgs") == here
    (tmp_path / "swarm_loc_msgs/msg/Range.msg").write_text("float32 other\n", encoding="utf-8")
    assert build.shared_key("swarm_loc_msgs") not in (here, "")


def test_only_messages_of_known_versions_are_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(install, "versions", lambda: "wheels 1")
    assert build.shared_key("tf2_msgs")
    assert not build.shared_key("swarm_loc_estimator")
    monkeypatch.setattr(install, "versions", lambda: "")  # of a sourced ROS 2
    assert not build.shared_key("swarm_loc_msgs")
