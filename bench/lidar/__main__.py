"""Robots with lidars: python -m bench lidar [--starts 50] [--parts cases ...]."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from bench.lidar import buildings, cases, crowd, known_map, real, starts
from bench.shared.common import ProgressLine, options_of, table, write_figures


def main() -> None:
    """Measure, print the table, write the figures."""
    parts: Mapping[str, Callable[[int], dict[str, float]]] = {
        "cases": lambda _: cases.measure(),
        "buildings": lambda _: {
            f"{name}.{key}": value for name, row in buildings.figures().items() for key, value in row.items()
        },
        "turtlebot4_map": lambda _: real.measure(),
        "global_start": lambda count: starts.measure(
            count, real.MAP if real.MAP.is_file() else None, ProgressLine("starts")
        ),
        "crowd": lambda count: crowd.measure(count, ProgressLine("crowd")),
        "lidar_map": lambda count: known_map.measure(range(1, count + 1), ProgressLine("lidar_map")),
    }
    arguments = options_of(
        __doc__,
        starts=(50, "number of random starts in each map"),
        seeds=(2, "number of drives of a crowd and in known maps"),
        parts=(tuple(parts), "what to measure", tuple(parts)),
    )
    figures: dict[str, float] = {}
    for name in arguments.parts:
        figures |= parts[name](arguments.seeds if name in {"crowd", "lidar_map"} else arguments.starts)
    print(table(["figure", "value"], [[key, value] for key, value in figures.items()]))
    print(f"Written: {write_figures('lidar', figures)}")


if __name__ == "__main__":
    main()
