"""Executables of all packages end by a signal without a traceback while they still import."""

import os
import signal
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path

import pytest

from swarm_loc_estimator.common.launch import executable_path
from workspace.layout import PACKAGES, ROOT

HELD = """
import os, sys
from importlib.abc import MetaPathFinder

class Held(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        package, _, module = name.partition(".")
        if package.startswith("swarm_loc_") and module.partition(".")[0] not in ("", "start", "common"):
            os.write(1, b"imports")
            os.read(0, 1)

sys.meta_path.insert(0, Held())
"""
"""Run by Python at its start: an import of the program proper waits for standard input."""


def _executables() -> list[tuple[str, str]]:
    found = []
    for package in PACKAGES:
        config = ConfigParser()
        config.read(ROOT / package / "setup.cfg", encoding="utf-8")
        lines = config.get("options.entry_points", "console_scripts", fallback="").split("\n")
        found += [(package, line.partition("=")[0].strip()) for line in lines if line]
    return found


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("package", "name"), _executables())
def test_a_signal_during_the_imports_ends_an_executable_with_a_sentence(
    tmp_path: Path, package: str, name: str, number: signal.Signals
) -> None:
    (tmp_path / "sitecustomize.py").write_text(HELD, encoding="utf-8")
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        [sys.executable, str(executable_path(package, name)), "--help"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": path},
    ) as process:
        assert process.stdout is not None
        assert process.stdout.read(7) == b"imports"
        process.send_signal(number)
        output, errors = process.communicate(timeout=60)
    said = f"Stopped by {number.name}.\n".encode()
    assert (process.returncode, output, errors) == (128 + number, b"", said)
