"""The section `ir` of a swarm description: a robot's infrared board."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.common.yaml_tree import Tree
from swarm_loc_estimator.swarm.board_file import IrPlatformFileError, load_ir_platform
from swarm_loc_estimator.swarm.ir_board import IrGains, IrMethod, IrPlatform, RobotIr
from swarm_loc_estimator.swarm.ir_curves import IrPlatformError
from swarm_loc_estimator.swarm.tree_checks import TreeChecks, nearest

_NUMBERS = number_specs(RobotIr)
_DEAD = ("dead_sensors", "dead_emitters")
_LAYER = ("platform", "estimator", "gains", *_DEAD, *_NUMBERS)
_GAIN_LISTS = ("sensor", "emitter")
_GAIN_NUMBERS = number_specs(IrGains)
_METHODS = {method.value: method for method in IrMethod}
MAX_BOARD_ID = 2**16 - 1

Values = dict[str, Any]


class IrSection:
    """Reads the section of one file.

    Args:
        checks: Checks of the file.
        folder: Folder of the file, to which platform paths are relative.
    """

    def __init__(self, checks: TreeChecks, folder: Path) -> None:
        self._checks = checks
        self._folder = folder
        self._platforms: dict[str, IrPlatform] = {}

    def layer(self, tree: Tree, key: str, *, of_robot: bool) -> Values | None:
        """The values of one layer (defaults, type or robot); only a robot has an id. None: no board."""
        if tree is None:
            return None
        mapping = self._checks.mapping(tree, key, ("id", *_LAYER) if of_robot else _LAYER)
        readers: dict[str, Callable[[Tree, str], Any]] = {
            "id": partial(self._checks.address, high=MAX_BOARD_ID),
            "platform": self._platform,
            "estimator": self._method,
            "gains": self._gains,
            **dict.fromkeys(_DEAD, self._elements),
        }
        return {
            name: readers[name](value, f"{key}.{name}")
            if name in readers
            else self._checks.number(value, f"{key}.{name}", _NUMBERS[name])
            for name, value in mapping.items()
        }

    def board(self, values: Values | None, key: str) -> RobotIr | None:
        """The board of a robot from the merged values of its layers."""
        if values is None or not values:
            return None
        if "platform" not in values:
            raise self._checks.said(f"{key} lacks platform, the name of a packaged one or the path of a file")
        if "id" not in values:
            raise self._checks.said(f"{key} lacks id, a whole number in [1, {MAX_BOARD_ID}]")
        source = values["platform"]
        platform, gains = self._platforms[source], values.get("gains")
        if gains is not None and len(gains.sensor) != platform.n:
            raise self._checks.said(
                f"{key}.gains has {len(gains.sensor)} sensors and emitters"
                f" but must have the {platform.n} of its platform"
            )
        for name in _DEAD:
            if wrong := [k for k in values.get(name, ()) if k >= platform.n]:
                raise self._checks.said(
                    f"{key}.{name} has {wrong[0]} but elements are numbered 0 to {platform.n - 1}"
                )
        rest = {name: value for name, value in values.items() if name not in ("platform", "gains")}
        return RobotIr(platform=platform, source=source, gains=gains, **rest)

    def _platform(self, value: Tree, key: str) -> str:
        """The source of a platform; also loads the platform."""
        if not isinstance(value, str):
            raise self._checks.error(key, value, "must be the name of a packaged one or the path of a file")
        is_path = value.endswith((".yaml", ".yml"))
        source = str((self._folder / value).resolve()) if is_path else value
        try:
            self._platforms[source] = self._platforms.get(source) or load_ir_platform(source)
        except IrPlatformFileError as error:
            raise self._checks.said(f"{key}: {str(error).removesuffix('.')}") from error
        return source

    def _elements(self, value: Tree, key: str) -> tuple[int, ...]:
        """Numbers of elements, from 0 on."""
        numbers = self._checks.list_of_numbers(value, key)
        if any(number != int(number) or number < 0 for number in numbers):
            raise self._checks.error(key, value, "must be a list of numbers of elements, from 0 on")
        return tuple(int(number) for number in numbers)

    def _method(self, value: Tree, key: str) -> IrMethod:
        """An estimator by name."""
        if not isinstance(value, str) or value not in _METHODS:
            raise self._checks.error(key, value, f"must be one of the estimators{nearest(value, _METHODS)}")
        return _METHODS[value]

    def _gains(self, tree: Tree, key: str) -> IrGains | None:
        """Factors of all elements; null: never calibrated."""
        if tree is None:
            return None
        mapping = self._checks.mapping(tree, key, required=_GAIN_LISTS)
        values: Values = {**self._checks.numbers(tree, key, _GAIN_NUMBERS, others=_GAIN_LISTS)}
        for name in _GAIN_LISTS:
            values[name] = self._checks.list_of_numbers(mapping[name], f"{key}.{name}")
        try:
            return IrGains(**values)
        except IrPlatformError as error:
            raise self._checks.said(f"{key.removesuffix('gains')}{str(error).removesuffix('.')}") from error


def ir_tree(ir: RobotIr, folder: Path) -> Values:
    """The section as it is written to a file in a folder, without the id."""
    is_path = Path(ir.source).is_absolute()
    values: Values = {"platform": os.path.relpath(ir.source, folder.resolve()) if is_path else ir.source}
    if ir.estimator is not IrMethod.LIKELIHOOD:
        values["estimator"] = ir.estimator.value
    if ir.gains is not None:
        gains = asdict(ir.gains)
        values["gains"] = {
            **{name: list(gains[name]) for name in _GAIN_LISTS},
            **_unlike_default(gains, IrGains, _GAIN_NUMBERS),
        }
    values |= {name: list(getattr(ir, name)) for name in _DEAD if getattr(ir, name)}
    numbers = {name: getattr(ir, name) for name in _NUMBERS}
    return {**values, **_unlike_default(numbers, RobotIr, _NUMBERS)}


def _unlike_default(values: Values, cls: type, names: Iterable[str]) -> Values:
    """Those numbers of a dataclass that are not its defaults."""
    fields: Any = cls
    return {n: values[n] for n in names if values[n] != fields.__dataclass_fields__[n].default}
