"""The firmware of a PushBot: its main loop, and the limited rate of its wire."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.pushbot.hardware import BAUD_RATE, FirmwareGeneration
from swarm_loc_drivers.sim.pushbot.board import TX_BUFFER, Board, PushbotBody
from swarm_loc_drivers.sim.pushbot.console import Console

_BITS_PER_BYTE = 10
LATE_SHARE = 0.03
"""Share of received bytes that are parsed between a tick of the clock and the controllers' update."""
_MAX_GAP_S = 0.02  # A wire that was blocked for longer does not catch up


class PushbotFirmware:
    """A robot's firmware, for any link that waits for whoever reads it (RTS/CTS, TCP).

    Args:
        body: The robot.
        generation: Which firmware it is.
        baud_rate: Of the wire to the host or its radio [bit/s].
        seed: Decides which bytes are parsed just after a tick of the clock, see `Motor`.

    Attributes:
        late_share: Share of these bytes.
    """

    def __init__(
        self, body: PushbotBody, generation: FirmwareGeneration, baud_rate: int = BAUD_RATE, seed: int = 0
    ) -> None:
        self.late_share = LATE_SHARE
        self._rng = np.random.default_rng(seed)
        self._body = body
        self.board = Board(body, generation)
        self.board.was_reset = False
        self._generation = generation
        self._console = Console(self.board, generation)
        self._bytes_per_s = baud_rate / _BITS_PER_BYTE
        self._sent_ns = body.now_ns
        self._received = b""

    def millisecond(self) -> None:
        """A millisecond has passed in the world."""
        self.board.tick()
        self._work()
        self.board.run_controllers()

    def see(self, words: NDArray[np.uint16], times_us: NDArray[np.int64]) -> None:
        """The camera has seen events `0yyyyyyy pxxxxxxx` (N,) at times of the world (N,) [us]."""
        self.board.see(words, times_us, self._budget() // 2)

    def receive(self, data: bytes) -> bytes:
        """Take bytes; answers come with `stream`."""
        self._received += data
        if not data or self._rng.random() >= self.late_share:
            self._work()
        return b""

    def _work(self) -> None:
        """Run the main loop until it has to wait for room in the text buffer."""
        used = 0
        for character in self._received:
            if self.board.is_blocked:
                break
            self._console.take(character)
            used += 1
            if self.board.was_reset:
                self.board.was_reset = False
                self._console = Console(self.board, self._generation)
        self._received = self._received[used:]

    def stream(self) -> bytes:
        """The bytes carried by the wire since the last call."""
        board, now_ns = self.board, self._body.now_ns
        budget, parts = self._budget(), []
        self._sent_ns = now_ns
        while budget > 0:
            text_ns = board.texts[0][0] if board.texts else now_ns
            data = b""
            if board.is_streaming:
                data = board.ring.take(board.board_us(text_ns // 1000), budget, board.stamp_bytes)
            if board.texts:
                data += board.texts.popleft()[1]
            elif not data:
                break
            parts.append(data)
            budget -= len(data)
        return b"".join(parts)

    def disconnect(self) -> None:
        """The host has disconnected, which the board does not notice."""

    def _budget(self) -> int:
        """Bytes that the wire can carry since the last call."""
        elapsed_s = min((self._body.now_ns - self._sent_ns) * 1e-9, _MAX_GAP_S)
        return min(round(elapsed_s * self._bytes_per_s), 2 * TX_BUFFER)
