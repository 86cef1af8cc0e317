"""PushBots: event tracker, laser calibration, driver, and maps made by one robot and by many.

    make bench-pushbot
    make bench-pushbot ARGS="--parts mapping --seeds 3 --team-seeds 1"

Maps are made of simulated distances by the core that the mapper node runs: turns of 1 rad/s, drives of
.2 m/s, distance noise 1.5 %, .64 deg a turn, .3 deg a root metre, slip 0, 2 and 5 % in turn, .1 px (px3:
.3 px), 1 % dropouts, .3 % outliers, range 2.5 m. Errors are those of poses in the frame of the first robot's
start; "aligned" after one rigid fit. Diverged is a run with any pose off by more than 30 cm after the last
solution, "online" one with such a pose when it was published. bend,
atrium and tee are halls that nothing was developed in. In open12 and corridor25 poses are compared with their
covariances, too: misleading is the share off by more than 5 sigma and 2 cm, diverged_unreported counts
runs in which one was off by more than 30 cm and 3 sigma. "lidar" is a robot like a TurtleBot 3, see
lidar.py, for at most five minutes: its wheels lose 2, 3.5 and 5 % of every path and turn; all its sweeps in
the graph are compared, and sweep_ms is the CPU time of a sweep, of those that are not used, too.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from bench.shared.common import write_figures

PARTS = ("tracker", "calibration", "driver", "mapping")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = _parser().parse_args(arguments)
    figures: dict[str, float] = {}
    for part in options.parts:
        figures |= _measure(part, options)
    print(f"figures: {write_figures('pushbot', figures)}")
    return 0


def _measure(part: str, options: argparse.Namespace) -> dict[str, float]:
    """The figures of one part; each imports what it alone needs."""
    if part == "tracker":
        from bench.pushbot.tracker import measure_tracker  # noqa: PLC0415

        return measure_tracker(options.tracker_seeds)
    if part == "calibration":
        from bench.pushbot.calibration import measure_calibration  # noqa: PLC0415

        return measure_calibration(options.tracker_seeds)
    if part == "driver":
        from bench.pushbot.driver import measure_driver  # noqa: PLC0415

        return measure_driver(options.tracker_seeds)
    from bench.pushbot.mapping import MappingEffort, measure_mapping  # noqa: PLC0415

    return measure_mapping(
        MappingEffort(options.seeds, options.team_seeds, options.minutes, options.processes)
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="what to measure")
    parser.add_argument("--tracker-seeds", type=int, default=5, help="of tracker, calibration and driver")
    parser.add_argument("--seeds", type=int, default=20, help="of each of three halls with one robot")
    parser.add_argument("--team-seeds", type=int, default=6, help="of teams, and other halls")
    parser.add_argument("--minutes", type=float, default=20.0, help="of one robot; teams get half")
    parser.add_argument("--processes", type=int, default=2, help="at a time, 2 at most")
    return parser


if __name__ == "__main__":
    sys.exit(main())
