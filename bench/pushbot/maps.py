"""Pictures of maps over the floor plans they are of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from bench.pushbot.runs import RunResult
from bench.shared.common import new_plot, save_plot
from swarm_loc_drivers.sim.pushbot.floor_plan import floor_plan

_SHOWN = ("corridor", "office", "ring", "bend", "atrium", "tee", "two_robots", "five_robots")
_COLUMNS = 3


def draw_maps(results: Mapping[str, Sequence[RunResult]]) -> Path:
    """For each kind of run, the one with the median error: occupied cells and paths over the walls."""
    shown = [name for name in _SHOWN if results.get(name)]
    figure, axes = new_plot(len(shown), width=4.2, height=3.6)
    for name, one in zip(shown, axes, strict=True):
        by_error = sorted(results[name], key=lambda result: result.position_cm)
        draw_map(one, by_error[len(by_error) // 2], name)
    return save_plot(figure, "pushbot_maps")


def draw_map(axes: Axes, result: RunResult, title: str) -> None:
    """One map over its floor plan."""
    walls = floor_plan(result.settings.plan).walls
    axes.add_collection(LineCollection([wall.reshape(2, 2) for wall in walls], colors="0.6", linewidths=2.5))
    axes.plot(*result.cells.T, ",", color="C3")
    for robot in np.unique(result.path[:, 0]):
        path = result.path[result.path[:, 0] == robot]
        axes.plot(path[:, 1], path[:, 2], ".-", markersize=2.5, linewidth=0.5)
    text = f"{title}: {result.position_cm:.1f} cm, walls {result.wall_cm:.1f} cm"
    axes.set(aspect="equal", title=text, xlabel="x [m]", ylabel="y [m]")
