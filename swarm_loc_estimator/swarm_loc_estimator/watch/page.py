"""The page as one text, its initial data, and a recorded run inside it."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import struct
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.watch.frames import Frame

_FOLDER = Path(__file__).parent / "page"
_SCRIPTS = (
    "frames.js",
    "store.js",
    "view.js",
    "ground.js",
    "trails.js",
    "paint.js",
    "link.js",
    "panel.js",
    "actions.js",
)
_ALIGNMENT = 8
_BODY_PER_WHEELS = 0.66  # Ratio of body radius to wheel separation, as of an e-puck


@lru_cache(maxsize=1)
def _parts() -> tuple[str, str, str]:
    """Markup, style and script."""
    read = {path.name: path.read_text(encoding="utf-8") for path in _FOLDER.iterdir() if path.is_file()}
    own = "\n".join(read[name] for name in (*_SCRIPTS, "main.js"))
    script = f'{read["uPlot.iife.min.js"]}\n(() => {{\n"use strict";\n{own}\n}})();\n'
    return read["page.html"], read["uPlot.min.css"] + read["page.css"], script


def page(data: str = "") -> str:
    """The page.

    Args:
        data: A recorded run (see `recording`) to play; "": the page asks its server for a live one.
    """
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
    """The text: base64 of gzip of the length of a JSON text, that text, and the frames.

    Args:
        about: Initial data of the page, see `about`.
        frames: In the order of their stamps.
    """
    head = json.dumps(about).encode()
    head += b" " * (-(4 + len(head)) % _ALIGNMENT)
    whole = b"".join([struct.pack("<I", len(head)), head, *(frame.data for frame in frames)])
    return base64.b64encode(gzip.compress(whole, compresslevel=6, mtime=0)).decode("ascii")


def about(swarm: Swarm, title: str, *, teleop: bool = False, commands: bool = True) -> dict[str, Any]:
    """Description of the swarm for the page.

    Args:
        swarm: Its description.
        title: Heading of the page.
        teleop: Whether robots may be driven.
        commands: Whether poses may be set and the estimator reset.
    """
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
