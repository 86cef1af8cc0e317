"""`./run`: `ros2 run` for machines without the ros2 command line.

    ./run PACKAGE EXECUTABLE [ARGUMENTS...]   start an executable
    ./run PACKAGE                             list its executables
    ./run                                     list this workspace's packages with executables
    ./run -- COMMAND [ARGUMENTS...]           run any command in the workspace's environment

ARGUMENTS are those of `ros2 run`: --ros-args -p NAME:=VALUE -r FROM:=TO --params-file FILE.
The workspace is set up first if necessary.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from workspace import build
from workspace.layout import PACKAGES, WorkspaceError


def executables(env: Mapping[str, str], package: str) -> dict[str, Path]:
    """The executables of a package: name -> file.

    Raises:
        WorkspaceError: No such package.
    """
    for prefix in _prefixes(env):
        if (prefix / "share/ament_index/resource_index/packages" / package).exists():
            folder = prefix / "lib" / package
            files = sorted(folder.iterdir()) if folder.is_dir() else []
            return {file.name: file for file in files if file.is_file() and os.access(file, os.X_OK)}
    raise WorkspaceError(f"There is no package '{package}'; this workspace's own: {', '.join(PACKAGES)}.")


def packages(env: Mapping[str, str]) -> list[str]:
    """The packages of this workspace that have executables."""
    return [name for name in PACKAGES if executables(env, name)]


def command(env: Mapping[str, str], arguments: Sequence[str]) -> list[str]:
    """Program and arguments for a call of `run`.

    Raises:
        WorkspaceError: No such package or executable.
    """
    if arguments[0] == "--":
        return list(arguments[1:])
    package, name, *rest = arguments
    known = executables(env, package)
    if name not in known:
        names = ", ".join(known) or "none"
        raise WorkspaceError(f"There is no executable '{name}' in {package}; it has: {names}.")
    return [str(known[name]), *rest]


def start(env: Mapping[str, str], arguments: Sequence[str]) -> NoReturn:
    """Replace this process by the program that the arguments name.

    Raises:
        WorkspaceError: There is no such program.
    """
    program, *rest = command(env, arguments)
    try:
        os.execvpe(program, [program, *rest], env)
    except OSError as error:
        raise WorkspaceError(f"Cannot start '{program}': {error.strerror}.") from error


def describe(env: Mapping[str, str], arguments: Sequence[str]) -> str:
    """Possible completions of an incomplete call of `run`.

    Raises:
        WorkspaceError: No such package.
    """
    if arguments and arguments[0] != "--":
        return "\n".join(f"{arguments[0]} {name}" for name in executables(env, arguments[0]))
    return "\n".join(packages(env))


def main(arguments: Sequence[str]) -> int:
    """Set up the environment and start the program that the arguments name."""
    env = build.environment()
    if len(arguments) < 2:
        print(f"{__doc__}\n{describe(env, arguments)}", file=sys.stderr)
        return 2
    start(env, arguments)


def _prefixes(env: Mapping[str, str]) -> list[Path]:
    return [Path(prefix) for prefix in env.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
