"""A run inside a page: what is told first and all frames, packed as text."""

from __future__ import annotations

import base64
import gzip
import json
import struct
from collections.abc import Iterable
from typing import Any

from swarm_loc_estimator.watch.frames import Frame

_ALIGNMENT = 8


def recording(about: dict[str, Any], frames: Iterable[Frame]) -> str:
    """The text: base64 of gzip of the length of a JSON text, that text, and the frames.

    Args:
        about: What the page is told first, see `about.py`.
        frames: In the order of their stamps.
    """
    head = json.dumps(about).encode()
    head += b" " * (-(4 + len(head)) % _ALIGNMENT)
    whole = b"".join([struct.pack("<I", len(head)), head, *(frame.data for frame in frames)])
    return base64.b64encode(gzip.compress(whole, compresslevel=6, mtime=0)).decode("ascii")
