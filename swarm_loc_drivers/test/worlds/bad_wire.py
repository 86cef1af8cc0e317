"""A wire to an emulated robot that loses and twists bytes."""

import numpy as np

from swarm_loc_drivers.sim.link_host import ConsoleFirmware

_LOST = 0.7  # Share of the hurt bytes that are lost


class BadWire:
    """A firmware at the end of a wire that hurts bytes in both directions.

    Args:
        firmware: The robot's.
        share: Of the bytes that are hurt.
        seed: Draws them.

    Attributes:
        hurt: Number of bytes that were hurt.
    """

    def __init__(self, firmware: ConsoleFirmware, share: float, seed: int) -> None:
        self.share, self.hurt = share, 0
        self._firmware = firmware
        self._rng = np.random.default_rng(seed)

    def receive(self, data: bytes) -> bytes:
        """Over the wire and back."""
        return self._worn(self._firmware.receive(self._worn(data)))

    def stream(self) -> bytes:
        """What the robot says by itself."""
        return self._worn(self._firmware.stream())

    def _worn(self, data: bytes) -> bytes:
        array = np.frombuffer(data, np.uint8).copy()
        hit = self._rng.random(len(array)) < self.share
        lost = hit & (self._rng.random(len(array)) < _LOST)
        array[hit] = self._rng.integers(0, 256, hit.sum())
        self.hurt += int(hit.sum())
        return bytes(array[~lost])
