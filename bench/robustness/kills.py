"""Commands that are interrupted or killed at random instants, also while they compile.

SIGINT goes to all processes of the terminal, as Ctrl-C does; SIGKILL to the command alone. Afterwards all of
its processes must end, and nothing may be left but whole outputs.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.robustness.commands import BAGS, COMMANDS, READY, Command
from bench.robustness.files import Place, figures, is_whole, place
from bench.shared.common import ProgressLine

_LATE_S, _PATIENCE_S = 3.0, 10.0
_INTERRUPTED = 128 + signal.SIGINT
_SHARED = Path("/dev/shm")  # noqa: S108 # where joblib and semaphores have files
_MARK = "SWARM_LOC_BENCH_MARK"
_POLL_S = 0.02
KINDS = ("tried", "tracebacks", "wrong_status", "unsaid", "late", "orphans", "cut_files", "left")


class Case(NamedTuple):
    """What is killed."""

    name: str
    command: Command
    seconds: float | None = None  # It is killed within so many seconds; None: until it ends by itself
    compiles: bool = False  # Whether nothing is compiled at its start
    statuses: tuple[int, ...] = (_INTERRUPTED,)  # After SIGINT


_NAMED = {command.name: command for command in COMMANDS}
_SIMULATE = Command("swarm_loc_drivers simulate", f"{BAGS}/pushbot_one/swarm.yaml", "")
CASES = (
    *(
        Case(name, _NAMED[name])
        for name in ("survey", "sweep", "replay_map", "calibrate", "replay", "detect")
    ),
    Case("generate_bag", _NAMED["generate_bag_pictures"]),
    Case("import_droplets", _NAMED["import_droplets"]),
    Case("compiling", _NAMED["sweep"], 20.0, compiles=True),
    Case("simulate", _SIMULATE, 12.0, statuses=(0, _INTERRUPTED)),
)


class Killed(NamedTuple):
    """What came of a command that got a signal."""

    pid: int
    status: int | None  # None: it had to be killed
    said: str  # On standard error
    after_s: float  # From the signal until all its processes have ended, 10 s at most
    orphans: tuple[str, ...]  # Command lines of its processes that live then


def kill(line: list[str], place: Place, number: signal.Signals, at_s: float, env: dict[str, str]) -> Killed:
    """Start a command, signal it so long after its entry point has begun, and look after what is left."""
    ready, mark = place.root / "ready", f"{os.getpid()}-{time.monotonic_ns()}"
    ready.unlink(missing_ok=True)
    env = {
        **os.environ,
        "TMPDIR": str(place.scratch),
        "OMP_NUM_THREADS": "1",
        **env,
        _MARK: mark,
        READY: str(ready),
    }
    with (place.root / "said").open("w+", encoding="utf-8", errors="replace") as said:
        process = subprocess.Popen(
            line, env=env, cwd=place.scratch, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True
        )
        while not ready.exists():
            time.sleep(_POLL_S)
        try:
            process.wait(at_s)
        except subprocess.TimeoutExpired:
            (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
        began_s = time.monotonic()
        while (living := _living(mark)) and time.monotonic() < began_s + _PATIENCE_S:
            process.poll()
            time.sleep(_POLL_S)
        after_s = time.monotonic() - began_s
        status = process.poll() if living else process.wait()
        for pid in living:
            os.kill(pid, signal.SIGKILL)
        process.wait()
        said.seek(0)
        return Killed(process.pid, status, said.read(), after_s, tuple(living.values()))


def _living(mark: str) -> dict[int, str]:
    """Processes with the mark in their environment, and their command lines."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (folder / "environ").read_bytes():
                found[int(folder.name)] = (
                    (folder / "cmdline").read_text(errors="replace").replace("\0", " ")[-150:]
                )
        except OSError:
            continue  # it has ended meanwhile
    return found


class Kills:
    """Trials of one case, whose faults are counted and kept as sentences."""

    def __init__(self, case: Case, place: Place, seed: int) -> None:
        self.counts: Counter[str] = Counter(dict.fromkeys(KINDS, 0))
        self.faults: list[str] = []
        self._case, self._place = case, place
        self._rng = np.random.default_rng([seed, [one.name for one in CASES].index(case.name)])
        self._seconds, self._whole = case.seconds or 0.0, dict[str, bytes]()
        if case.seconds is None:
            place.clear()
            began_s = time.monotonic()
            if (ended := kill(self._line(), place, signal.SIGKILL, 600.0, {})).status != 0:
                raise RuntimeError(f"{case.name} fails: {ended.said}")
            self._seconds, self._whole = time.monotonic() - began_s, place.files()

    def _line(self) -> list[str]:
        return self._case.command.line(self._place.given, self._place.out)

    def signalled(self, number: signal.Signals) -> None:
        """Send a signal at a random instant."""
        self._place.clear()
        at_s = float(self._rng.uniform(0.0, self._seconds))
        cache = self._place.root / "cache"
        env = {"_SWARM_LOC_PRIVATE_CACHE": str(cache)} if self._case.compiles else {}
        done = kill(self._line(), self._place, number, at_s, env)
        shutil.rmtree(cache, ignore_errors=True)
        self.counts["tried"] += 1
        trial = f"{number.name} after {at_s:.2f} s"
        # what it did
        if "Traceback" in done.said:
            self._count("tracebacks", trial, done.said)
        if number == signal.SIGINT and done.status != 0:
            if done.after_s > _LATE_S:
                self._count("late", trial, f"{done.after_s:.1f} s, {done.said}")
            if done.status not in self._case.statuses:
                self._count("wrong_status", trial, f"{done.status} {done.said}")
            elif not done.said.strip():
                self._count("unsaid", trial, "")
        # what is left
        for orphan in done.orphans:
            self._count("orphans", trial, orphan)
        for name, data in self._place.files().items():
            if not is_whole(name, data, self._whole):
                self._count("cut_files", trial, name)
        hidden = [path for path in self._place.out.rglob("*") if path.name.startswith(".")]
        for path in (*self._place.scratch.iterdir(), *hidden, *_SHARED.glob(f"*[-_]{done.pid}[-_]*")):
            self._count("left", trial, str(path))

    def _count(self, kind: str, trial: str, said: str) -> None:
        self.counts[kind] += 1
        self.faults.append(f"{self._case.name}, {trial}: {kind}: {said[-1500:]}")


def measure(kills: int, say: ProgressLine, names: tuple[str, ...] = (), seed: int = 1) -> dict[str, float]:
    """Figures of so many signals of each kind to each case, or to those of these names."""
    total: Counter[str] = Counter(dict.fromkeys(KINDS, 0))
    with place() as here:
        for case in CASES:
            if names and case.name not in names:
                continue
            trials = Kills(case, here, seed)
            for number in [signal.SIGINT, signal.SIGKILL] * kills:
                say(f"{case.name}, {number.name}")
                trials.signalled(number)
            total.update(trials.counts)
            for fault in trials.faults:
                print(fault)
    return figures("kills", total)
