"""Inputs: how well each kind of sensor locates a swarm, compared with bounds and other software.

A part is a module with a function `measure(seeds, say)`, which returns figures by name and draws plots.

    make bench-inputs
    make bench-inputs ARGS="--parts uwb mocap --seeds 2"
"""

from collections.abc import Callable, Mapping, Sequence

from bench.inputs import families, imu, lidar_map, mocap, no_map, overhead, uwb
from bench.shared.common import ProgressLine, options_of, table, write_figures

PARTS: Mapping[str, Callable[[Sequence[int], ProgressLine], Mapping[str, float]]] = {
    "overhead": overhead.measure,
    "mocap": mocap.measure,
    "uwb": uwb.measure,
    "families": families.measure,
    "imu": imu.measure,
    "no_map": no_map.measure,
    "lidar_map": lidar_map.measure,
}
"""Part -> its function. Figures start with the name of the part, or twist_only (imu) or merge (no_map)."""


def main() -> None:
    """Run the parts, print the table, write the figures."""
    parts = tuple(PARTS)
    arguments = options_of(__doc__, seeds=(5, "runs of each part"), parts=(parts, "what to measure", parts))
    seeds = range(1, arguments.seeds + 1)
    figures: dict[str, float] = {}
    for part in arguments.parts:
        figures.update(PARTS[part](seeds, ProgressLine(part)))
        print()
    print(table(("figure", "value"), list(figures.items())))
    print(write_figures("inputs", figures))


if __name__ == "__main__":
    main()
