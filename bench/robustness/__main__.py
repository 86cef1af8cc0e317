"""Robustness: corrupted bytes, wrong stamps, full disks, signals at any time, too much load, clocks.

`protocols` runs drivers in simulated time, with robots whose bytes are lost, doubled, swapped, flipped or
inserted (.01 to 10 %), shuffled, flooded or replaced for some seconds. A thread is dead when it ends or never
connects again. "False connected" is the longest time in which a robot is connected although none of its
answers makes sense.

`stamps` runs five simulated e-pucks with stamps that jitter by 5 to 90 % of the period, or are early, late or
repeated now and then.

`files` runs each command that writes files where the disk fills up, is full or is read-only, and where links,
folders and files are in the way; `kills` interrupts and kills commands at random instants. Both count faults.

`load` runs fifty robots at three times the load that fits, over DDS and in real time, see `load.py`.

`restart` kills drivers of PushBots that map a hall, see `restarts.py` and `live_restarts.py`.

`time` lets clocks jump, stops processes for a while and loops a bag, see `clocks.py`.
"""

from __future__ import annotations

from collections.abc import Callable

from bench.robustness import clocks, files, kills, live_restarts, load, protocols, restarts, stamps
from bench.shared.common import ProgressLine, options_of, table, write_figures

_PARTS = ("stamps", "restart", "protocols", "files", "kills", "load", "time")


def main() -> None:
    """Measure, print the table, write the figures."""
    arguments = options_of(
        __doc__,
        streams=(10_000, "corrupted streams of each protocol"),
        seeds=(5, "runs with wrong stamps of each kind"),
        cuts=(20, "full disks of each command"),
        kills=(10, "signals of each kind to each command"),
        minutes=(10.0, "at three times the load that fits"),
        image_rate=(0.0, "load instead of three times that [Hz]"),
        restart_seeds=(20, "of each hall in which drivers restart"),
        live_restarts=(20, "in a whole graph of each hall"),
        loops=(20, "of a bag"),
        parts=(_PARTS, "what to measure", _PARTS),
    )
    figures: dict[str, float] = {}

    def note(of_part: dict[str, float]) -> None:
        """Print and store figures at once: a part may take an hour."""
        figures.update(of_part)
        print("\n" + table(("figure", "value"), list(of_part.items())), flush=True)
        print(write_figures("robustness", figures), flush=True)

    def measure_restarts(say: ProgressLine) -> dict[str, float]:
        """Offline first, then those of whole graphs."""
        note(restarts.measure(arguments.restart_seeds, say))
        return live_restarts.measure(arguments.live_restarts, say)

    measures: dict[str, Callable[[ProgressLine], dict[str, float]]] = {
        "stamps": lambda say: stamps.measure(arguments.seeds, say),
        "restart": measure_restarts,
        "protocols": lambda say: protocols.measure(arguments.streams, say, note),
        "files": lambda say: files.measure(arguments.cuts, say),
        "kills": lambda say: kills.measure(arguments.kills, say),
        "load": lambda say: load.measure(arguments.minutes, say, arguments.image_rate),
        "time": lambda say: clocks.measure(arguments.loops, say),
    }
    for part in _PARTS:
        if part in arguments.parts:
            note(measures[part](ProgressLine(part)))


if __name__ == "__main__":
    main()
