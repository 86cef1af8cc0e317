"""YAML as people mean it: numbers as in YAML 1.2, every key once, every error one sentence with file and key.

PyYAML reads YAML 1.1, where 1e-4 is a string, 010 is eight, 1:30 is ninety and the second of two equal keys
silently wins. A configuration must not be read like that.
"""

from __future__ import annotations

import math
import re
import reprlib
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    from pathlib import Path

Tree = Any
"""dict, list, str, int, float, bool or None."""

_MAX_BYTES = 20_000_000

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 100


class YamlTreeError(ValueError):
    """A file that is not such YAML; the message is one sentence."""


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """Resolves plain scalars as YAML 1.2 does.

    Not the faster CSafeLoader: deeply nested brackets crash the whole process in it.
    """

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  # PyYAML's own attribute


_FLOAT = r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
for _tag, _pattern in (
    ("null", r"~|null|Null|NULL|"),
    ("bool", r"true|True|TRUE|false|False|FALSE"),
    ("int", r"[-+]?[0-9]+"),
    ("float", _FLOAT),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^({_pattern})$"), None)


def shown(value: object) -> str:
    """A value for an error message: short, on one line."""
    return _SHORT.repr(value).replace("\n", " ")


def read_tree(path: Path) -> Tree:
    """Read a YAML file.

    Returns:
        Nested dicts, lists and scalars.

    Raises:
        YamlTreeError: It cannot be read, is not YAML, or has a key twice.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise YamlTreeError(f"{path} cannot be read: {error.strerror or error}.") from error
    if len(data) > _MAX_BYTES:
        raise YamlTreeError(f"{path} has {len(data)} bytes, more than the {_MAX_BYTES} that are sensible.")
    try:
        node = yaml.compose(data, Loader=_Loader)
        return None if node is None else _Reader(path).value(node, "")
    except yaml.YAMLError as error:
        raise YamlTreeError(f"{path} is not YAML: {_one_line(error)}.") from error
    except RecursionError:
        raise YamlTreeError(f"{path} is nested too deeply.") from None
    except (UnicodeError, ValueError) as error:
        if isinstance(error, YamlTreeError):
            raise
        raise YamlTreeError(f"{path} is not YAML: {' '.join(str(error).split())}.") from error


def _one_line(error: yaml.YAMLError) -> str:
    """PyYAML's several lines in one, with the place."""
    problem = getattr(error, "problem", None) or str(error)
    mark = getattr(error, "problem_mark", None)
    place = f" in line {mark.line + 1}" if mark is not None else ""
    return " ".join(f"{problem}{place}".split())


class _Reader:
    """Turns the nodes of one file into values."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open: set[int] = set()
        self._done: dict[int, Tree] = {}

    def value(self, node: yaml.Node, key: str) -> Tree:
        """The value of a node; `key` is its dotted key."""
        if isinstance(node, yaml.ScalarNode):
            return self._scalar(node, key)
        if id(node) in self._done:  # an alias; reading it again would let nested ones grow without bound
            return self._done[id(node)]
        if id(node) in self._open:
            raise YamlTreeError(f"{self._path}: {key} contains itself.")
        self._open.add(id(node))
        result: Tree = (
            self._mapping(node, key)
            if isinstance(node, yaml.MappingNode)
            else [self.value(item, f"{key}[{index}]") for index, item in enumerate(node.value)]
        )
        self._open.discard(id(node))
        self._done[id(node)] = result
        return result

    def _mapping(self, node: yaml.MappingNode, key: str) -> dict[Any, Tree]:
        """A mapping, each key once."""
        result: dict[Any, Tree] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise YamlTreeError(f"{self._path}: {key or 'the file'} has a key that is no word or number.")
            name = self._scalar(key_node, key)
            below = f"{key}.{key_node.value}" if key else str(key_node.value)
            if isinstance(name, float | bool) or name is None:
                raise YamlTreeError(
                    f"{self._path}: {shown(below)} has a key that is neither a name nor a whole number."
                )
            if name in result:
                line = key_node.start_mark.line + 1
                raise YamlTreeError(f"{self._path}: {shown(below)} is given twice, again in line {line}.")
            result[name] = self.value(value_node, below)
        return result

    def _scalar(self, node: yaml.ScalarNode, key: str) -> str | int | float | bool | None:
        """A plain value."""
        kind, text = node.tag.rpartition(":")[2], str(node.value)
        if kind == "null":
            return None
        if kind == "bool":
            return _bool(text)
        if kind == "int":
            return int(text)
        if kind == "float":
            return _float(text)
        if kind == "str":
            return text
        raise YamlTreeError(
            f"{self._path}: {shown(key)} has the tag {shown(node.tag)}, which is not understood."
        )


def _bool(text: str) -> bool:
    """A truth value; others reach here by an explicit tag only."""
    if text.lower() not in {"true", "false"}:
        raise ValueError(f"{shown(text)} is tagged as true or false and is neither")
    return text.lower() == "true"


def _float(text: str) -> float:
    """A number; YAML writes infinity and not-a-number with a dot."""
    bare = text.lower().lstrip("+-")
    if bare == ".nan":
        return math.nan
    if bare == ".inf":
        return -math.inf if text.startswith("-") else math.inf
    return float(text)
