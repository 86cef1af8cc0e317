"""Compile the parser before the first bytes come."""

from __future__ import annotations

from collections import Counter

from swarm_loc_drivers.pushbot.event_bytes import EventParser
from swarm_loc_estimator.common.jit import note_precompiled


def precompile() -> None:
    """Parse an event and a line."""
    EventParser("16bit", Counter()).feed(b"\xe4\xa5\xe2\x40-S28 1 2\n")
    note_precompiled(precompile)
