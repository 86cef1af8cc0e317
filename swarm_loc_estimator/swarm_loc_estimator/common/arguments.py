"""Read command lines: numbers within their ranges, parameters by name, bags and files to write."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

from swarm_loc_estimator.common.bags.bag_file import BagError
from swarm_loc_estimator.common.parameters import ParameterError, Value, from_values, parameter_specs

Parameters = TypeVar("Parameters")
Number = TypeVar("Number", int, float)


def number_in(low: Number, high: Number, unit: str = "") -> Callable[[str], Number]:
    """A reader for argparse of numbers of the kind of their limits; anything else ends the command."""

    def read(text: str) -> Number:
        try:
            value = type(low)(text)
        except ValueError:
            value = None
        if value is None or not low <= value <= high:
            raise argparse.ArgumentTypeError(
                f"{text} must be a number in [{low:g}, {high:g}]{unit and ' '}{unit}"
            )
        return value

    return read


def folder_to_write(text: str) -> Path:
    """A folder for argparse that is there or can be made; anything else ends the command before its work."""
    path = Path(text)
    nearest = next(one for one in (path, *path.absolute().parents) if one.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise argparse.ArgumentTypeError(f"{path} cannot be written: {nearest} is no folder that is writable")
    return path


def yaml_to_write(text: str) -> Path:
    """A YAML file for argparse that can be written, and beside it a picture of the same name."""
    path = Path(text)
    if path.suffix not in (".yaml", ".yml"):
        raise argparse.ArgumentTypeError(f"'{text}' must end in .yaml")
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{path} cannot be written: it is a folder")
    folder_to_write(str(path.parent))
    return path


def mcap_to_write(text: str) -> Path:
    """An MCAP file for argparse that can be written."""
    path = Path(text)
    if path.suffix != ".mcap":
        raise argparse.ArgumentTypeError(f"'{text}' must end in .mcap")
    folder = folder_to_write(str(path.parent))
    folder.mkdir(parents=True, exist_ok=True)
    return path


def add_bag(parser: argparse.ArgumentParser, content: str = "") -> None:
    """Add the arguments of a command that reads a bag: the bag itself, and its swarm description."""
    parser.add_argument("bag", type=Path, help=f"rosbag2 folder, .mcap or .db3 file{content}")
    parser.add_argument("--swarm", type=Path, help="swarm description (default: swarm.yaml beside the bag)")


def swarm_beside(bag: Path) -> Path:
    """The swarm description that belongs to a bag; raises BagError where there is no bag."""
    if not bag.exists():
        raise BagError(f"There is no bag '{bag}'.")
    return (bag if bag.is_dir() else bag.parent) / "swarm.yaml"


def add_set(parser: argparse.ArgumentParser, what: str) -> None:
    """Add `--set NAME=VALUE`, which may be given several times; see `parameters_of`."""
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=what)


def parameters_of(
    cls: type[Parameters], pairs: Sequence[str], given: Mapping[str, Value] = MappingProxyType({})
) -> Parameters:
    """A dataclass of parameters from texts such as `horizon_s=1.0`; defaults where there is none.

    Args:
        cls: The dataclass, see `parameters/table.py`.
        pairs: What a user has set.
        given: Values, by name, that a user cannot set.

    Raises:
        ParameterError: There is no such parameter, or a value cannot be used.
    """
    specs = {spec.name: spec for spec in parameter_specs(cls)}
    values = {name: spec.default for name, spec in specs.items()} | {**given}
    for pair in pairs:
        name, _, text = pair.partition("=")
        if name not in specs or name in given:
            known = ", ".join(name for name in specs if name not in given)
            raise ParameterError(f"--set {pair}: '{name}' is no parameter; there are {known}.")
        values[name] = specs[name].checked(_value(text, specs[name].default))
    return from_values(cls, values)


def _value(text: str, default: Value) -> object:
    """A text as the kind of value that the default is; one that is not is left to be refused."""
    if isinstance(default, tuple):
        return [part for part in text.split(",") if part]
    if isinstance(default, bool):
        return {"true": True, "false": False}.get(text, text)
    try:
        return type(default)(text)
    except ValueError:
        return text
