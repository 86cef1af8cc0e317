"""Launch options: read from the texts of launch arguments, and checked before any process starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from math import nan
from pathlib import Path
from typing import Any, TypeVar

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.launching.graph import GraphOptions
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_estimator.common.yaml_tree import read_tree
from swarm_loc_estimator.swarm.swarm_file import load_swarm

Options = TypeVar("Options")


def options_from(kind: type[Options], texts: Mapping[str, str]) -> Options:
    """A dataclass of options from texts by field name; an empty text means the default.

    Raises:
        ParameterError: One is missing, or is no number in its range.
    """
    return kind(**{one.name: _value(one, texts.get(one.name, "")) for one in fields(kind)})  # type: ignore[arg-type]


def _value(option: Field[Any], text: str) -> object:
    """An option as its field has it."""
    default: Any = option.default
    if not text:
        if default is MISSING:
            raise ParameterError(f"argument {option.name} is not set.")
        return default
    if "spec" not in option.metadata:
        return text == "true" if isinstance(default, bool) else text
    try:
        value = type(default)(text)
    except ValueError:
        value = nan
    spec = option.metadata["spec"]
    if not spec.allows(value):
        kind = "whole number" if isinstance(default, int) else "number"
        raise ParameterError(f"argument {option.name} = '{text}' must be a {kind} in {spec.range_text}.")
    return value


def check_graph(options: GraphOptions) -> None:
    """Make sure that the files of a graph can be used.

    Raises:
        UserError: Which cannot, and why.
    """
    load_swarm(Path(options.swarm_file))
    if options.bag is not None:
        with BagReader(Path(options.bag)):
            pass
    check_parameter_file(options.parameter_file)


def check_parameter_file(path: str | None) -> None:
    """Make sure that a file, if there is one, has ROS parameters.

    Raises:
        UserError: It cannot be read, or has none.
    """
    if path is not None and not _has_parameters(read_tree(Path(path))):
        raise ParameterError(f"argument params_file = '{path}' has no ros__parameters.")


def _has_parameters(tree: object) -> bool:
    """Whether some node is given parameters, in whatever namespace."""
    return isinstance(tree, dict) and ("ros__parameters" in tree or any(map(_has_parameters, tree.values())))
