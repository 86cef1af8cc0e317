"""The layout's rules, measured from the code: rooms, floors, circles, sizes, arguments and annotations.

A room is a module or a folder with modules. Of the rooms of one folder each stands on a floor above all those
that it imports, directly or through what it holds; so a chain of imports as long as there are floors leads
through the folder, and imports in a circle stand on no floor at all.
"""

from __future__ import annotations

import ast
import statistics
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("swarm_loc_estimator", "swarm_loc_vision", "swarm_loc_drivers")
PLACES = (*(ROOT / name / name for name in PACKAGES), ROOT / "bench", ROOT / "tools")

MAX_LINES = 400
MAX_MEDIAN_LINES = 130
MIN_DOCUMENTED = 0.96

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Module:
    """A module of the product."""

    name: str
    path: Path

    @cached_property
    def tree(self) -> ast.Module:
        """Its syntax."""
        return ast.parse(self.path.read_text(encoding="utf-8"))

    @property
    def parts(self) -> tuple[str, ...]:
        """Folders and name."""
        return tuple(self.name.split("."))


@cache
def modules() -> Mapping[str, Module]:
    """All modules by their whole names; a package's own `__init__` holds no code and is no room."""
    found = {}
    for place in PLACES:
        for path in sorted(place.rglob("*.py")):
            inside = path.relative_to(place)
            if "test" not in inside.parts and path.name != "__init__.py":
                name = ".".join((place.name, *inside.with_suffix("").parts))
                found[name] = Module(name, path)
    return found


def imports(module: Module) -> Iterator[str]:
    """Modules of the product that a module imports."""
    known = modules()
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import):
            yield from (one.name for one in node.names if one.name in known)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{module.path} imports by a relative name"
            base = node.module or ""
            yield from (whole for one in node.names if (whole := f"{base}.{one.name}") in known)
            if base in known:
                yield base


@cache
def folders() -> Mapping[tuple[str, ...], Mapping[str, frozenset[str]]]:
    """Each folder's rooms, each with the rooms beside it that it imports; the topmost folder is ()."""
    found: dict[tuple[str, ...], dict[str, set[str]]] = {}
    for module in modules().values():
        for depth in range(len(module.parts)):
            found.setdefault(module.parts[:depth], {}).setdefault(module.parts[depth], set())
        for other in imports(module):
            a, b = module.parts, tuple(other.split("."))
            fork = next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), None)
            if fork is not None:
                found[a[:fork]][a[fork]].add(b[fork])
    return {folder: {room: frozenset(to) for room, to in rooms.items()} for folder, rooms in found.items()}


def floor_of(rooms: Mapping[str, frozenset[str]]) -> dict[str, int]:
    """The floor of each room, the ground being 1.

    Raises:
        CycleError: Rooms import each other in a circle.
    """
    floors: dict[str, int] = {}
    for room in TopologicalSorter(rooms).static_order():
        floors[room] = 1 + max((floors[below] for below in rooms[room]), default=0)
    return floors


def functions(tree: ast.Module) -> Iterator[tuple[str, Function]]:
    """Public functions and methods, by name, with the class that a method belongs to."""
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]
    for prefix, body in (("", tree.body), *((f"{one.name}.", one.body) for one in classes)):
        for node in body:
            if isinstance(node, Function) and not node.name.startswith("_"):
                yield prefix + node.name, node


def argument_count(function: Function, *, is_method: bool) -> int:
    """How many arguments a caller hands over."""
    given = function.args
    static = any(isinstance(one, ast.Name) and one.id == "staticmethod" for one in function.decorator_list)
    return len(given.posonlyargs + given.args + given.kwonlyargs) - (is_method and not static)


def test_files_are_short() -> None:
    lines = {m.name: len(m.path.read_text(encoding="utf-8").splitlines()) for m in modules().values()}
    long = {name: count for name, count in lines.items() if count > MAX_LINES}
    assert not long, f"modules with more than {MAX_LINES} lines: {long}"
    assert statistics.median(lines.values()) <= MAX_MEDIAN_LINES


def test_what_is_public_is_documented_and_annotated() -> None:
    public = [
        (module.name, name, one) for module in modules().values() for name, one in functions(module.tree)
    ]
    documented = sum(ast.get_docstring(function) is not None for _, _, function in public)
    assert documented >= MIN_DOCUMENTED * len(public), f"{documented} of {len(public)} are documented"
    bare = [f"{module}.{name}" for module, name, function in public if function.returns is None]
    assert not bare, f"public functions without annotations: {bare}"
    assert all(ast.get_docstring(module.tree) for module in modules().values())


def test_the_measure_finds_circles_floors_and_arguments() -> None:
    with pytest.raises(CycleError):
        floor_of({"a": frozenset("b"), "b": frozenset("a")})
    assert floor_of({"a": frozenset("bc"), "b": frozenset("c"), "c": frozenset()}) == {"c": 1, "b": 2, "a": 3}
    ((name, function),) = functions(ast.parse("class A:\n def f(self, a, *, b): ..."))
    assert (name, argument_count(function, is_method=True)) == ("A.f", 2)
