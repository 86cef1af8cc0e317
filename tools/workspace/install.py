"""The virtual environment: created once, filled by uv; corrects the CMake exports of the ROS wheels."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from workspace import host
from workspace.layout import LOGS, REQUIREMENTS, STATE, VENV, VENV_PYTHON, WorkspaceError
from workspace.progress import run_logged, say, step
from workspace.stamps import Stamp, digest, write_whole

STAMP = Stamp(VENV / "workspace.stamp")

EXTRAS = ("bench", "docs")
"""Requirements that are installed when they are first needed, and kept up to date from then on."""

UV = "uv>=0.5,<1"
"""Installs all wheels in ten seconds, where pip asks for one after the other and takes two minutes."""

LOCK, UV_LOCK = REQUIREMENTS / "workspace.lock", REQUIREMENTS / "uv.lock"
"""Versions and hashes of all wheels, for each Python that those of ROS 2 support; `make lock` writes them."""

NETWORK_TROUBLE = re.compile(
    r"NewConnectionError|NameResolutionError|ConnectTimeoutError|ReadTimeoutError|ProxyError|ConnectionError"
    r"|Connection refused|Network is unreachable|Temporary failure in name resolution|Could not fetch URL"
    r"|error sending request|dns error|operation timed out"
)

FOREIGN_PATHS = re.compile(
    r"/opt/python/cp3\d+-cp3\d+/(?P<rest>include/python3\.\d+|lib/python3\.\d+/site-packages)(?=[/\";>])"
)
"""Python paths of the machine that built the wheels."""


def _wanted(groups: tuple[str, ...]) -> dict[str, str]:
    """Required state of the environment for its stamp: folder, origin, a hash per requirements file."""
    facts = {"venv": str(VENV), "ros": str(host.ros_prefix() or "wheels")}
    facts |= {f"group.{group}": digest([REQUIREMENTS / f"{group}.txt"]) for group in groups}
    if _is_locked():
        facts["lock"] = digest([LOCK, UV_LOCK])
    return facts


def _is_locked() -> bool:
    """Whether locked wheels are installed: not with a sourced ROS 2, nor where someone deleted the lock."""
    return host.ros_prefix() is None and LOCK.exists()


def ensure(*, extra: str | None) -> None:
    """Create or update `.venv` from the requirements.

    Args:
        extra: One of `EXTRAS`; None: only those that are installed already.

    Raises:
        WorkspaceError: Something is missing, or pip failed.
    """
    found = json.loads(STAMP.read() or "{}")
    ros = host.ros_prefix()
    groups: tuple[str, ...] = ("workspace",) if ros else ("ros", "workspace")
    groups += tuple(name for name in EXTRAS if name == extra or f"group.{name}" in found)
    wanted = _wanted(groups)
    if found == wanted and VENV_PYTHON.exists():
        _take_compiled()
        return
    reusable = VENV_PYTHON.exists() and all(found.get(key) == wanted[key] for key in ("venv", "ros"))
    STAMP.clear()
    if not reusable:
        _create(system_packages=ros is not None)
    with step(f"installing requirements: {', '.join(groups)}"):
        _install(groups, ros)
    if ros is None:
        _patch_cmake_exports()
    STAMP.write(json.dumps(wanted, sort_keys=True))
    _take_compiled()


def _take_compiled() -> None:
    """Install compiled code from the folder of wheels SWARM_LOC_COMPILED, if one fits this Python."""
    folder = os.environ.get("SWARM_LOC_COMPILED")
    if not folder:
        return
    # never from an index: nobody vouches there for what is executed here
    command: list[str | Path] = [VENV / "bin" / "uv", "pip", "install", "--python", VENV_PYTHON, "--upgrade"]
    command += ["--no-index", "--no-deps", "--find-links", folder, "swarm-loc-compiled"]
    status, _ = run_logged(command, "compiled.log", lambda _: None)
    if status:
        say(f"  no wheel in SWARM_LOC_COMPILED={folder} fits: compiling here ({LOGS / 'compiled.log'})")


def identity() -> str:
    """Properties of the environment on which a build depends."""
    facts = json.loads(STAMP.read() or "{}")
    python = next(VENV.glob("lib/python3*"), Path()).name
    return json.dumps([python, facts.get("ros"), facts.get("group.ros")])


def versions() -> str:
    """What a build of messages depends on beside their files; "" with a sourced ROS 2, whose parts vary."""
    if host.ros_prefix():
        return ""
    wheels = (VENV.glob(f"lib/python3*/site-packages/{name}.dist-info") for name in ("ros_*", "numpy-*"))
    flags = [os.environ.get(name, "") for name in ("CC", "CXX", "CFLAGS", "CXXFLAGS", "LDFLAGS")]
    machine = [platform.machine(), *platform.libc_ver()]
    names = sorted(wheel.name for group in wheels for wheel in group)
    return json.dumps([identity(), names, flags, machine])


def _create(*, system_packages: bool) -> None:
    """Create an empty virtual environment, replacing an existing one."""
    host.check_python_parts()
    host.check_build_tools()
    say("Setting up this clone, which takes some minutes once; interrupted, it goes on from there")
    if VENV.exists():
        say("  removing the old or unfinished .venv")
        shutil.rmtree(VENV)
    options = ["--system-site-packages"] if system_packages else []
    command: list[str | Path] = [sys.executable, "-m", "venv", *options, VENV]
    with step(f"making .venv with Python {sys.version.split()[0]}"):
        status, output = run_logged(command, "venv.log", lambda _: None)
    if status:
        log = LOGS / "venv.log"
        raise WorkspaceError(f"Python could not make .venv: {_last_line(output)} (whole output: {log}).")


def _install(groups: tuple[str, ...], ros: Path | None) -> None:
    """Install requirements files; shows one line of progress and writes all output to a log."""
    pip: list[str | Path] = [VENV_PYTHON, "-m", "pip"]
    options = ["--disable-pip-version-check", "--no-input", "--retries", "2", "--progress-bar", "off"]
    hashed: list[str | Path] = ["--require-hashes", "--no-deps", "--requirement"]
    _run_installer([*pip, "install", *options, *([*hashed, UV_LOCK] if _is_locked() else [UV])], "pip.log")
    # pip's own index, where this machine has one, holds for uv, too
    index = subprocess.run(
        [*pip, "config", "get", "global.index-url"], capture_output=True, text=True, check=False
    )
    url = os.environ.get("PIP_INDEX_URL") or index.stdout.strip()
    env = {**os.environ, "UV_DEFAULT_INDEX": url} if url else None
    command: list[str | Path] = [VENV / "bin" / "uv", "pip", "install", "--python", VENV_PYTHON]
    if _is_locked():
        _run_installer([*command, *hashed, LOCK], "uv.log", env)
        groups = tuple(name for name in groups if name in EXTRAS)
    command += ["--override", REQUIREMENTS / "overrides.txt"]
    for group in groups:
        command += ["--requirement", REQUIREMENTS / f"{group}.txt"]
    if ros:
        command += ["--constraint", _system_constraints()]
    if groups:
        _run_installer(command, "uv.log", env)


def _run_installer(command: list[str | Path], log_name: str, env: Mapping[str, str] | None = None) -> None:
    """Run pip or uv.

    Raises:
        WorkspaceError: It failed.
    """
    status, output = run_logged(command, log_name, str.strip, env)
    if not status:
        return
    if NETWORK_TROUBLE.search(output):
        raise WorkspaceError(
            "The package index cannot be reached: connect this machine to a network, run again."
        )
    reason = output.partition("error: ")[2].replace("\n  cause:", ":") or output
    raise WorkspaceError(
        f"The requirements could not be installed: {_last_line(reason)} (whole output: {LOGS / log_name})."
    )


def _system_constraints() -> Path:
    """Pin numpy to the version of the sourced ROS 2, whose messages do not load with another."""
    constraints = STATE / "constraints.txt"
    probe: list[str | Path] = [VENV_PYTHON, "-c", "import numpy; print(numpy.__version__)"]
    found = subprocess.run(probe, capture_output=True, text=True, check=False).stdout.strip()
    constraints.write_text(f"numpy=={found}\n" if found else "", encoding="utf-8")
    return constraints


def _last_line(output: str) -> str:
    """The last line that is not empty, without its full stop."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return (lines or ["no output"])[-1].rstrip(".")


