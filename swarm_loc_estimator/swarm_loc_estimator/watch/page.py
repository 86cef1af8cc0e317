"""The page as one text, its initial data, its binary messages, and a recorded run inside it.

A frame, the binary message to the page, is a kind, an instant and columns of numbers:

    uint32 length of the header | header as JSON, blanks up to a multiple of 8 | columns, each padded as well

The header names kind and stamp [ms] and lists the columns as name, type and length; all is little-endian.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import struct
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.poses import EstimateMessage
from swarm_loc_estimator.mapping.messages import GridMessage
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.sightings import Sightings

_TYPES = {"float64": "f8", "float32": "f4", "int32": "i4", "uint8": "u1", "int8": "i1"}
_ALIGNMENT = 8
SPAN_NS = 180_000_000_000
MAX_BYTES = 24_000_000
_SPACING_NS = {"poses": 200_000_000, "truth": 200_000_000, "map": 5_000_000_000}
_ELSE_NS = 500_000_000


class Frame(NamedTuple):
    """A binary message to the page."""

    kind: str  # Its content: "poses", "sightings", "truth", "aerial", "goals" or "map"
    stamp_ns: int  # Time of the content [ns]
    data: bytes  # The bytes for the page


def pack(kind: str, stamp_ns: int, columns: Mapping[str, npt.NDArray[Any]], **extra: object) -> Frame:
    """A frame of columns by name (see `_TYPES`), each flattened; `extra` are other entries of its header."""
    flat = {name: np.ascontiguousarray(column).reshape(-1) for name, column in columns.items()}
    listed = [[name, _TYPES[str(column.dtype)], column.size] for name, column in flat.items()]
    header = json.dumps({"kind": kind, "stamp": stamp_ns * 1e-6, "columns": listed, **extra}).encode()
    header += b" " * (-(4 + len(header)) % _ALIGNMENT)
    parts = [struct.pack("<I", len(header)), header]
    for column in flat.values():
        data = column.tobytes()
        parts += [data, bytes(-len(data) % _ALIGNMENT)]
    return Frame(kind, stamp_ns, b"".join(parts))


def poses_frame(estimate: EstimateMessage) -> Frame:
    """Estimated poses of all robots; those of unlocated robots are NaN."""
    places: dict[str, npt.NDArray[Any]] = {"x": estimate.pose[:, 0], "y": estimate.pose[:, 1]}
    single = {"theta": estimate.pose[:, 2]}
    for name, i, j in (("sxx", 0, 0), ("sxy", 0, 1), ("syy", 1, 1), ("stt", 2, 2)):
        single[name] = estimate.covariance[:, i, j]
    single["age"] = estimate.fix_age_s
    columns = {name: column.astype(np.float32) for name, column in single.items()}
    states = {"status": estimate.status, "known": estimate.heading_known.astype(np.uint8)}
    return pack("poses", estimate.stamp_ns, {**places, **columns, **states})


def sightings_frame(stamp_ns: int, sightings: Sightings) -> Frame:
    """The robots' measurements and their outcomes."""
    return pack("sightings", stamp_ns, sightings._asdict())


def places_frame(kind: str, stamp_ns: int, robot: Sequence[int], pose: FloatArray) -> Frame:
    """Poses (n, 3) in map of robots: ground truth or goals."""
    columns: dict[str, npt.NDArray[Any]] = {
        "robot": np.array(robot, dtype=np.int32),
        "x": pose[:, 0],
        "y": pose[:, 1],
        "theta": pose[:, 2].astype(np.float32),
    }
    return pack(kind, stamp_ns, columns)


def aerial_frame(stamp_ns: int, position: FloatArray, robot: IntArray, probability: FloatArray) -> Frame:
    """Detections in an aerial image: positions (n, 2) [m], robots by index or -1, and probabilities (n,)."""
    columns: dict[str, npt.NDArray[Any]] = {
        "robot": robot.astype(np.int32),
        "x": position[:, 0],
        "y": position[:, 1],
        "probability": probability.astype(np.float32),
    }
    return pack("aerial", stamp_ns, columns)


def map_frame(stamp_ns: int, grid: GridMessage) -> Frame:
    """The map at an instant."""
    height, width = grid.cells.shape
    shape = {"width": width, "height": height, "resolution": grid.resolution, "origin": grid.origin}
    return pack("map", stamp_ns, {"cells": grid.cells}, **shape)


