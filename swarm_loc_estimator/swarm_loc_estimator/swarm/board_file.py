"""Read and write infrared boards as YAML; config/ir/*.yaml of this package show the format."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from swarm_loc_estimator.common.parameters import NumberSpec, UserError, number_specs
from swarm_loc_estimator.common.yaml_tree import Tree, YamlTreeError, read_tree, shown, tree_text
from swarm_loc_estimator.swarm.ir_board import POWERS, IrPlatform
from swarm_loc_estimator.swarm.ir_curves import (
    Amplitude,
    AngleCurve,
    IrPlatformError,
    PowerCurve,
    PowerPiece,
    TabulatedCurve,
)
from swarm_loc_estimator.swarm.tree_checks import WHOLE_FILE, TreeChecks

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
