"""The BCH code of ARToolKitPlus: 4096 ids in 36 bits, at least 9 bits apart in one orientation.

BCH(63, 39), t = 4, over GF(64) with x^6 + x + 1, shortened to (36, 12). A codeword holds the remainder in
bits 0 to 23 and the id above; ARToolKitPlus turns some bits round so that no id looks plain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

IDS = 4096

_GENERATOR = 0x1DB2777
"""The generator polynomial, degree 24, lowest power in bit 0."""
_PARITY_BITS = 24
_MASK = 0x8F80B8750


def codewords() -> NDArray[np.uint64]:
    """(4096,) the 36 cells of each id, row by row, the first one in bit 35; 1 is white."""
    words = np.arange(IDS, dtype=np.uint64) << np.uint64(_PARITY_BITS)
    remainder = words.copy()
    for bit in range(35, _PARITY_BITS - 1, -1):
        set_here = (remainder >> np.uint64(bit)) & np.uint64(1)
        remainder ^= set_here * np.uint64(_GENERATOR << (bit - _PARITY_BITS))
    cells: NDArray[np.uint64] = (words | remainder) ^ np.uint64(_MASK)
    return cells
