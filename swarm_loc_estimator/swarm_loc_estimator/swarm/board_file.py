"""Read and write infrared boards as YAML; config/ir/*.yaml of this package show the format.

The section `ir` of a swarm description: a robot's infrared board.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from swarm_loc_estimator.common.parameters import NumberSpec, UserError, number_specs
from swarm_loc_estimator.common.yaml_tree import (
    WHOLE_FILE,
    Tree,
    TreeChecks,
    YamlTreeError,
    read_tree,
    shown,
    tree_text,
)
from swarm_loc_estimator.swarm.ir_board import (
    POWERS,
    Amplitude,
    AngleCurve,
    IrGains,
    IrPlatform,
    IrPlatformError,
    PowerCurve,
    PowerPiece,
    RobotIr,
    TabulatedCurve,
)

_SECTION_NUMBERS = number_specs(RobotIr)
_DEAD = ("dead_sensors", "dead_emitters")
_LAYER = ("platform", "gains", *_DEAD, *_SECTION_NUMBERS)
_GAIN_LISTS = ("sensor", "emitter")
_GAIN_NUMBERS = number_specs(IrGains)
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
        if isinstance(tree, dict) and "estimator" in tree:
            raise self._checks.said(
                f"{key}.estimator is no longer an option: poses are always estimated by likelihood; remove it"
            )
        mapping = self._checks.mapping(tree, key, ("id", *_LAYER) if of_robot else _LAYER)
        readers: dict[str, Callable[[Tree, str], Any]] = {
            "id": partial(self._checks.address, high=MAX_BOARD_ID),
            "platform": self._platform,
            "gains": self._gains,
            **dict.fromkeys(_DEAD, self._elements),
        }
        return {
            name: readers[name](value, f"{key}.{name}")
            if name in readers
            else self._checks.number(value, f"{key}.{name}", _SECTION_NUMBERS[name])
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
    if ir.gains is not None:
        gains = asdict(ir.gains)
        values["gains"] = {
            **{name: list(gains[name]) for name in _GAIN_LISTS},
            **_unlike_default(gains, IrGains, _GAIN_NUMBERS),
        }
    values |= {name: list(getattr(ir, name)) for name in _DEAD if getattr(ir, name)}
    numbers = {name: getattr(ir, name) for name in _SECTION_NUMBERS}
    return {**values, **_unlike_default(numbers, RobotIr, _SECTION_NUMBERS)}


def _unlike_default(values: Values, cls: type, names: Iterable[str]) -> Values:
    """Those numbers of a dataclass that are not its defaults."""
    fields: Any = cls
    return {n: values[n] for n in names if values[n] != fields.__dataclass_fields__[n].default}


FILE_VERSION = 1
_FOLDER = Path(__file__).parents[1] / "config" / "ir"
_NUMBERS = number_specs(IrPlatform)
_PARTS = ("fileversion", "angles", "sensor", "emitter", "powers")
_TABLE = ("angles", "values")
_BELOW = NumberSpec("rad", 0.0, math.pi, True, "where the next piece begins")

Made = TypeVar("Made")


class IrPlatformFileError(UserError):
    """An invalid platform file; the message is one sentence with file, key and value."""


def packaged_platforms() -> tuple[str, ...]:
    """Names of the platforms in this package."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.yaml")))


def load_ir_platform(name: str, folder: Path | None = None) -> IrPlatform:
    """Read and check a platform.

    Args:
        name: Of a packaged platform, such as "droplet", or the path of a file (it ends in .yaml).
        folder: Base of a relative path; None: the working folder.

    Raises:
        IrPlatformFileError: One sentence with file, key, value and what is allowed.
    """
    if name.endswith((".yaml", ".yml")):
        path = (folder or Path()) / name
    elif name in packaged_platforms():
        path = _FOLDER / f"{name}.yaml"
    else:
        raise IrPlatformFileError(
            f"{shown(name)} is no packaged infrared platform ({', '.join(packaged_platforms())})"
            " and no path of a .yaml file."
        )
    try:
        return _Reader(path, IrPlatformFileError).platform(read_tree(path))
    except YamlTreeError as error:
        raise IrPlatformFileError(str(error)) from error


