"""Cooperative localization of a robot swarm; this module is its public Python API, see doc/python_api.md.

Its names are those of `__init__.pyi`, which type checkers read. They are loaded when they are first used:
importing one of them loads only the modules that it needs.
"""

import os
import re
from importlib import import_module
from pathlib import Path
from typing import Any

# The matrices are too small to share: where other programs run, BLAS threads wait for each other a hundred
# times longer than they compute. Must be set before numpy loads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_IMPORT = re.compile(r"^from (\S+) import (\w+) as \2$", re.MULTILINE)
_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_MODULE_OF = {name: module for module, name in _IMPORT.findall(_STUB)}


def __getattr__(name: str) -> Any:
    """Load a name of the API, see PEP 562."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The names of the API."""
    return sorted({*_MODULE_OF, *globals()})
