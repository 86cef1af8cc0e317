"""Overview plot: the swarm on its map, beside its errors over time."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from matplotlib.patheffects import withStroke

from swarm_loc_estimator.offline.metrics import pool, summarise
from swarm_loc_estimator.offline.report.map import WorldMap, label_map, last_pose
from swarm_loc_estimator.offline.report.style import (
    INK,
    SOFT,
    TRUTH,
    broken,
    colour_of,
    length_text,
    length_unit,
    save,
    seconds_since,
    style,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from matplotlib.axes import Axes

    from swarm_loc_estimator.common.arrays import FloatArray
    from swarm_loc_estimator.offline.metrics import Errors
    from swarm_loc_estimator.offline.result import ReplayResult

_MAP_IN, _ERRORS_IN = 6.6, 4.4
_ROOM_IN = 0.6
"""Height that title, legend and axes take."""
_TAIL_NS = 6_000_000_000
_SIGMAS = 3.0
_ENLARGED = 20.0
_SEEN = 0.05
"""An ellipse smaller than this share of the map's width is drawn enlarged."""
_MAX_NAMES = 12
_STRETCHES = 120
_NAME_PT = np.array([42.0, 22.0])
"""How far beside and above a robot its name stands."""


def plot_overview(result: ReplayResult, path: Path) -> None:
    """Draw paths, landmarks and the robots at the end with their covariance; beside it, errors over time.

    Args:
        result: What to draw. The picture ends with the ground truth: what it shows last can be judged.
            Without ground truth there are no errors.
        path: Picture to write.
    """
    result = _until_truth_ends(result)
    world = WorldMap(result)
    judged = any(len(errors.stamp_ns) for errors in result.errors.values())
    widths = [_MAP_IN, _ERRORS_IN] if judged else [_MAP_IN + _ERRORS_IN]
    height = widths[0] * min(max(world.shape, 0.5), 1.1) + _ROOM_IN
    figure = Figure(figsize=(_MAP_IN + _ERRORS_IN, height))
    axes = figure.subplot_mosaic("mp;mh" if judged else "m", width_ratios=widths)
    figure.suptitle(_title(result), x=0.012, ha="left", fontsize=15, color=INK, fontweight="bold")
    enlarged = _draw_swarm(axes["m"], result, world)
    _legend(figure, enlarged, judged=judged)
    if judged:
        metre, unit = length_unit(float(np.percentile(pool(list(result.errors.values())).position, 99.0)))
        _draw_errors(axes["p"], f"position error [{unit}]", lambda one: metre * one.position, result)
        _draw_errors(
            axes["h"], "heading error [deg]", lambda one: np.degrees(np.abs(one.error[:, 2])), result
        )
        axes["h"].set_xlabel("time [s]", color=SOFT, fontsize=9)
    save(figure, path)


def _until_truth_ends(result: ReplayResult) -> ReplayResult:
    """The result without poses that are later than all ground truth, where sensors may have stopped, too."""
    ends = [int(track.stamp_ns[-1]) for track in result.truth.values() if len(track.stamp_ns)]
    if not ends:
        return result
    kept = result.stamp_ns <= max(ends)
    stamp_ns, pose, covariance = result.stamp_ns[kept], result.pose[kept], result.covariance[kept]
    return replace(result, stamp_ns=stamp_ns, pose=pose, covariance=covariance)


def _title(result: ReplayResult) -> str:
    """Who, and how well."""
    robots = f"{_counted(result.swarm.robots, 'robot')}, {_counted(result.swarm.landmarks, 'landmark')}"
    if not result.errors:
        return robots
    row = summarise(pool(list(result.errors.values())))
    position, heading = length_text(row.position_rmse), f"{math.degrees(row.heading_rmse):.1f}°"
    return f"{robots}: RMS error {position} and {heading}, NEES {row.nees:.1f} (ideal 3)"


def _counted(things: tuple[object, ...], name: str) -> str:
    """Things by number."""
    return f"{len(things)} {name}{'' if len(things) == 1 else 's'}"


def _draw_swarm(axis: Axes, result: ReplayResult, world: WorldMap) -> float:
    """Landmarks below, then truth, paths and robots; returns how much larger than life the ellipses are."""
    world.draw_world(axis)
    label_map(axis)
    ends = [last_pose(result, index) for index in range(len(result.swarm.robots))]
    enlarged = _enlargement([covariance for _, covariance in filter(None, ends)], world.width)
    middle = np.mean([pose[:2] for pose, _ in filter(None, ends)] or [np.zeros(2)], axis=0)
    for index, end in enumerate(ends):
        world.draw_paths(axis, index, alpha=0.5)
        _draw_tail(axis, result, index)
        if end is None:
            continue
        pose, covariance = end
        _draw_ellipse(axis, pose, covariance[:2, :2], enlarged, colour_of(index))
        world.draw_robot(axis, index, pose)
        if len(ends) <= _MAX_NAMES:
            _draw_name(axis, result.swarm.robots[index].name, pose, middle, colour_of(index))
    return enlarged


