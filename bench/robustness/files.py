"""Outputs where the disk is full, the folder is read-only, or something is in the way.

Each command runs in a disk that fills up after it has looked for room, cut at points spread over the largest
of its files, in one without room, in a folder that it must not write, and where links, folders and files are
in the way of its outputs.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from bench.robustness.commands import COMMANDS, Command, Ended, give_inputs, run
from bench.shared.common import ProgressLine
from swarm_loc_estimator.common.arrays import IntArray

_UNPRIVILEGED = ("setpriv", "--bounding-set=-dac_override")  # else root writes anywhere
_END = 12  # bytes, of PNG
_LOG = "jobs.jsonl"  # Grows by whole lines, which the next run continues
_OF_OTHERS = b"of others"
KINDS = ("tried", "tracebacks", "succeeded", "cut_files", "unnamed", "written_through")


class Place:
    """An empty folder for outputs, one for temporary files, and the inputs."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.given, self.out, self.scratch = (root / name for name in ("given", "out", "scratch"))
        self.given.mkdir()
        give_inputs(self.given)

    def clear(self) -> None:
        """Empty the folders."""
        for folder in (self.out, self.scratch):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(mode=0o777)
            folder.chmod(0o777)

    def files(self) -> dict[str, bytes]:
        """Contents of all files of the outputs by their paths, links as what they point to."""
        return {
            str(path.relative_to(self.out)): path.read_bytes()
            for path in sorted(self.out.rglob("*"))
            if path.is_file() and not path.is_symlink()
        }


@contextmanager
def place() -> Iterator[Place]:
    """A place that is removed at the end; everybody may use it, and it lies at no link."""
    with tempfile.TemporaryDirectory(prefix="files_") as root:
        Path(root).chmod(0o755)
        yield Place(Path(root).resolve())


class Trials:
    """Trials of one command, whose faults are counted and kept as sentences."""

    def __init__(self, command: Command, place: Place) -> None:
        self.counts: Counter[str] = Counter(dict.fromkeys(KINDS, 0))
        self.faults: list[str] = []
        self._command, self._place = command, place
        place.clear()
        done = run(command.line(place.given, place.out), place.scratch)
        if done.status != 0:
            raise RuntimeError(f"{command.name} fails: {done.said}")
        self._whole = place.files()

    def full_at(self, counts: IntArray) -> None:
        """A disk that fills up: no file may grow beyond so many bytes."""
        for count in counts.tolist():
            self._place.clear()
            done = run(self._command.line(self._place.given, self._place.out, count), self._place.scratch)
            self._judge(f"full after {count}", done)

    def spread(self, number: int) -> IntArray:
        """So many sizes between nothing and the largest output."""
        return np.linspace(0, max(map(len, self._whole.values())), number, endpoint=False).astype(np.int64)

    def in_the_way(self) -> None:
        """Things in the way of its outputs, and a folder that may not be written."""
        out, name, folder = self._place.out, self._command.file, self._command.folder
        target = self._place.scratch / "target"
        for what in ("link", "dangling link", "folder") if name else ():
            self._place.clear()
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            if what == "folder":
                (out / name).mkdir()
            else:
                (out / name).symlink_to(target)
            if what == "link":
                target.write_bytes(_OF_OTHERS)
            self._judge(f"{what} at {name}", self._run(), target)
        for what in ("link", "dangling link", "file"):
            self._place.clear()
            at = out / folder if folder else out
            if not folder:
                out.rmdir()
            if what == "file":
                at.write_bytes(_OF_OTHERS)
            else:
                at.symlink_to(target, target_is_directory=True)
            if what == "link":
                target.mkdir()
            if folder or what != "link":  # all outputs together may lie on another disk
                self._judge(f"{what} at the folder", self._run(), target)
            if at.is_symlink() or at.is_file():
                at.unlink()
        self._place.clear()
        out.chmod(0o555)
        self._judge("read-only", self._run(_UNPRIVILEGED if os.getuid() == 0 else ()))

    def _run(self, before: Sequence[str] = ()) -> Ended:
        return run([*before, *self._command.line(self._place.given, self._place.out)], self._place.scratch)

    def _judge(self, trial: str, done: Ended, target: Path | None = None) -> None:
        self.counts["tried"] += 1
        said = done.said.strip()
        if "Traceback" in said:
            self._count("tracebacks", trial, said)
        if done.status == 0:
            self._count("succeeded", trial, "")
        elif not any(str(folder) in said for folder in (self._place.out, self._place.scratch)):
            self._count("unnamed", trial, said)
        left = self._place.files() if self._place.out.is_dir() and not self._place.out.is_symlink() else {}
        for name, data in left.items():
            if not is_whole(name, data, self._whole):
                self._count("cut_files", trial, name)
        left = {name: data for name, data in left.items() if data != _OF_OTHERS}
        if self._command.folder and left and left.keys() != self._whole.keys():
            self._count("cut_files", trial, f"only {', '.join(left)}")
        if target is not None:
            kept = (
                target.read_bytes() == _OF_OTHERS
                if target.is_file()
                else not target.is_dir() or not any(target.iterdir())
            )
            if not kept:
                self._count("written_through", trial, str(target))

    def _count(self, kind: str, trial: str, said: str) -> None:
        self.counts[kind] += 1
        self.faults.append(f"{self._command.name}, {trial}: {kind}: {said[-300:]}")


def is_whole(name: str, data: bytes, whole: Mapping[str, bytes]) -> bool:
    """Whether a file ends as it should; some say how long the command took, and to compile."""
    end = b"\n" if name == _LOG or name.endswith(".csv") else whole.get(name, b"none")[-_END:]
    return data.endswith(end) or data == _OF_OTHERS or (name == _LOG and not data)


def measure(cuts: int, say: ProgressLine, names: tuple[str, ...] = ()) -> dict[str, float]:
    """Figures of all commands, or of those of these names, at so many full disks each."""
    total: Counter[str] = Counter(dict.fromkeys(KINDS, 0))
    with place() as here:
        for command in COMMANDS:
            if names and command.name not in names:
                continue
            say(command.name)
            trials = Trials(command, here)
            trials.full_at(trials.spread(cuts))
            trials.in_the_way()
            total.update(trials.counts)
            for fault in trials.faults:
                print(fault)
    return figures("files", total)


def figures(part: str, counts: Mapping[str, int]) -> dict[str, float]:
    """Counts as figures of a part."""
    return {f"{part}.{kind}": float(count) for kind, count in counts.items()}