def save_ir_platform(platform: IrPlatform, path: Path, comment: str = "") -> None:
    """Write a board that `load_ir_platform` reads back equal.

    Args:
        platform: Board to write.
        path: The file; replaced when it exists, its folder created when missing.
        comment: Comment lines for the top of the file.
    """
    laws = dict(zip(platform.powers, platform.amplitudes, strict=True))
    tree = {
        "fileversion": FILE_VERSION,
        "angles": list(platform.angles),
        "sensor": _curve_tree(platform.sensor),
        "emitter": _curve_tree(platform.emitter),
        "powers": {name: _number_tree(law, Amplitude) for name, law in laws.items()},
        **_number_tree(platform, IrPlatform),
    }
    text = "".join(f"# {line}\n" for line in comment.splitlines()) + tree_text(tree)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


class _Reader(TreeChecks):
    """Converts the tree of one file to a platform, and checks it."""

    def platform(self, tree: Tree) -> IrPlatform:
        """The whole file."""
        keys = self.mapping(tree, WHOLE_FILE, (*_PARTS, *_NUMBERS), _PARTS)
        if keys["fileversion"] != FILE_VERSION or isinstance(keys["fileversion"], bool):
            raise self.error("fileversion", keys["fileversion"], f"must be {FILE_VERSION}")
        return self._made(
            "",
            IrPlatform,
            angles=self.list_of_numbers(keys["angles"], "angles"),
            sensor=self._curve(keys["sensor"], "sensor"),
            emitter=self._curve(keys["emitter"], "emitter"),
            amplitudes=self._amplitudes(keys["powers"]),
            **{name: self.number(keys[name], name, spec) for name, spec in _NUMBERS.items() if name in keys},
        )

    def _curve(self, tree: Tree, key: str) -> AngleCurve:
        """S or E, as pieces or as a table."""
        keys = self.mapping(tree, key, ("pieces", "angles", "values"))
        if "pieces" not in keys:
            self.mapping(tree, key, required=_TABLE)
            lists = {name: self.list_of_numbers(keys[name], f"{key}.{name}") for name in _TABLE}
            return self._made(f"{key}.", TabulatedCurve, **lists)
        self.mapping(tree, key, ("pieces",))
        *inner, last = self.items(keys["pieces"], f"{key}.pieces") or [None]
        pieces = [self._piece(piece, f"{key}.pieces[{k}]") for k, piece in enumerate(inner)]
        pieces.append(self._piece(last, f"{key}.pieces[{len(inner)}]", below=math.pi))
        return self._made(f"{key}.", PowerCurve, pieces=tuple(pieces))

    def _piece(self, tree: Tree, key: str, below: float | None = None) -> PowerPiece:
        """One sum of powers; `below` is where the last one ends."""
        known = ("terms",) if below is not None else ("below", "terms")
        keys = self.mapping(tree, key, known, known)
        terms = []
        for k, item in enumerate(self.items(keys["terms"], f"{key}.terms")):
            term = self.list_of_numbers(item, f"{key}.terms[{k}]")
            if len(term) != 2:
                raise self.error(f"{key}.terms[{k}]", item, "must be [coefficient, exponent]")
            terms.append((term[0], term[1]))
        if below is None:
            below = self.number(keys["below"], f"{key}.below", _BELOW)
        return PowerPiece(below or 0.0, tuple(terms))

    def _amplitudes(self, tree: Tree) -> tuple[Amplitude, ...]:
        """A of each power."""
        keys = self.mapping(tree, "powers", POWERS, POWERS[:1])
        specs = number_specs(Amplitude)
        return tuple(
            self._made(
                f"powers.{name}.",
                Amplitude,
                **self.numbers(keys[name], f"powers.{name}", specs, required=("scale",)),
            )
            for name in POWERS[: len(keys)]
        )

    def _made(self, prefix: str, cls: Callable[..., Made], **arguments: Any) -> Made:
        """Create an object; add file and key to the message of its error."""
        try:
            return cls(**arguments)
        except IrPlatformError as error:
            raise IrPlatformFileError(f"{self._path}: {prefix}{error}") from error


def _curve_tree(curve: TabulatedCurve | PowerCurve) -> dict[str, object]:
    """A curve as a table or in pieces."""
    if isinstance(curve, TabulatedCurve):
        return {"angles": list(curve.angles), "values": list(curve.values)}
    pieces: list[dict[str, object]] = [
        {"below": piece.below, "terms": [list(term) for term in piece.terms]} for piece in curve.pieces
    ]
    del pieces[-1]["below"]
    return {"pieces": pieces}


def _number_tree(holder: IrPlatform | Amplitude, cls: type) -> dict[str, object]:
    """The numbers of a dataclass."""
    names = number_specs(cls)
    return {field.name: getattr(holder, field.name) for field in fields(cls) if field.name in names}
