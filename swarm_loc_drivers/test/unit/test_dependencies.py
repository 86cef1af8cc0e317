"""The package names in its package.xml what it imports."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterable
from pathlib import Path

PACKAGE = Path(__file__).parents[2]
KEYS = {"cv2": "python3-opencv"} | {
    module: f"python3-{module.replace('_', '-')}"
    for module in ("hypothesis", "numpy", "pytest", "scipy", "serial", "typing_extensions")
}
"""What rosdep calls modules that are no ROS packages."""


def imported(folders: Iterable[str]) -> set[str]:
    """Dependencies of the code in some folders, but not on itself or the standard library."""
    files = [path for folder in folders for path in (PACKAGE / folder).rglob("*.py")]
    names: set[str] = set()
    for node in (node for path in files for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))):
        if isinstance(node, ast.Import):
            names |= {one.name for one in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names.add(node.module or "")
    modules = {name.partition(".")[0] for name in names}
    beside = {path.stem for path in files} | {"node_world", PACKAGE.name}
    return {KEYS.get(module, module) for module in modules - beside - sys.stdlib_module_names}


def declared(kind: str) -> set[str]:
    """Dependencies of one kind in package.xml."""
    return set(re.findall(f"<{kind}>(.+)</{kind}>", (PACKAGE / "package.xml").read_text(encoding="utf-8")))


def test_what_is_imported_is_declared() -> None:
    assert imported([PACKAGE.name, "launch"]) == declared("exec_depend")
    assert imported(["test"]) <= declared("exec_depend") | declared("test_depend")
