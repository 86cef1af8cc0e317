"""Pictures of a replay: the paths, and the errors over time with what the filter believed about them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt
    from matplotlib.axes import Axes

    from swarm_loc_estimator.core.metrics import Errors
    from swarm_loc_estimator.replay_result import ReplayResult

# Okabe and Ito: told apart by everyone
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
INK, SOFT, TRUTH = "#22303c", "#8795a1", "#9aa5b1"
_MOST_PANELS = 9
_MOST_ROWS = 6
_MOST_POINTS = 1500
_LEAST_GAP_NS = 2_000_000_000
_NEES_95 = (0.216, 9.348)
"""Bounds that hold 95 % of the normalised squared errors of three consistent dimensions."""


def plot_paths(result: ReplayResult, path: Path) -> None:
    """Draw estimated and true paths among the landmarks; a panel per robot when there are few.

    Args:
        result: What to draw.
        path: Picture to write.
    """
    robots = result.swarm.robots
    groups = [[index] for index in range(len(robots))]
    if not 1 < len(robots) <= _MOST_PANELS:
        groups = [list(range(len(robots)))]
    columns = min(3, len(groups)) if len(groups) != 4 else 2
    rows = math.ceil(len(groups) / columns)
    width, height, limits = map_size(result)
    panel = 4.4 if len(groups) > 1 else 8.0
    figure = Figure(
        figsize=(panel * columns, panel * min(max(height / width, 0.45), 1.5) * rows + 0.9),
        layout="constrained",
    )
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axis, group in zip(axes, groups, strict=False):
        _draw_map(axis, result, limits)
        for index in group:
            _draw_path(axis, result, index)
        name = robots[group[0]].name if len(group) == 1 else f"{len(group)} robots"
        axis.set_title(
            name, loc="left", color=colour_of(group[0]) if len(group) == 1 else INK, fontweight="bold"
        )
    for place in range(len(groups), len(axes)):
        axes[place].set_visible(False)
        axes[place - columns].tick_params(labelbottom=True)
    figure.supxlabel("x in map [m]", color=SOFT, fontsize=9)
    figure.supylabel("y in map [m]", color=SOFT, fontsize=9)
    _legend(figure, axes[0])
    _save(figure, path)


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
    shown = [name for name in names if name in ranked[:_MOST_ROWS]]
    figure = Figure(figsize=(15.0, 2.05 * len(shown) + 1.2), layout="constrained")
    axes = figure.subplots(len(shown), 4, squeeze=False, sharex=True)
    begin_ns = int(result.stamp_ns[0])
    limits = _error_limits([result.errors[name] for name in shown])
    for row, name in enumerate(shown):
        _draw_errors(axes[row], result.errors[name], colour_of(_index(result, name)), begin_ns, limits)
        axes[row, 0].set_ylabel(name, color=colour_of(_index(result, name)), fontweight="bold")
    for axis, title in zip(
        axes[0], ("x error [m]", "y error [m]", "heading error [deg]", "NEES"), strict=True
    ):
        axis.set_title(title, loc="left", color=INK, fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]", color=SOFT, fontsize=9)
    note = (
        "error (line) within the estimated 3-sigma band (shade); NEES with its 95 % bounds and ideal mean 3"
    )
    if len(shown) < len(names):
        note += f"; the {len(shown)} of {len(names)} robots with the largest errors"
    figure.suptitle(note, x=0.005, ha="left", fontsize=9, color=SOFT)
    _save(figure, path)
    return True


def _index(result: ReplayResult, name: str) -> int:
    """A robot's place in the swarm."""
    return result.swarm.index_of[name]


def colour_of(index: int) -> str:
    """The colour of a robot in all pictures."""
    return _COLOURS[index % len(_COLOURS)]


def map_size(result: ReplayResult) -> tuple[float, float, tuple[float, float, float, float]]:
    """Width, height and limits (x0, x1, y0, y1) of the world, from truth and landmarks before estimates."""
    points = [track.pose[:, :2] for track in result.truth.values()]
    points += [np.array([[mark.x, mark.y] for mark in result.swarm.landmarks]).reshape(-1, 2)]
    if not result.truth:
        points.append(result.pose[..., :2].reshape(-1, 2))
    every = np.concatenate(points)
    every = every[np.isfinite(every).all(axis=1)]
    if len(every) == 0:
        every = np.zeros((1, 2))
    low, high = every.min(axis=0), every.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 0.5)
    low, high = low - margin, high + margin
    width, height = (float(size) for size in high - low)
    return width, height, (float(low[0]), float(high[0]), float(low[1]), float(high[1]))


def _draw_map(axis: Axes, result: ReplayResult, limits: tuple[float, float, float, float]) -> None:
    """Landmarks with their ids on an even grid."""
    style(axis)
    axis.set_aspect("equal")
    axis.set_xlim(limits[0], limits[1])
    axis.set_ylim(limits[2], limits[3])
    marks = result.swarm.landmarks
    axis.plot(
        [m.x for m in marks], [m.y for m in marks], "s", color=INK, markersize=4, label="landmark", zorder=4
    )
    if len(marks) <= 40:
        for mark in marks:
            axis.annotate(
                str(mark.id),
                (mark.x, mark.y),
                (4, 4),
                textcoords="offset points",
                fontsize=7,
                color=INK,
                zorder=5,
                annotation_clip=True,
            )


