"""Plots of each robot: its path, and its errors over time with the estimated standard deviations."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from swarm_loc_estimator.offline.report.map import WorldMap, label_map, last_pose
from swarm_loc_estimator.offline.report.style import (
    INK,
    SOFT,
    broken,
    colour_of,
    length_unit,
    save,
    seconds_since,
    style,
)

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt
    from matplotlib.axes import Axes

    from swarm_loc_estimator.offline.metrics import Errors
    from swarm_loc_estimator.offline.result import ReplayResult

_PANEL_IN = 3.7
_MAX_PANELS = 9
_MAX_ROWS = 6
_MAX_POINTS = 1500
_NEES_95 = (0.216, 9.348)
"""Bounds that hold 95 % of the normalised squared errors of three consistent dimensions."""


def plot_paths(result: ReplayResult, path: Path) -> bool:
    """Draw each robot's true and estimated path in a panel of its own.

    Args:
        result: What to draw.
        path: Picture to write.

    Returns:
        Whether there are as many robots as that is good for: one, or very many, need no such picture.
    """
    robots = result.swarm.robots
    if not 1 < len(robots) <= _MAX_PANELS:
        return False
    columns = 2 if len(robots) == 4 else min(3, len(robots))
    rows = math.ceil(len(robots) / columns)
    world = WorldMap(result)
    size = (_PANEL_IN * columns, _PANEL_IN * min(max(world.shape, 0.45), 1.5) * rows + 0.5)
    figure = Figure(figsize=size)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for index, robot in enumerate(robots):
        axis = axes[index]
        world.draw_world(axis)
        world.draw_ids(axis)
        world.draw_paths(axis, index, alpha=0.9)
        end = last_pose(result, index)
        if end is not None:
            world.draw_robot(axis, index, end[0])
        axis.set_title(robot.name, loc="left", fontsize=10, color=colour_of(index), fontweight="bold")
    for place in range(len(robots), len(axes)):
        axes[place].set_visible(False)
        axes[place - columns].tick_params(labelbottom=True)
    label_map(axes[(rows - 1) * columns])
    save(figure, path)
    return True


def plot_errors(result: ReplayResult, path: Path) -> bool:
    """Draw errors over time with their 3-sigma bands, and NEES; the robots with the largest errors when many.

    Args:
        result: What to draw.
        path: Picture to write.

    Returns:
        Whether there was ground truth to draw anything against.
    """
    names = [name for name, errors in result.errors.items() if len(errors.stamp_ns)]
    if not names:
        return False
    ranked = sorted(names, key=lambda name: -float(np.mean(result.errors[name].position ** 2)))
    shown = [name for name in names if name in ranked[:_MAX_ROWS]]
    figure = Figure(figsize=(11.0, 1.55 * len(shown) + 1.0))
    axes = figure.subplots(len(shown), 4, squeeze=False, sharex=True)
    limits = _error_limits([result.errors[name] for name in shown])
    _, unit = length_unit(limits[0])
    for row, name in enumerate(shown):
        colour = colour_of(result.swarm.index_of[name])
        _draw_errors(axes[row, :3], result.errors[name], colour, int(result.stamp_ns[0]), limits)
        _draw_nees(axes[row, 3], result.errors[name], colour, int(result.stamp_ns[0]))
        axes[row, 0].set_ylabel(name, color=colour, fontweight="bold")
    titles = (f"x error [{unit}]", f"y error [{unit}]", "heading error [deg]", "NEES")
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, loc="left", color=INK, fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]", color=SOFT, fontsize=9)
    note = "error (line) within the estimated 3-sigma band (shade); NEES with its 95 % bounds, ideal mean 3"
    if len(shown) < len(names):
        note += f"; the {len(shown)} of {len(names)} robots with the largest errors"
    figure.suptitle(note, x=0.005, ha="left", fontsize=9, color=SOFT)
    save(figure, path)
    return True


def _error_limits(errors: list[Errors]) -> tuple[float, float]:
    """Limits of position [m] and heading [rad] that show all but the wildest errors of all robots."""
    position = np.concatenate([np.abs(one.error[:, :2]).max(axis=1) for one in errors])
    heading = np.concatenate([np.abs(one.error[:, 2]) for one in errors])
    return (
        1.6 * max(float(np.percentile(position, 99.0)), 1e-4),
        1.6 * max(float(np.percentile(heading, 99.0)), 1e-5),
    )


def _draw_errors(
    axes: npt.NDArray[np.object_], errors: Errors, colour: str, begin_ns: int, limits: tuple[float, float]
) -> None:
    """One robot's errors in x, y and heading."""
    rows = _thin(errors)
    time_s = seconds_since(begin_ns, errors.stamp_ns[rows])
    metre, _ = length_unit(limits[0])
    scales = (metre, metre, math.degrees(1.0))
    for column, (axis, scale) in enumerate(zip(axes, scales, strict=True)):
        style(axis)
        value, sigma = (scale * part[rows, column] for part in (errors.error, errors.sigma))
        axis.fill_between(time_s, -3.0 * sigma, 3.0 * sigma, color=colour, alpha=0.16, linewidth=0)
        line = broken(errors.stamp_ns[rows], np.column_stack([time_s, value]))
        lone = len(line) > len(rows)  # single points between gaps would be no line
        axis.plot(*line.T, color=colour, linewidth=0.7, marker="." if lone else "", markersize=3)
        axis.axhline(0.0, color=SOFT, linewidth=0.5)
        limit = scale * limits[column == 2]
        axis.set_ylim(-limit, limit)
        axis.locator_params(axis="y", nbins=5)


def _draw_nees(axis: Axes, errors: Errors, colour: str, begin_ns: int) -> None:
    """One robot's normalised squared errors."""
    rows = _thin(errors)
    time_s = seconds_since(begin_ns, errors.stamp_ns[rows])
    style(axis)
    axis.axhspan(*_NEES_95, color=SOFT, alpha=0.14, linewidth=0)
    axis.axhline(3.0, color=SOFT, linewidth=0.8)
    axis.plot(time_s, errors.nees[rows].clip(1e-3, 1e4), ".", color=colour, markersize=1.6, alpha=0.7)
    axis.set(yscale="log", ylim=(3e-2, 1e3))
    axis.set_yticks([0.1, 1.0, 10.0, 100.0], ["0.1", "1", "10", "100"])
    axis.minorticks_off()


def _thin(errors: Errors) -> npt.NDArray[np.intp]:
    """Indices to draw: of each stretch of time the largest error, so that no spike is lost."""
    count = len(errors.stamp_ns)
    if count <= _MAX_POINTS:
        return np.arange(count)
    size = math.ceil(count / _MAX_POINTS)
    starts = range(0, count, size)
    position = errors.position
    return np.array([start + int(np.argmax(position[start : start + size])) for start in starts])
