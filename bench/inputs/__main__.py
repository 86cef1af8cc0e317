"""Inputs: how well each kind of sensor locates a swarm, compared with bounds and other software.

A part is a module with a function `measure(seeds, say)`, which returns figures by name and draws plots.

    make bench-inputs
    make bench-inputs ARGS="--parts uwb mocap --seeds 2"
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence

from bench.inputs import apriltag_msgs, families, imu, lidar_map, mocap, no_map, overhead, uwb
from bench.shared.common import ProgressLine, table, write_figures

PARTS: Mapping[str, Callable[[Sequence[int], ProgressLine], Mapping[str, float]]] = {
    "overhead": overhead.measure,
    "mocap": mocap.measure,
    "uwb": uwb.measure,
    "apriltag_msgs": apriltag_msgs.measure,
    "families": families.measure,
    "imu": imu.measure,
    "no_map": no_map.measure,
    "lidar_map": lidar_map.measure,
}
"""Part -> its function. Figures start with the name of the part, or twist_only (imu) or merge (no_map)."""


def main() -> None:
    """Run the parts, print the table, write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5, help="runs of each part")
    parser.add_argument("--parts", nargs="+", choices=[*PARTS], default=[*PARTS])
    arguments = parser.parse_args()
    seeds = range(1, arguments.seeds + 1)
    figures: dict[str, float] = {}
    for part in arguments.parts:
        figures.update(PARTS[part](seeds, ProgressLine(part)))
        print()
    print(table(("figure", "value"), list(figures.items())))
    print(write_figures("inputs", figures))


if __name__ == "__main__":
    main()
