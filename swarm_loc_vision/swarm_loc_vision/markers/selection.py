"""Parse ids and sizes of the markers in use: "5", "0-31", "100-119:0.08"."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_IDS = re.compile(r"(\d+)(?:-(\d+))?")
_LENGTH = re.compile(r"(\d+)(?:-(\d+))?:(\d*\.?\d+)")
_LONGEST_M = 10.0


class SelectionError(ValueError):
    """A text that selects nothing; the message is the rest of a sentence about it."""


def parse_ids(texts: Sequence[str], count: int) -> NDArray[np.int64]:
    """Ids (N,), ascending.

    Args:
        texts: Each one id or a range.
        count: Ids that there are.

    Raises:
        SelectionError: A text is not one, or an id does not exist.
    """
    chosen: set[int] = set()
    for text in texts:
        match = _IDS.fullmatch(text.strip())
        if match is None:
            raise SelectionError(f"'{text}' must be an id such as 5 or a range such as 0-31.")
        first, last = int(match[1]), int(match[2] or match[1])
        if not first <= last < count:
            raise SelectionError(f"'{text}' must ascend within 0-{count - 1}.")
        chosen.update(range(first, last + 1))
    return np.array(sorted(chosen), np.int64)


def parse_lengths(texts: Sequence[str], count: int) -> dict[int, float]:
    """Marker id -> side [m].

    Args:
        texts: Each an id or a range, a colon, and a length in metres.
        count: Ids that there are.

    Raises:
        SelectionError: A text is not one, an id does not exist, or a length is out of range.
    """
    lengths: dict[int, float] = {}
    for text in texts:
        match = _LENGTH.fullmatch(text.strip())
        if match is None:
            raise SelectionError(f"'{text}' must be ids and a length in metres, such as 100-119:0.08.")
        length = float(match[3])
        if not 0.0 < length <= _LONGEST_M:
            raise SelectionError(f"'{text}' must give a length in (0, {_LONGEST_M:g}] m.")
        ids = text.partition(":")[0]
        lengths.update(dict.fromkeys(parse_ids([ids], count).tolist(), length))
    return lengths
