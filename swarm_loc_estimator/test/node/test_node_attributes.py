"""Our nodes leave rclpy's own attributes alone.

A node that keeps something of its own as `self._clock` or `self._parameters` takes the place of rclpy's, and
fails when somebody asks for its time or lists its parameters. No type checker sees it: rclpy has no types.
"""

import ast
from collections.abc import Iterator

import pytest
import rclpy
from rclpy.node import Node

from workspace.layout import PACKAGES, ROOT

FILES = [path for package in PACKAGES for path in sorted(ROOT.glob(f"{package}/{package}/**/*.py"))]


@pytest.fixture
def taken() -> Iterator[frozenset[str]]:
    """The names of all that a bare node has."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = Node("bare", context=context)
    yield frozenset(dir(node))
    node.destroy_node()
    rclpy.shutdown(context=context)


def _own_attributes(source: str) -> set[str]:
    """What the classes that derive from Node, or from others that are called nodes, assign to themselves."""
    classes = [
        found
        for found in ast.walk(ast.parse(source))
        if isinstance(found, ast.ClassDef)
        and any(ast.unparse(base).partition("[")[0].endswith("Node") for base in found.bases)
    ]
    stored = [
        ast.unparse(part)
        for found in classes
        for part in ast.walk(found)
        if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store)
    ]
    return {name.removeprefix("self.") for name in stored if name.startswith("self.")}


def test_no_attribute_of_rclpy_is_replaced(taken: frozenset[str]) -> None:
    own = {str(path): _own_attributes(path.read_text(encoding="utf-8")) for path in FILES}

    assert any(own.values())
    assert {name: names & taken for name, names in own.items() if names & taken} == {}
