"""Numbers on a command line, within their ranges, and files that a command is to write."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

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
