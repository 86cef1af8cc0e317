"""Timing of the Droplets' infrared: messages, and exchanges in which one emits and the others measure.

An exchange: the emitter calls, waits, and lights its six emitters one after the other; who has heard the call
measures in the middle of each flash and prints the matrix a little later. Times are those of the firmware of
2018 (correlllab/cu-droplet).
"""

from __future__ import annotations

from swarm_loc_drivers.droplet.hardware import ELEMENTS

_MS = 1_000_000
_BYTE_NS = 2_500_000
"""As a comment in the firmware has it; ten bits at 3200 baud would be 3.1 ms."""
_HEADER = 7
"""Sender, checksum, length and flags, target."""
MAX_MESSAGE = 40
"""Bytes; who hears of more takes nothing."""

HANDLING_NS = 5 * _MS
"""From the last byte of a command until it is obeyed."""
SET_POWER_DELAY_NS = 10 * _MS
"""From the command to change the power until it has changed."""
EMIT_DELAY_NS = 5 * _MS
"""From the command to emit until the call."""
CALL_NS = (_HEADER + 1) * _BYTE_NS
LEAD_NS = 32 * _MS
"""From the begin of the call to the first flash."""
FLASH_NS, GAP_NS = 16 * _MS, 10 * _MS
EXCHANGE_NS = LEAD_NS + ELEMENTS * (FLASH_NS + GAP_NS)
"""From the begin of the call until all robots listen again."""
PRINT_DELAY_NS = 10 * _MS
"""From the end of the exchange until the matrix is printed."""


def message_ns(length: int) -> int:
    """How long a message of so many bytes lasts [ns]."""
    return (_HEADER + length) * _BYTE_NS


def flash_ns(emitter: int) -> int:
    """The middle of an emitter's flash, counted from the begin of the call [ns]."""
    return LEAD_NS + emitter * (FLASH_NS + GAP_NS) + FLASH_NS // 2


MIDDLE_NS = (flash_ns(0) + flash_ns(ELEMENTS - 1)) // 2
"""The middle of the measurements, counted from the begin of the call."""
PRINTED_AFTER_NS = EXCHANGE_NS + PRINT_DELAY_NS - MIDDLE_NS
"""From the middle of the measurements until the matrix is printed."""
EMITTED_AFTER_NS = EMIT_DELAY_NS + EXCHANGE_NS + PRINT_DELAY_NS
"""From the command to emit until the matrix is printed."""