class History:
    """A ring of frames of at most `span_ns` and `max_bytes`; the oldest are dropped first."""

    def __init__(self, span_ns: int = SPAN_NS, max_bytes: int = MAX_BYTES) -> None:
        self._span_ns = span_ns
        self._max_bytes = max_bytes
        self._frames: deque[Frame] = deque()
        self._bytes = 0
        self._newest_of: dict[str, Frame] = {}
        self._kept_ns: dict[str, int] = {}

    def add(self, frame: Frame) -> bool:
        """Add a frame; returns whether the clock has jumped back, at which the history is cleared."""
        before = self._newest_of.get(frame.kind)
        jumped = before is not None and frame.kind == "poses" and frame.stamp_ns < before.stamp_ns
        if jumped:
            self.clear()
        self._newest_of[frame.kind] = frame
        spacing_ns = _SPACING_NS.get(frame.kind, _ELSE_NS)
        if frame.stamp_ns < self._kept_ns.get(frame.kind, -spacing_ns) + spacing_ns:
            return jumped
        self._kept_ns[frame.kind] = frame.stamp_ns
        self._frames.append(frame)
        self._bytes += len(frame.data)
        first_ns = frame.stamp_ns - self._span_ns
        while self._frames and (self._bytes > self._max_bytes or self._frames[0].stamp_ns < first_ns):
            self._bytes -= len(self._frames.popleft().data)
        return jumped

    def clear(self) -> None:
        """Clear the history."""
        self._frames.clear()
        self._newest_of.clear()
        self._kept_ns.clear()
        self._bytes = 0

    def frames(self) -> list[Frame]:
        """All stored frames, and the newest of each kind, in the order of arrival."""
        kept = list(self._frames)
        known = set(map(id, kept))
        return kept + [frame for frame in self._newest_of.values() if id(frame) not in known]

    @property
    def size(self) -> int:
        """Bytes held in the ring."""
        return self._bytes


_FOLDER = Path(__file__).parent / "page"
_SCRIPTS = ("frames", "store", "view", "ground", "trails", "paint", "link", "panel", "actions", "main")
_BODY_PER_WHEELS = 0.66  # Ratio of body radius to wheel separation, as of an e-puck


@lru_cache(maxsize=1)
def _parts() -> tuple[str, str, str]:
    read = {path.name: path.read_text(encoding="utf-8") for path in _FOLDER.iterdir() if path.is_file()}
    own = "\n".join(read[f"{name}.js"] for name in _SCRIPTS)
    script = f'{read["uPlot.iife.min.js"]}\n(() => {{\n"use strict";\n{own}\n}})();\n'
    return read["page.html"], read["uPlot.min.css"] + read["page.css"], script


def page(data: str = "") -> str:
    """The page, with a recorded run to play (see `recording`); "": it asks its server for a live one."""
    markup, style, script = _parts()
    body, end = markup.split("<!-- data -->")
    recorded = f'<script type="application/octet-stream" id="recording">{data}</script>' if data else ""
    return f"{body.replace('/* style */', style)}{recorded}<script>{script}</script>{end}"


def content_security_policy() -> str:
    """Content security policy: the page may only run this script and connect to its server."""
    digest = base64.b64encode(hashlib.sha256(_parts()[2].encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:;"
        " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def recording(about: dict[str, Any], frames: Iterable[Frame]) -> str:
    """The text: base64 of gzip of the length of a JSON text (`about`), that text, and frames by stamp."""
    head = json.dumps(about).encode()
    head += b" " * (-(4 + len(head)) % _ALIGNMENT)
    whole = b"".join([struct.pack("<I", len(head)), head, *(frame.data for frame in frames)])
    return base64.b64encode(gzip.compress(whole, compresslevel=6, mtime=0)).decode("ascii")


def about(swarm: Swarm, title: str, *, teleop: bool = False, commands: bool = True) -> dict[str, Any]:
    """Description of the swarm for the page, and what its users may do."""
    landmarks: list[list[Any]] = [[mark.id, mark.x, mark.y, mark.yaw] for mark in swarm.landmarks]
    landmarks += [[camera.name, camera.x, camera.y, None] for camera in swarm.cameras]
    return {
        "kind": "about",
        "title": title,
        "names": [robot.name for robot in swarm.robots],
        "radius": [round(_BODY_PER_WHEELS * one.odometry.wheel_separation, 4) for one in swarm.robots],
        "infrared": [int(robot.ir is not None and robot.camera is None) for robot in swarm.robots],
        "landmarks": landmarks,
        "teleop": teleop,
        "commands": commands,
    }
