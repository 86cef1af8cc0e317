#!/usr/bin/env python3
"""Measure the layout of the code: `make house`; `--list FIGURE` lists the places that a figure counts.

Product code is every Python file of the packages outside their tests. `path_modules` and `path_containers`
are what one message passes at run time, see `message_path`. The figures are written to
`out/bench/house.json`; their limits are tested in `tools/test/test_house.py`.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

import message_path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("swarm_loc_estimator", "swarm_loc_vision", "swarm_loc_drivers")
LONG = 700  # Maximum number of lines of a file
# Maximum number of lines of product code. It may fall. It rises only by the size of a new sensor or robot,
# and the commit says by how many lines.
PRODUCT_LINES = 65_769
PATHS = ("path_modules", "path_containers")

PRIVATE_WORDS = ("told", "anew", "likewise", "held against", "of late")
"""Words that product code and documentation must not use."""
WORDS = re.compile(rf"\b({'|'.join(PRIVATE_WORDS)})\b", re.IGNORECASE)


@dataclass(frozen=True)
class Module:
    """A Python file of the product."""

    name: str  # Dotted name below the repository's packages
    path: Path  # Path of the file

    @cached_property
    def text(self) -> str:
        """Its source."""
        return self.path.read_text(encoding="utf-8")

    @cached_property
    def tree(self) -> ast.Module:
        """Its syntax tree."""
        return ast.parse(self.text)

    @cached_property
    def nodes(self) -> list[ast.AST]:
        """All nodes of its syntax tree."""
        return list(ast.walk(self.tree))

    @property
    def line_count(self) -> int:
        """All lines, blank ones and comments included."""
        return len(self.text.splitlines())


@cache
def product_modules(root: Path = ROOT) -> list[Module]:
    """All modules of the three packages, tests excluded."""
    found = []
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            inside = path.relative_to(root / package)
            if inside.parts[0] not in {"test", "build", "install"}:
                parts = inside.with_suffix("").parts
                found.append(Module(".".join(parts[:-1] if parts[-1] == "__init__" else parts), path))
    return found


def import_graph(modules: Sequence[Module]) -> dict[str, set[str]]:
    """Module -> product modules that it imports."""
    known = {module.name for module in modules if module.path.name != "__init__.py"}
    graph: dict[str, set[str]] = {}
    for module in modules:
        found: set[str] = set()
        for node in module.nodes:
            if isinstance(node, ast.Import):
                found |= {one.name for one in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
                found |= {node.module, *(f"{node.module}.{one.name}" for one in node.names)}
        graph[module.name] = (found & known) - {module.name}
    return graph


def circles(graph: Mapping[str, set[str]]) -> list[str]:
    """One sentence per circle of imports, among modules and among the folders of a package."""
    found = []
    folders: dict[str, set[str]] = defaultdict(set)
    for name, imported in graph.items():
        for other in imported:
            here, there = folder_of(name), folder_of(other)
            if here != there:
                folders[here].add(there)
    for level, edges in (("modules", dict(graph)), ("folders", dict(folders))):
        while True:
            try:
                list(TopologicalSorter(edges).static_order())
                break
            except CycleError as error:
                circle = error.args[1]
                found.append(f"{level}: {' -> '.join(circle)}")
                edges[circle[1]] = edges[circle[1]] - {circle[0]}
                edges[circle[0]] = edges[circle[0]] - {circle[1]}
    return found


def folder_of(module: str) -> str:
    """The folder of a package that a module belongs to: its first two parts."""
    return ".".join(module.split(".")[:2])


def duplicate_classes(modules: Sequence[Module]) -> list[str]:
    """Class names that a package defines more than once, with their modules."""
    places: dict[tuple[str, str], list[str]] = defaultdict(list)
    for module in modules:
        for node in module.nodes:
            if isinstance(node, ast.ClassDef):
                places[module.name.split(".")[0], node.name].append(module.name)
    return [f"{name}: {', '.join(where)}" for (_, name), where in sorted(places.items()) if len(where) > 1]


def tuple_parameters(modules: Sequence[Module]) -> list[str]:
    """Parameters that are positional tuples of unlike things, such as `tuple[float, FloatArray, int]`."""
    return [
        f"{module.name}:{node.lineno} {node.name}({one.arg}: {ast.unparse(one.annotation)})"
        for module in modules
        for node in module.nodes
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for one in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
        if one.annotation is not None and _has_unlike_tuple(one.annotation)
    ]


def _has_unlike_tuple(annotation: ast.expr) -> bool:
    """Whether a tuple of fixed length stands in an annotation that is no vector of plain numbers."""
    return any(
        isinstance(node.slice, ast.Tuple)
        and not any(isinstance(one, ast.Constant) and one.value is ... for one in node.slice.elts)
        and {ast.unparse(one) for one in node.slice.elts} not in ({"float"}, {"int"})
        for node in ast.walk(annotation)
        if isinstance(node, ast.Subscript) and ast.unparse(node.value) == "tuple"
    )


def private_words(root: Path = ROOT) -> Iterator[str]:
    """Places in product code and documentation that use a word of `PRIVATE_WORDS`."""
    documents = [root / "README.md", root / "CONTRIBUTING.md", *(root / "bags").rglob("*.md")]
    for package in (*PACKAGES, "swarm_loc_msgs"):
        documents += [*(root / package).rglob("*.md"), *(root / package).rglob("*.msg")]
    paths = [module.path for module in product_modules(root)] + sorted(documents)
    for path in paths:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            for match in WORDS.finditer(line):
                yield f"{path.relative_to(root)}:{number} {match[0]}"


@cache
def places(root: Path = ROOT) -> dict[str, list[str]]:
    """Figure -> the places that it counts."""
    modules = product_modules(root)
    return {
        "files_over_700": [f"{m.name} {m.line_count}" for m in modules if m.line_count > LONG],
        "import_circles": circles(import_graph(modules)),
        "duplicate_class_names": duplicate_classes(modules),
        "tuple_parameters": tuple_parameters(modules),
        "private_words": list(private_words(root)),
    }


def path(figure: str, kind: str) -> list[str]:
    """The modules or containers that a message of a kind passes, for a figure of `PATHS`."""
    passed = message_path.passed(kind)
    return passed.modules if figure == "path_modules" else passed.containers


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the figures, or the places that one figure counts."""
    found = places()
    choices = [*found, *(f"{figure}.{kind}" for figure in PATHS for kind in message_path.KINDS)]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--list", choices=choices, metavar="FIGURE", help=f"one of {', '.join(choices)}")
    options = parser.parse_args(arguments)
    if options.list:
        figure, _, kind = options.list.partition(".")
        print("\n".join(path(figure, kind) if kind else found[figure]))
        return 0
    figures: dict[str, Any] = {"product_lines": sum(module.line_count for module in product_modules())}
    figures |= {name: len(there) for name, there in found.items()}
    figures |= {one: {kind: len(path(one, kind)) for kind in message_path.KINDS} for one in PATHS}
    for name, figure in figures.items():
        text = ", ".join(f"{kind} {count}" for kind, count in figure.items()) if name in PATHS else figure
        print(f"{name:22} {text}")
    out = ROOT / "out" / "bench" / "house.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
