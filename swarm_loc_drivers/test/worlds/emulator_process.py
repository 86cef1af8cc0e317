"""Emulated robots as a process, which says how they are for every line of its input."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


def asked() -> bytes | None:
    """In the process, what was asked; None: nothing, b"": the input has ended."""
    try:
        return os.read(sys.stdin.fileno(), 100)
    except BlockingIOError:
        return None


class EmulatorProcess:
    """The process from outside.

    Args:
        script: In this folder; prints where the robots answer, then what they are asked for as JSON.
        arguments: Of the script.

    Attributes:
        place: Where the robots answer.
    """

    def __init__(self, script: str, *arguments: str) -> None:
        path = os.pathsep.join(
            [str(HERE.parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
        )  # for `bench`
        self._process = subprocess.Popen(
            [sys.executable, str(HERE / script), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": path},
        )
        self.place = self._line()

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def truth(self) -> Any:
        """How the robots are."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return json.loads(self._line())

    def kill(self) -> None:
        """Take the batteries out."""
        with self._process:
            self._process.kill()
