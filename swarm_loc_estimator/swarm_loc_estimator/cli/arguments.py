"""Numbers on a command line, within their ranges."""

from __future__ import annotations

import argparse
from collections.abc import Callable
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
