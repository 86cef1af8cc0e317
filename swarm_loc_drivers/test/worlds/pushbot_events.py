"""Events of PushBots for tests, and their bytes, encoded apart from the emulator."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.pushbot.protocol import TIMESTAMPS


class Sent(NamedTuple):
    """Events as columns (N,): place, polarity bit, and time [us]."""

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    p: NDArray[np.int64]
    t: NDArray[np.int64]


def random_events(seed: int, count: int, *, start_us: int = 0, longest_us: int = 400) -> Sent:
    """Events anywhere, apart by up to `longest_us`."""
    rng = np.random.default_rng(seed)
    t = start_us + np.cumsum(rng.integers(0, longest_us, count))
    return Sent(rng.integers(0, 128, count), rng.integers(0, 128, count), rng.integers(0, 2, count), t)


def event_pieces(events: Sent, timestamps: str) -> list[bytes]:
    """The bytes of each event, as the board's user guide has them."""
    size, before, pieces = TIMESTAMPS[timestamps], int(events.t[0]) if len(events.t) else 0, []
    for x, y, p, t in zip(*(column.tolist() for column in events), strict=True):
        stamp = b""
        if size > 0:
            stamp = (t % (1 << 8 * size)).to_bytes(size, "big")
        elif size < 0:
            stamp, before = _difference(t - before), t
        pieces.append(bytes([0x80 | y, p << 7 | x]) + stamp)
    return pieces


def _difference(elapsed: int) -> bytes:
    """Seven bits a byte, most significant first, the last one marked; sizes as the firmware has them."""
    size = 1 + (elapsed >= 0x7F) + (elapsed >= 0x3FFF) + (elapsed >= 0x1FFFFF)
    digits = [elapsed >> 7 * (size - 1 - k) & 0x7F for k in range(size)]
    digits[-1] |= 0x80
    return bytes(digits)
