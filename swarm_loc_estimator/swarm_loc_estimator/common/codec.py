"""Between trees and dataclasses: specs of fields, of `number` or `entry`, read, write and describe them."""

from __future__ import annotations

import difflib
import re
import reprlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from swarm_loc_estimator.common.parameters import NumberSpec

Tree = Any  # dict, list, str, int, float, bool or None
Schema = dict[str, Any]
Made = TypeVar("Made")

WHOLE_FILE = "the file"  # The key of the outermost mapping

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 100


@dataclass(frozen=True)
class EntrySpec:
    """What an entry may be that is no number."""

    read: Callable[[TreeChecks, Tree, str], Any]  # Checks and converts the value at a key
    schema: Schema  # What editors may know of it
    wanted: str = ""  # What is missing where it is left out, for the end of a sentence


Spec = NumberSpec | EntrySpec


def entry(spec: EntrySpec) -> dict[str, EntrySpec]:
    """The metadata of a dataclass field that is an entry."""
    return {"spec": spec}


def entry_specs(cls: type, without: Collection[str] = ()) -> dict[str, Spec]:
    """The entries of a dataclass: field name -> what it may be, in the order of definition."""
    return {f.name: f.metadata["spec"] for f in fields(cls) if "spec" in f.metadata and f.name not in without}


def switch(doc: str) -> EntrySpec:
    """True or false."""

    def read(checks: TreeChecks, value: Tree, key: str) -> bool:
        if not isinstance(value, bool):
            raise checks.error(key, value, "must be true or false")
        return value

    return EntrySpec(read, {"type": "boolean", "description": doc})


def address(high: int, doc: str) -> EntrySpec:
    """A whole number in [1, high], decimal or as 0x1F; `high` has only the hexadecimal digit f."""
    wanted = f"a whole number in [1, {high}]"
    pattern = rf"0[xX](?=.*[1-9A-Fa-f])[0-9A-Fa-f]{{1,{len(f'{high:x}')}}}"

    def read(checks: TreeChecks, value: Tree, key: str) -> int:
        is_text = isinstance(value, str) and re.fullmatch(pattern, value)
        number = int(value, 16) if is_text else value
        if isinstance(number, bool) or not isinstance(number, int) or not 1 <= number <= high:
            raise checks.error(key, value, f"must be {wanted}")
        return number

    decimal = {"type": "integer", "minimum": 1, "maximum": high, "description": doc}
    return EntrySpec(read, {"anyOf": [decimal, {"type": "string", "pattern": f"^{pattern}$"}]}, wanted)


def matching(pattern: str, rule: str, schema: Schema, wanted: str = "") -> EntrySpec:
    """A text that matches a pattern."""

    def read(checks: TreeChecks, value: Tree, key: str) -> str:
        if not isinstance(value, str) or not re.fullmatch(pattern, value, re.DOTALL):
            raise checks.error(key, value, f"must be {rule}")
        return value

    return EntrySpec(read, {"type": "string", **schema}, wanted)


def listed(wanted: str = "", **limits: float) -> EntrySpec:
    """A list of numbers; `limits` are those of the schema."""
    items = {"type": "number", **limits}
    return EntrySpec(TreeChecks.list_of_numbers, {"type": "array", "items": items}, wanted)


def properties(specs: Mapping[str, Spec], cls: type | None = None) -> Schema:
    """The schema of entries by name, with the defaults that they have in a dataclass."""
    defaults = {one.name: one.default for one in fields(cls)} if cls else {}
    schema: Schema = {}
    for name, spec in specs.items():
        if isinstance(spec, EntrySpec):
            schema[name] = {**spec.schema}
        else:
            schema[name] = {
                "type": ["number", "null"] if spec.optional else "number",
                "exclusiveMinimum" if spec.above else "minimum": spec.low,
                "maximum": spec.high,
                "description": f"{spec.doc}{'' if spec.unit == '1' else f' [{spec.unit}]'}",
            }
        if isinstance(defaults.get(name, MISSING), int | float | None):
            schema[name]["default"] = defaults[name]
    return schema


def to_tree(holder: Any, keep: Collection[str] = (), without: Collection[str] = ()) -> dict[str, Tree]:
    """The entries of a dataclass that differ from their defaults or are to be kept."""
    defaults = {
        one.name: one.default if one.default_factory is MISSING else one.default_factory()
        for one in fields(holder)
    }
    values = {name: getattr(holder, name) for name in entry_specs(type(holder), without)}
    return {
        name: to_tree(value) if is_dataclass(value) else _lists(value)
        for name, value in values.items()
        if value != defaults[name] or name in keep
    }