def _draw_path(axis: Axes, result: ReplayResult, index: int) -> None:
    """Truth below, estimate above, and where it ended."""
    robot = result.swarm.robots[index]
    if robot.name in result.truth:
        track = result.truth[robot.name]
        truth = _broken(track.stamp_ns, track.pose)[:: max(1, len(track.pose) // 8000)]
        axis.plot(truth[:, 0], truth[:, 1], color=TRUTH, linewidth=2.6, alpha=0.55, zorder=1, label="truth")
    pose = result.pose[:, index][:: max(1, len(result.pose) // 8000)]
    colour = colour_of(index)
    axis.plot(pose[:, 0], pose[:, 1], color=colour, linewidth=0.8, alpha=0.9, zorder=2, label="estimate")
    known = pose[np.isfinite(pose).all(axis=1)]
    if len(known):
        x, y, theta = known[-1]
        axis.plot(
            x, y, "o", color=colour, markersize=6, markeredgecolor="white", zorder=6, label="at the end"
        )
        reach = 0.04 * (axis.get_xlim()[1] - axis.get_xlim()[0])
        ends = [x, x + reach * math.cos(theta)], [y, y + reach * math.sin(theta)]
        axis.plot(*ends, color=colour, linewidth=1.8, zorder=6)


def _legend(figure: Figure, axis: Axes) -> None:
    """One legend for all panels, each thing once."""
    handles, labels = axis.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(
        unique.values(),
        unique.keys(),
        loc="outside upper right",
        ncols=len(unique),
        frameon=False,
        fontsize=9,
    )


def _error_limits(errors: list[Errors]) -> tuple[float, float]:
    """Limits of position [m] and heading [deg] that show all but the wildest errors of all robots."""
    position = np.concatenate([np.abs(one.error[:, :2]).max(axis=1) for one in errors])
    heading = np.concatenate([np.abs(one.error[:, 2]) for one in errors])
    return (
        1.6 * max(float(np.percentile(position, 99.0)), 1e-4),
        1.6 * max(math.degrees(float(np.percentile(heading, 99.0))), 1e-3),
    )


def _draw_errors(
    axes: npt.NDArray[np.object_], errors: Errors, colour: str, begin_ns: int, limits: tuple[float, float]
) -> None:
    """One robot's row."""
    rows = _thin(errors)
    time_s = (errors.stamp_ns[rows] - begin_ns) * 1e-9
    scale = (1.0, 1.0, math.degrees(1.0))
    for column in range(3):
        axis: Axes = axes[column]
        style(axis)
        value, sigma = (scale[column] * part[rows, column] for part in (errors.error, errors.sigma))
        axis.fill_between(time_s, -3.0 * sigma, 3.0 * sigma, color=colour, alpha=0.16, linewidth=0)
        line = _broken(errors.stamp_ns[rows], np.column_stack([time_s, value]))
        lone = len(line) > len(rows)  # single points between gaps would be no line
        axis.plot(*line.T, color=colour, linewidth=0.7, marker="." if lone else "", markersize=3)
        axis.axhline(0.0, color=SOFT, linewidth=0.5)
        limit = limits[0] if column < 2 else limits[1]
        axis.set_ylim(-limit, limit)
    axis = axes[3]
    style(axis)
    axis.axhspan(*_NEES_95, color=SOFT, alpha=0.14, linewidth=0)
    axis.axhline(3.0, color=SOFT, linewidth=0.8)
    axis.plot(time_s, errors.nees[rows].clip(1e-3, 1e4), ".", color=colour, markersize=1.6, alpha=0.7)
    axis.set_yscale("log")
    axis.set_ylim(1e-2, 1e3)


def _broken(stamp_ns: npt.NDArray[np.int64], rows: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Rows with one of NaN in each gap, so that no line is drawn across what is not known."""
    step_ns = np.diff(stamp_ns)
    if len(step_ns) == 0:
        return rows
    gaps = np.flatnonzero(step_ns > max(_LEAST_GAP_NS, 5 * int(np.median(step_ns)))) + 1
    return np.insert(rows, gaps, np.nan, axis=0)


def _thin(errors: Errors) -> npt.NDArray[np.intp]:
    """Indices to draw: of each stretch of time the largest error, so that no spike is lost."""
    count = len(errors.stamp_ns)
    if count <= _MOST_POINTS:
        return np.arange(count)
    size = math.ceil(count / _MOST_POINTS)
    starts = range(0, count, size)
    position = errors.position
    return np.array([start + int(np.argmax(position[start : start + size])) for start in starts])


def style(axis: Axes) -> None:
    """Quiet axes: the data speak."""
    axis.grid(visible=True, color="#e4e8ec", linewidth=0.6)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axis.spines[side].set_color("#c3ccd4")
    axis.tick_params(colors=SOFT, labelsize=8, length=3)


def _save(figure: Figure, path: Path) -> None:
    """Write a picture without a stamp of version or time, so that equal results give equal files."""
    figure.savefig(path, dpi=130, metadata={"Software": None})
