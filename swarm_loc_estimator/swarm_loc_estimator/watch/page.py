"""The page as one text: markup, style and scripts in one, for the server and for a report alike."""

from __future__ import annotations

import base64
import hashlib
from functools import lru_cache
from pathlib import Path

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
        data: A recorded run (see `recording.py`) to play; "": the page asks its server for a live one.
    """
    markup, style, script = _parts()
    body, end = markup.split("<!-- data -->")
    told = f'<script type="application/octet-stream" id="recording">{data}</script>' if data else ""
    return f"{body.replace('/* style */', style)}{told}<script>{script}</script>{end}"


def content_security_policy() -> str:
    """What the page may do: run this script, connect to its server, and nothing else."""
    digest = base64.b64encode(hashlib.sha256(_parts()[2].encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:;"
        " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