def _draw_tail(axis: Axes, result: ReplayResult, index: int) -> None:
    """The last stretch of a path, bold."""
    late = result.stamp_ns >= result.stamp_ns.max(initial=0) - _TAIL_NS
    x, y, _ = result.pose[late, index].T
    axis.plot(x, y, color=colour_of(index), linewidth=2.4, zorder=3)


def _enlargement(covariances: list[FloatArray], width: float) -> float:
    """How much larger than life ellipses must be drawn to be seen."""
    sigmas = [math.sqrt(float(np.linalg.eigvalsh(one[:2, :2])[-1])) for one in covariances]
    return 1.0 if not sigmas or 2.0 * _SIGMAS * max(sigmas) > _SEEN * width else _ENLARGED


def _draw_ellipse(axis: Axes, pose: FloatArray, covariance: FloatArray, enlarged: float, colour: str) -> None:
    """Where a robot is believed to be, (2, 2) about its pose."""
    variances, directions = np.linalg.eigh(covariance)
    minor, major = 2.0 * _SIGMAS * enlarged * np.sqrt(variances.clip(min=0.0))
    turn = math.degrees(math.atan2(directions[1, 1], directions[0, 1]))
    shape = Ellipse((float(pose[0]), float(pose[1])), major, minor, angle=turn, alpha=0.28, zorder=5)
    shape.set_color(colour)
    axis.add_patch(shape)


def _draw_name(axis: Axes, name: str, pose: FloatArray, middle: FloatArray, colour: str) -> None:
    """A robot's name beside its path, on the side away from the swarm's middle."""
    side = np.array([-math.sin(pose[2]), math.cos(pose[2])])
    away = math.copysign(1.0, float(side @ (pose[:2] - middle))) * side * _NAME_PT
    text = axis.annotate(
        name,
        (float(pose[0]), float(pose[1])),
        (float(away[0]), float(away[1])),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=11,
        color=colour,
        fontweight="bold",
        zorder=8,
    )
    text.set_path_effects([withStroke(linewidth=3.0, foreground="white")])


def _legend(figure: Figure, enlarged: float, *, judged: bool) -> None:
    """What lines and shades mean."""
    larger = f", {enlarged:.0f} x enlarged" if enlarged != 1.0 else ""
    meanings = [
        Line2D([], [], color=INK, linewidth=3.5, label="landmark"),
        Line2D([], [], color=INK, linewidth=1.0, label=f"estimate, its last {_TAIL_NS * 1e-9:.0f} s bold"),
        Line2D([], [], color=SOFT, marker="o", linestyle="", markersize=11, alpha=0.4),
    ]
    meanings[-1].set_label(f"{_SIGMAS:.0f}-sigma ellipse{larger}")
    if judged:
        meanings.insert(1, Line2D([], [], color=TRUTH, linewidth=3.6, alpha=0.5, label="truth"))
    figure.legend(handles=meanings, loc="outside lower left", ncols=4, frameon=False, fontsize=9)


def _draw_errors(axis: Axes, title: str, of: Callable[[Errors], FloatArray], result: ReplayResult) -> None:
    """An error over time: faint that of each robot, bold the RMS of the swarm."""
    style(axis)
    begin_ns = int(result.stamp_ns[0])
    for name, errors in result.errors.items():
        line = np.column_stack([seconds_since(begin_ns, errors.stamp_ns), of(errors)])
        colour, alpha = colour_of(result.swarm.index_of[name]), min(0.6, 6.0 / len(result.errors))
        axis.plot(*broken(errors.stamp_ns, line).T, color=colour, linewidth=0.7, alpha=alpha)
    every = pool(list(result.errors.values()))
    axis.plot(*_rms(seconds_since(begin_ns, every.stamp_ns), of(every)), color=INK, linewidth=1.8)
    axis.set_title(f"{title}, bold: RMS", loc="left", fontsize=10, color=INK)
    axis.set(xmargin=0.0, ylim=(0.0, max(1.3 * float(np.percentile(of(every), 99.0)), 1e-3)))


def _rms(time_s: FloatArray, off: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Root mean squares of even stretches of time, and their middles; NaN where there is nothing."""
    edges = np.linspace(float(time_s.min()), np.nextafter(float(time_s.max()), math.inf), _STRETCHES + 1)
    counts, _ = np.histogram(time_s, edges)
    sums, _ = np.histogram(time_s, edges, weights=off**2)
    with np.errstate(invalid="ignore"):
        return (edges[:-1] + edges[1:]) / 2.0, np.sqrt(sums / counts)
