"""Checks of this machine: Python version, build tools, and an optional ROS 2 installation."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
import sysconfig
from pathlib import Path

from workspace.layout import ROOT, WorkspaceError

LOWEST_PYTHON = (3, 10)
HIGHEST_WHEEL_PYTHON = (3, 13)  # The newest Python version that the ROS wheels support


def ros_prefix() -> Path | None:
    """The sourced ROS 2 installation: the prefix of AMENT_PREFIX_PATH that holds rclpy for this Python.

    Returns:
        None if no ROS 2 is sourced. Folders of this workspace are ignored.

    Raises:
        WorkspaceError: The sourced ROS 2 is for another Python.
    """
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    for entry in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        prefix = Path(entry).resolve()
        if prefix.is_relative_to(ROOT):
            continue
        found = sorted(prefix.glob("lib/python*/*-packages/rclpy/__init__.py"))
        if not found:
            continue
        if all(path.parts[-4] != version for path in found):
            raise WorkspaceError(
                f"The ROS 2 in {prefix} is for {found[0].parts[-4]}, this is {version}: "
                f"run make with PYTHON=/usr/bin/{found[0].parts[-4]}."
            )
        return prefix
    return None


def check_python_age() -> None:
    """Raise WorkspaceError if this Python is too old for the workspace."""
    if sys.version_info < LOWEST_PYTHON:
        raise WorkspaceError(
            f"Python {sys.version_info.major}.{sys.version_info.minor} is too old: "
            "3.10 or newer is needed, PYTHON=... tells make which."
        )


def check_python_parts() -> None:
    """Raise WorkspaceError if this Python cannot create the virtual environment."""
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    if ros_prefix() is None and sys.version_info[:2] > HIGHEST_WHEEL_PYTHON:
        raise WorkspaceError(
            f"There are no ROS 2 wheels for Python {version}: run make with PYTHON= a Python 3.10 to 3.13."
        )
    if importlib.util.find_spec("venv") is None or importlib.util.find_spec("ensurepip") is None:
        raise WorkspaceError(
            f"Python {version} lacks its venv module: install it (Debian, Ubuntu: apt install python3-venv)."
        )


def check_build_tools() -> None:
    """Raise WorkspaceError if a build tool for the interfaces is missing."""
    needed = {
        "C compiler": [os.environ.get("CC", ""), "cc", "gcc", "clang"],
        "C++ compiler": [os.environ.get("CXX", ""), "c++", "g++", "clang++"],
        "cmake": ["cmake"],
        "make": ["make"],
    }
    missing = [name for name, programs in needed.items() if not any(shutil.which(p) for p in programs if p)]
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        missing.append("Python headers")
    if missing:
        raise WorkspaceError(
            f"Missing on this machine: {', '.join(missing)} "
            "(Debian, Ubuntu: apt install build-essential cmake python3-dev)."
        )