def _patch_cmake_exports() -> None:
    """Replace the Python of the build machine by this one in the CMake files of the wheels."""
    probe = "import sysconfig; print(sysconfig.get_path('include')); print(sysconfig.get_path('purelib'))"
    found = subprocess.run([VENV_PYTHON, "-c", probe], capture_output=True, text=True, check=True).stdout
    own = dict(zip(("include", "lib"), found.splitlines(), strict=True))
    for path in VENV.glob("share/**/*.cmake"):
        text = path.read_text(encoding="utf-8")
        patched = FOREIGN_PATHS.sub(lambda match: own[match["rest"].split("/")[0]], text)
        if patched != text:
            write_whole(path, patched)  # not in place: uv's cache holds the same file


def base_environment() -> dict[str, str]:
    """The environment that ROS programs and colcon need, without this workspace's packages.

    With a sourced ROS 2 it is the present one with `.venv` in front; else ROS 2 is the wheels in `.venv`.
    """
    env = dict(os.environ)
    env["PATH"] = os.pathsep.join([str(VENV / "bin"), env.get("PATH", "")])
    env["VIRTUAL_ENV"] = str(VENV)
    env.pop("PYTHONHOME", None)
    # Without byte code a start takes twice as long; it is kept apart where it is unwanted beside sources.
    if env.pop("PYTHONDONTWRITEBYTECODE", None):
        env.setdefault("PYTHONPYCACHEPREFIX", str(STATE / "pycache"))
    if host.ros_prefix() is None:
        env["AMENT_PREFIX_PATH"] = env["CMAKE_PREFIX_PATH"] = str(VENV)
        libraries = [VENV / "lib", *sorted(VENV.glob("lib/python3*/site-packages/ros_*.libs"))]
        env["LD_LIBRARY_PATH"] = os.pathsep.join(
            [*map(str, libraries), *filter(None, [env.get("LD_LIBRARY_PATH")])]
        )
        # Without this, the wheels start Python a second time to set the same path.
        env["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"
    return env
