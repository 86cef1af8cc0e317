"""YAML 1.2 files as trees: decimal numbers, every key once, one sentence for each error."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.constructor import ConstructorError, SafeConstructor
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import Node, ScalarNode
from ruamel.yaml.representer import SafeRepresenter
from ruamel.yaml.resolver import VersionedResolver

from swarm_loc_estimator.common.codec import Tree, shown
from swarm_loc_estimator.common.files import write_whole
from swarm_loc_estimator.common.parameters import UserError

MAX_BYTES = 2_000_000  # Larger files are refused [byte]; that of a thousand robots has a quarter of it

_TAG = "tag:yaml.org,2002:"
_FLOAT = r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
_SCALARS = [
    (_TAG + kind, re.compile(f"^({pattern})$"))
    for kind, pattern in (
        ("null", r"~|null|Null|NULL|"),
        ("bool", r"true|True|TRUE|false|False|FALSE"),
        ("int", r"[-+]?[0-9]+"),
        ("float", _FLOAT),
    )
]


class YamlTreeError(UserError):
    """A file that is not such YAML."""


class _Resolver(VersionedResolver):
    """Numbers are decimal; other notations of YAML, such as 0x10 and 1_000, are text."""

    @property
    def versioned_resolver(self) -> dict[None, list[tuple[str, re.Pattern[str]]]]:
        return {None: _SCALARS}

    @property
    def processing_version(self) -> tuple[int, int]:
        return 1, 2  # whatever a %YAML directive says


class _Yaml(YAML):
    """Whatever version 1 a %YAML directive names."""

    version: Any = None  # the library's refuses 1.0


class _Constructor(SafeConstructor):
    """Only the types above; no merge keys, whose expansion is unbounded."""

    yaml_constructors = {  # noqa: RUF012  # the library's own attribute
        tag: SafeConstructor.yaml_constructors[tag]
        for tag in (*(_TAG + kind for kind in ("null", "bool", "int", "float", "str", "seq", "map")), None)
    }

    def construct_object(self, node: Node, deep: bool = False) -> Tree:  # noqa: ARG002
        if node in self.recursive_objects:
            raise ConstructorError(problem="a value contains itself", problem_mark=node.start_mark)
        return super().construct_object(node, deep=True)

    def flatten_mapping(self, node: Node) -> None:
        pass

    def check_mapping_key(self, node: Node, key_node: Node, mapping: Tree, key: Tree, value: Tree) -> bool:
        del node, value
        problem = None
        if isinstance(key, tuple):
            problem = "a mapping has a key that is no word or number,"
        elif isinstance(key, bool) or not isinstance(key, str | int):
            problem = f"{shown(key)} is a key that is neither a name nor a whole number,"
        elif key in mapping:
            problem = f"{shown(str(key))} is given twice, again"
        if problem:
            raise ConstructorError(problem=problem, problem_mark=key_node.start_mark)
        return True


class _Representer(SafeRepresenter):
    """Numbers with a point: without it, readers of YAML 1.1 take 2e-05 for text."""

    def represent_float(self, data: float) -> ScalarNode:
        node: ScalarNode = super().represent_float(data)
        if "." not in node.value:
            node.value = node.value.replace("e", ".0e")
        return node


_Representer.add_representer(float, _Representer.represent_float)


def read_file(path: Path, most_bytes: int, error_type: type[UserError] = YamlTreeError) -> bytes:
    """The content of a regular file of at most `most_bytes`; raises `error_type` if it cannot be read."""
    try:
        if is_regular := path.is_file() or not path.exists():  # opening a pipe would never return
            with path.open("rb") as file:
                data = file.read(most_bytes + 1)
    except (OSError, ValueError) as error:  # a ValueError is a null byte in the path
        raise error_type(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}.") from error
    if not is_regular:
        raise error_type(f"{path} cannot be read: it is no regular file.")
    if len(data) > most_bytes:
        raise error_type(f"{path} has more than the {most_bytes} bytes that are allowed.")
    return data


def read_tree(path: Path, error_type: type[UserError] = YamlTreeError, most_bytes: int = MAX_BYTES) -> Tree:
    """A YAML file of at most `most_bytes` as dicts, lists and scalars; raises `error_type` if it is none."""
    data = read_file(path, most_bytes, error_type)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of anchors that are used twice
            return _yaml().load(data)
    except ConstructorError as error:
        raise error_type(f"{path}: {_one_line(error)}.") from error
    except RecursionError:
        raise error_type(f"{path} is nested too deeply.") from None
    except (YAMLError, ValueError, LookupError, TypeError) as error:
        raise error_type(f"{path} is not YAML: {_one_line(error)}.") from error


def tree_text(tree: Tree) -> str:
    """A tree as YAML, its innermost mappings and lists on one line each."""
    yaml, stream = _yaml(), StringIO()
    yaml.default_flow_style = None
    yaml.dump(tree, stream)
    return stream.getvalue()


def write_tree(tree: Tree, path: Path, comments: Iterable[str] = ()) -> None:
    """Write a tree with lines of comments above it, whole or not at all; creates the folder where missing."""
    write_whole(path, "".join(f"# {line}\n" for line in comments) + tree_text(tree))


def _yaml() -> YAML:
    """The library, in Python alone: in its parser in C, deeply nested brackets crash the process."""
    yaml = _Yaml(typ="safe", pure=True)
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # the library's is too narrow
    yaml.width = 1000
    yaml.Resolver, yaml.Constructor, yaml.Representer = _Resolver, _Constructor, _Representer
    return yaml


def _one_line(error: Exception) -> str:
    """The library's several lines in one, with the place."""
    problem = getattr(error, "problem", None) or str(error)
    mark = getattr(error, "problem_mark", None)
    place = f" in line {mark.line + 1}" if mark is not None else ""
    return " ".join(f"{problem}{place}".split())
