"""PushBots: maps made by one robot and by many.

    make bench-pushbot
    make bench-pushbot ARGS="--seeds 3 --team-seeds 1"

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

import sys
from collections.abc import Sequence

from bench.pushbot.mapping import MappingEffort, measure_mapping
from bench.shared.common import options_of, write_figures


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = options_of(
        __doc__,
        arguments,
        seeds=(20, "of each of three halls with one robot"),
        team_seeds=(6, "of teams, and other halls"),
        minutes=(20.0, "of one robot; teams get half"),
        processes=(2, "at a time, 2 at most"),
    )
    effort = MappingEffort(options.seeds, options.team_seeds, options.minutes, options.processes)
    print(f"figures: {write_figures('pushbot', measure_mapping(effort))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
