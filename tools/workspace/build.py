"""Build the packages with colcon under `.workspace`, each only if a file that colcon copies has changed."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from workspace import host, install, shared, tf2_msgs
from workspace.layout import LOGS, PACKAGES, ROOT, STATE, VENV_PYTHON, WorkspaceError
from workspace.progress import run_logged, say, step
from workspace.stamps import Stamp, digest, write_whole

BUILD = STATE / "build"
INSTALL = STATE / "install"
OVERLAY = STATE / "overlay.json"  # Environment variable -> entries that the built packages prepend

COPIED = (
    "package.xml",
    "CMakeLists.txt",
    "setup.py",
    "setup.cfg",
    "resource/*",
    "msg/*",
    "srv/*",
    "action/*",
)
"""Files of a package that a build copies; all others are linked."""
MESSAGES = ("swarm_loc_msgs", "tf2_msgs")  # Packages that take most of a build, and that clones share
LINKED_ONE_BY_ONE = "launch/*"
PYTHON_ONLY = Path(__file__).parent / "python_only/rosidl_default_generatorsConfig.cmake"
"""CMake package that leaves out what no Python node loads of messages."""

_COMPILE = """
from functools import partial
from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_estimator.precompile import precompile
small = partial(precompile, "small", False)
if not is_precompiled(small):
    small()
"""


def ensure() -> None:
    """Build all packages that are out of date.

    Raises:
        WorkspaceError: A package does not build.
    """
    env = install.base_environment()
    sources = {name: ROOT / name for name in PACKAGES}
    if not tf2_msgs.is_installed(env):
        sources["tf2_msgs"] = STATE / "tf2_msgs"
    inputs = {name: _inputs(name) for name in sources}
    stamps = {name: Stamp(STATE / "stamps" / name) for name in sources}
    stale = [name for name in sources if stamps[name].read() != inputs[name]]
    if not stale and OVERLAY.exists():
        return
    OVERLAY.unlink(missing_ok=True)
    for name in stale:
        stamps[name].clear()
        shutil.rmtree(BUILD / name, ignore_errors=True)
        shutil.rmtree(INSTALL / name, ignore_errors=True)
    if "tf2_msgs" in stale:
        tf2_msgs.write(sources["tf2_msgs"])
    keys = {name: key for name in stale if (key := shared_key(name))}
    taken = [name for name, key in keys.items() if shared.take(key, INSTALL / name)]
    if taken:
        say(f"  {', '.join(taken)}: as another clone built")
    _colcon_build({name: sources[name] for name in stale if name not in taken}, env)
    for name in keys.keys() - taken:
        shared.keep(keys[name], INSTALL / name)
    _mend_first_lines()
    for name in stale:
        stamps[name].write(inputs[name])
    write_whole(OVERLAY, json.dumps(_prepended(), indent=1))


@contextmanager
def compiling() -> Iterator[None]:
    """Compile beside a build what the estimator of a small swarm needs; all else is compiled when it is used.

    Raises:
        WorkspaceError: The estimator does not run.
    """
    source = ROOT / "swarm_loc_estimator"
    inputs = digest((source / "swarm_loc_estimator").rglob("*.py"), str(ROOT), install.identity())
    stamp = Stamp(STATE / "stamps" / "compiled")
    if stamp.read() == inputs:
        yield
        return
    env = {**install.base_environment(), "PYTHONPATH": str(source)}
    begun = time.monotonic()
    LOGS.mkdir(parents=True, exist_ok=True)
    with (LOGS / "compile.log").open("w", encoding="utf-8") as log:
        process = subprocess.Popen([VENV_PYTHON, "-c", _COMPILE], env=env, stdout=log, stderr=log)
        with process:
            try:
                yield
                if process.poll() is None:
                    say("  compiling the estimator, begun with the build")
                process.wait()
            except BaseException:
                process.kill()
                raise
    if process.returncode:
        lines = (LOGS / "compile.log").read_text(encoding="utf-8").split("\n")
        reason = next(filter(None, reversed(lines)), "no output")
        raise WorkspaceError(
            f"The estimator does not start: {reason} (whole output: {LOGS / 'compile.log'})."
        )
    say(f"    compiled after {time.monotonic() - begun:.0f} s")
    stamp.write(inputs)


def environment() -> dict[str, str]:
    """The environment with ROS 2 and this workspace's packages in it."""
    env = install.base_environment()
    for name, entries in json.loads(OVERLAY.read_text(encoding="utf-8")).items():
        env[name] = os.pathsep.join([*entries, *filter(None, [env.get(name)])])
    return env


