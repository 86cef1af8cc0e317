"""A wire that corrupts bytes, in one of many ways."""

from __future__ import annotations

import numpy as np

PARTIAL = ("lost", "doubled", "swapped", "flipped", "inserted", "mixed")
"""Ways that hurt a share of the bytes, so that some answers still make sense."""
NONSENSE = ("shuffled", "flooded", "dripped", "random", "zeros")
"""Ways of which no answer makes sense, or only by chance."""
_FLOOD = 200  # Largest number of random bytes at once
_DRIP = 0.1  # Probability that a dripping wire gives a byte


class Wire:
    """Corrupts what passes by a kind of `PARTIAL`, for a share of the bytes, or of `NONSENSE`."""

    def __init__(self, kind: str, share: float, rng: np.random.Generator) -> None:
        self._kind, self._share, self._rng = kind, share, rng

    def __call__(self, data: bytes) -> bytes:
        """What arrives of the bytes that are sent, or without any."""
        rng, array = self._rng, np.frombuffer(data, np.uint8).copy()
        if self._kind == "shuffled":
            return bytes(rng.permutation(array))
        if self._kind == "flooded":
            return rng.bytes(int(rng.integers(_FLOOD))) + bytes(rng.permutation(array))
        if self._kind == "dripped":
            return rng.bytes(int(rng.random() < _DRIP))
        if self._kind in {"random", "zeros"}:
            return rng.bytes(len(data)) if self._kind == "random" else bytes(len(data))
        kind = str(rng.choice(PARTIAL[:-1])) if self._kind == "mixed" else self._kind
        return self._hurt(kind, array, rng.random(len(array)) < self._share)

    def _hurt(self, kind: str, array: np.ndarray[tuple[int], np.dtype[np.uint8]], hit: object) -> bytes:
        """Hurt the bytes that are hit."""
        places = np.flatnonzero(np.asarray(hit))
        if kind == "lost":
            return bytes(np.delete(array, places))
        if kind == "doubled":
            return bytes(np.insert(array, places, array[places]))
        if kind == "inserted":
            return bytes(np.insert(array, places, self._rng.integers(0, 256, places.size).astype(np.uint8)))
        if kind == "flipped":
            array[places] ^= (1 << self._rng.integers(0, 8, places.size)).astype(np.uint8)
        for place in places[places > 0] if kind == "swapped" else ():
            array[[place - 1, place]] = array[[place, place - 1]]
        return bytes(array)
