"""Checks on the way from a YAML tree to dataclasses: known keys, lists, numbers in their range."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from swarm_loc_estimator.common.parameters import NumberSpec
from swarm_loc_estimator.common.yaml_tree import Tree, shown

Numbers = dict[str, "float | None"]

WHOLE_FILE = "the file"  # The key of the outermost mapping


class TreeChecks:
    """Takes values out of one file; what is wrong becomes one sentence with file, dotted key and value.

    Args:
        path: The file.
        error: The kind of error that is raised.
    """

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
                    where = shown(name) if key == WHOLE_FILE else shown(f"{key}.{name}")
                    raise self.said(f"{where} is not a known key{nearest(name, allowed)}")
        for name in required:
            if name not in tree:
                raise self.said(f"{key} lacks {name}")
        return tree

    def numbers(
        self,
        tree: Tree,
        key: str,
        specs: Mapping[str, NumberSpec],
        required: Iterable[str] = (),
        others: Iterable[str] = (),
    ) -> Numbers:
        """The numbers of a mapping, each in its range; other keys are allowed but left out."""
        mapping = self.mapping(tree, key, (*specs, *others))
        for name in required:
            if name not in mapping:
                raise self.said(f"{key} lacks {name}, a number in {specs[name].range_text}")
        return {
            name: self.number(value, f"{key}.{name}", specs[name])
            for name, value in mapping.items()
            if name in specs
        }

    def number(self, value: Tree, key: str, spec: NumberSpec) -> float | None:
        """One number in its range."""
        if value is None and spec.optional:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(key, value, f"must be a number in {spec.range_text}")
        try:
            number = float(value)
        except OverflowError:  # a whole number of hundreds of digits
            number = math.inf
        if not spec.allows(number):
            raise self.error(key, value, f"must lie in {spec.range_text}")
        return number

    def address(self, value: Tree, key: str, high: int) -> int:
        """A whole number in [1, high], decimal or in hexadecimal, see `hexadecimal`."""
        is_text = isinstance(value, str) and re.fullmatch(hexadecimal(high), value)
        number = int(value, 16) if is_text else value
        if isinstance(number, bool) or not isinstance(number, int) or not 1 <= number <= high:
            raise self.error(key, value, f"must be a whole number in [1, {high}]")
        return number

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

    def error(self, key: str, value: object, rule: str) -> ValueError:
        """The sentence about a value that breaks a rule."""
        return self.said(f"{key} is {shown(value)} but {rule}")

    def said(self, sentence: str) -> ValueError:
        """A sentence, given without its full stop, about this file."""
        return self._error_type(f"{self._path}: {sentence}.")


def hexadecimal(high: int) -> str:
    """The pattern of texts such as 0x1F for whole numbers in [1, high]; `high` has only the digit f."""
    return rf"0[xX](?=.*[1-9A-Fa-f])[0-9A-Fa-f]{{1,{len(f'{high:x}')}}}"


def nearest(name: object, known: Iterable[str]) -> str:
    """The known word most like it, for the end of a sentence."""
    words = list(known)
    if not words:
        return "; none is known here"
    return f"; the nearest one is '{difflib.get_close_matches(str(name), words, 1, 0.0)[0]}'"