def shared_key(name: str) -> str:
    """Name of a built package of messages in the user's cache; "": clones do not share it."""
    versions = install.versions()
    return f"{name}-{_inputs_anywhere(name, versions)}" if versions and name in MESSAGES else ""


def _inputs(name: str) -> str:
    """Hash of everything on which the build of a package depends."""
    return _inputs_anywhere(name, str(ROOT), install.identity())


def _inputs_anywhere(name: str, *facts: str) -> str:
    """Hash of the files on which the build of a package depends, and of further facts."""
    if name in MESSAGES:
        facts = (*facts, PYTHON_ONLY.read_text(encoding="utf-8"))
    if name == "tf2_msgs":
        return digest([], *facts, *tf2_msgs.FILES.values())
    folder = ROOT / name
    names = [path.name for path in sorted(folder.glob(LINKED_ONE_BY_ONE))]
    copied = (path for pattern in COPIED for path in folder.glob(pattern) if path.is_file())
    return digest(copied, *facts, *names)


def _colcon_build(sources: dict[str, Path], env: dict[str, str]) -> None:
    if not sources:
        return
    command: list[str | Path] = [VENV_PYTHON, "-m", "colcon", "--log-base", LOGS / "colcon"]
    command += ["build", "--symlink-install"]
    command += ["--build-base", BUILD, "--install-base", INSTALL, "--paths", *sources.values()]
    if host.ros_prefix() is None:
        command += [
            "--cmake-args",
            f"-Drosidl_default_generators_DIR={PYTHON_ONLY.parent}",
            "-DBUILD_TESTING=OFF",
        ]
    with step(f"building {', '.join(sources)}"):
        status, output = run_logged(command, "build.log", _colcon_status, env, ROOT)
    if status:
        failed = ", ".join(re.findall(r"^Failed\s+<<< (\S+)", output, re.MULTILINE)) or "the packages"
        raise WorkspaceError(f"colcon could not build {failed}: the reason stands in {LOGS / 'build.log'}.")


def _colcon_status(line: str) -> str | None:
    match = re.match(r"(Starting >>>|Finished <<<) (\S+)", line)
    return f"{match[1].split()[0].lower()} {match[2]}" if match else None


def _mend_first_lines() -> None:
    """Let executables find Python by PATH if its path has a space, which a shebang line cannot have."""
    if " " not in str(VENV_PYTHON):
        return
    for script in INSTALL.glob("*/lib/swarm_loc_*/*"):
        first, _, rest = script.read_text(encoding="utf-8").partition("\n")
        if first == f'#!"{VENV_PYTHON}"':
            script.write_text(f"#!/usr/bin/env python3\n{rest}", encoding="utf-8")


def _prepended() -> dict[str, list[str]]:
    """Entries that sourcing the built packages prepends to variables, found in an empty environment.

    colcon's local_setup scripts do the same, but fail in a folder with a space.
    """
    listing: list[str | Path] = [VENV_PYTHON, INSTALL / "_local_setup_util_sh.py", "sh"]
    exports = subprocess.run(listing, capture_output=True, text=True, check=True).stdout
    source = ["bash", "-c", 'eval "$1" && env -0', "bash", exports]
    bare = {"PATH": os.environ["PATH"]}
    variables = subprocess.run(source, env=bare, capture_output=True, text=True, check=True).stdout
    found = dict(entry.split("=", 1) for entry in variables.split("\0") if entry)
    found["PATH"] = found["PATH"].removesuffix(bare["PATH"])
    lists = {name: value.split(os.pathsep) for name, value in found.items() if name.endswith("PATH")}
    return {name: list(filter(None, lists[name])) for name in sorted(lists) if any(lists[name])}