def _lists(value: Any) -> Tree:
    return [_lists(item) for item in value] if isinstance(value, tuple) else value


def shown(value: object) -> str:
    """A value for an error message: short, on one line."""
    return _SHORT.repr(value).replace("\n", " ")


def nearest(name: object, known: Iterable[str]) -> str:
    """The known word most like it, for the end of a sentence."""
    words = list(known)
    if not words:
        return "; none is known here"
    return f"; the nearest one is '{difflib.get_close_matches(str(name), words, 1, 0.0)[0]}'"


class TreeChecks:
    """Takes values out of one file; what is wrong becomes one sentence with file, dotted key and value."""

    def __init__(self, path: Path, error: type[ValueError]) -> None:
        self._path = path
        self._error_type = error

    def mapping(
        self, tree: Tree, key: str, known: Iterable[str] | None = None, required: Iterable[str] = ()
    ) -> dict[Any, Tree]:
        """A mapping; with `known`, only of these keys; with all that are required."""
        if tree is None:
            tree = {}
        if not isinstance(tree, dict):
            raise self.error(key, tree, "must be a mapping of keys to values")
        if known is not None:
            allowed = tuple(known)
            for name in tree:
                if name not in allowed:
                    raise self.said(f"{shown(_inside(key, name))} is not a known key{nearest(name, allowed)}")
        for name in required:
            if name not in tree:
                raise self.said(f"{key} lacks {name}")
        return tree

    def values(
        self,
        tree: Tree,
        key: str,
        specs: Mapping[str, Spec],
        required: Iterable[str] = (),
        others: Iterable[str] = (),
    ) -> dict[str, Any]:
        """The entries of a mapping, each as it may be; other keys are allowed but left out."""
        mapping = self.mapping(tree, key, (*specs, *others))
        self.require(mapping, key, {name: specs[name] for name in required})
        return {
            name: self.number(value, _inside(key, name), spec)
            if isinstance(spec := specs[name], NumberSpec)
            else spec.read(self, value, _inside(key, name))
            for name, value in mapping.items()
            if name in specs
        }

    def require(self, mapping: Collection[str], key: str, specs: Mapping[str, Spec]) -> None:
        """Refuse a mapping that lacks one of some entries."""
        for name, spec in specs.items():
            if name not in mapping:
                wanted = spec.wanted
                raise self.said(f"{key} lacks {name}{wanted and ', '}{wanted}")

    def number(self, value: Tree, key: str, spec: NumberSpec) -> float | None:
        """One number in its range."""
        if value is None and spec.optional:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(key, value, f"must be {spec.wanted}")
        if not spec.allows(value):
            raise self.error(key, value, f"must lie in {spec.range_text}")
        return float(value)

    def version(self, value: Tree, version: int) -> None:
        """Refuse another version of a file's format than the one."""
        if value != version or isinstance(value, bool):
            raise self.error("fileversion", value, f"must be {version}")

    def items(self, tree: Tree, key: str) -> list[Tree]:
        """A list."""
        if not isinstance(tree, list):
            raise self.error(key, tree, "must be a list")
        return tree

    def list_of_numbers(self, tree: Tree, key: str) -> tuple[float, ...]:
        """A list of numbers."""
        values = []
        for index, value in enumerate(self.items(tree, key)):
            if isinstance(value, bool) or not isinstance(value, int | float) or not -1e9 < value < 1e9:
                raise self.error(f"{key}[{index}]", value, "must be a number")
            values.append(float(value))
        return tuple(values)

    def made(self, prefix: str, cls: Callable[..., Made], **values: Any) -> Made:
        """An object of values; its error is about this file, at the key that the prefix begins."""
        try:
            return cls(**values)
        except ValueError as error:
            raise self.said(f"{prefix}{error}".removesuffix(".")) from error

    def error(self, key: str, value: object, rule: str) -> ValueError:
        """The sentence about a value that breaks a rule."""
        return self.said(f"{key} is {shown(value)} but {rule}")

    def said(self, sentence: str) -> ValueError:
        """A sentence, given without its full stop, about this file."""
        return self._error_type(f"{self._path}: {sentence}.")


def _inside(key: str, name: object) -> Any:
    """The dotted key of an entry of a mapping."""
    return name if key == WHOLE_FILE else f"{key}.{name}"
