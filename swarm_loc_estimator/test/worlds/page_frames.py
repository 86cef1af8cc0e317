"""Reads frames as the page does."""

import json
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.watch.page import _ALIGNMENT


def unpack(data: bytes) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """Header and columns of a frame's bytes, as the page reads them."""
    size = struct.unpack_from("<I", data)[0]
    header: dict[str, Any] = json.loads(data[4 : 4 + size])
    at, columns = 4 + size, {}
    for name, kind, length in header["columns"]:
        columns[name] = np.frombuffer(data, f"<{kind}", length, at)
        at += -(-columns[name].nbytes // _ALIGNMENT) * _ALIGNMENT
    return header, columns
