"""One picture that tells a replay at a glance: the swarm on its map, and how far off it was."""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse
from PIL import Image

from swarm_loc_estimator.core.metrics import pool, summarise
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.swarm import Landmark
from swarm_loc_estimator.io.report_plots import INK, SOFT, TRUTH, colour_of, map_size, style
from swarm_loc_estimator.replay_result import ReplayResult

_WIDTH_IN, _DPI = 9.0, 100
_STRIP_IN, _MARGIN_IN = 1.5, 1.0
_TAIL_NS = 8_000_000_000
_SIGMAS = 3.0
_ENLARGED = 10.0
_SEEN = 0.05
"""An ellipse smaller than this share of the map's width is drawn enlarged."""
_MOST_NAMES = 12
_COLOURS = 96
"""A palette makes the file a third as large."""


def plot_overview(result: ReplayResult, path: Path) -> None:
    """Draw paths, landmarks and the robots at the end with their covariance; below, errors over time.

    Args:
        result: What to draw; without ground truth there are no errors.
        path: Picture to write, 900 pixels wide.
    """
    width, height, limits = map_size(result)
    map_in = (_WIDTH_IN - 0.8) * min(height / width, 1.2)
    strip_in = _STRIP_IN if result.errors else 0.0
    figure = Figure(figsize=(_WIDTH_IN, map_in + strip_in + _MARGIN_IN), layout="constrained")
    rows = [map_in, strip_in] if result.errors else [map_in]
    axes: list[Axes] = list(figure.subplots(len(rows), 1, height_ratios=rows, squeeze=False)[:, 0])
    _draw_map(axes[0], result, limits)
    figure.suptitle(_title(result), x=0.01, ha="left", fontsize=13, color=INK, fontweight="bold")
    if result.errors:
        _draw_errors(axes[1], result)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=_DPI, format="png")
    Image.open(drawn).convert("RGB").quantize(_COLOURS).save(path, optimize=True)


def _title(result: ReplayResult) -> str:
    """Who, and how well."""
    robots = f"{len(result.swarm.robots)} robots, {len(result.swarm.landmarks)} landmarks"
    if not result.errors:
        return robots
    row = summarise(pool(list(result.errors.values())))
    error = f"{1e3 * row.position_rmse:.1f} mm, {math.degrees(row.heading_rmse):.1f}°"
    return f"{robots}: RMS error {error}, NEES {row.nees:.1f} (ideal 3)"


def _draw_map(axis: Axes, result: ReplayResult, limits: tuple[float, float, float, float]) -> None:
    """Landmarks below, then truth, paths and robots."""
    style(axis)
    axis.set_aspect("equal")
    axis.set_xlim(limits[0], limits[1])
    axis.set_ylim(limits[2], limits[3])
    axis.set_xlabel("x in map [m]", color=SOFT, fontsize=9)
    axis.set_ylabel("y in map [m]", color=SOFT, fontsize=9)
    size = limits[1] - limits[0]
    for mark in result.swarm.landmarks:
        _draw_landmark(axis, mark, size)
    for index, robot in enumerate(result.swarm.robots):
        if robot.name in result.truth:
            truth = result.truth[robot.name].pose
            axis.plot(truth[:, 0], truth[:, 1], color=TRUTH, linewidth=4.0, alpha=0.35, zorder=1)
        _draw_path(axis, result, index)
    enlarged = _enlargement(result, size)
    for index in range(len(result.swarm.robots)):
        _draw_robot(axis, result, index, size, enlarged)
    _legend(axis, result, enlarged)


def _draw_landmark(axis: Axes, mark: Landmark, size: float) -> None:
    """A bar that faces where the marker faces; a dot where that is unknown."""
    if mark.yaw is None:
        axis.plot(mark.x, mark.y, "s", color=INK, markersize=4, zorder=4)
        return
    ahead = np.array([math.cos(mark.yaw), math.sin(mark.yaw)])
    across = np.array([-ahead[1], ahead[0]])
    place = np.array([mark.x, mark.y])
    bar = np.stack([place - 0.012 * size * across, place + 0.012 * size * across])
    nose = np.stack([place, place + 0.014 * size * ahead])
    axis.plot(*bar.T, color=INK, linewidth=3.5, solid_capstyle="butt", zorder=4)
    axis.plot(*nose.T, color=INK, linewidth=1.2, zorder=4)


def _draw_path(axis: Axes, result: ReplayResult, index: int) -> None:
    """The whole path thin, its end bold."""
    pose, colour = result.pose[:, index], colour_of(index)
    axis.plot(pose[:, 0], pose[:, 1], color=colour, linewidth=0.8, alpha=0.55, zorder=2)
    late = result.stamp_ns >= result.stamp_ns[-1] - _TAIL_NS
    axis.plot(pose[late, 0], pose[late, 1], color=colour, linewidth=2.2, zorder=3)


def _last(result: ReplayResult, index: int) -> tuple[FloatArray, FloatArray] | None:
    """A robot's last pose (3,) with covariance (3, 3)."""
    known = np.flatnonzero(np.isfinite(result.pose[:, index]).all(axis=1))
    return (result.pose[known[-1], index], result.covariance[known[-1], index]) if len(known) else None


def _enlargement(result: ReplayResult, size: float) -> float:
    """How much larger than life ellipses must be drawn to be seen."""
    ends = [last for index in range(len(result.swarm.robots)) if (last := _last(result, index)) is not None]
    sigmas = [math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1])) for _, covariance in ends]
    return 1.0 if not sigmas or 2.0 * _SIGMAS * max(sigmas) > _SEEN * size else _ENLARGED


def _draw_robot(axis: Axes, result: ReplayResult, index: int, size: float, enlarged: float) -> None:
    """A disc with a nose, its ellipse and its name."""
    last = _last(result, index)
    if last is None:
        return
    (x, y, theta), covariance = last
    colour, radius = colour_of(index), 0.013 * size
    variances, directions = np.linalg.eigh(covariance[:2, :2])
    minor, major = 2.0 * _SIGMAS * enlarged * np.sqrt(variances.clip(min=0.0))
    turn = math.degrees(math.atan2(directions[1, 1], directions[0, 1]))
    shade = {"facecolor": colour, "edgecolor": colour, "linewidth": 1.0}
    axis.add_patch(Ellipse((x, y), major, minor, angle=turn, alpha=0.28, zorder=5, **shade))
    axis.add_patch(Circle((x, y), radius, facecolor=colour, edgecolor="white", linewidth=1.2, zorder=6))
    nose = [x, x + 1.9 * radius * math.cos(theta)], [y, y + 1.9 * radius * math.sin(theta)]
    axis.plot(*nose, color=INK, linewidth=2.0, zorder=7)
    if len(result.swarm.robots) <= _MOST_NAMES:
        axis.annotate(
            result.swarm.robots[index].name,
            (x, y),
            (0, 20),
            textcoords="offset points",
            ha="center",
            fontsize=10,
            color=colour,
            fontweight="bold",
            zorder=8,
        )


def _legend(axis: Axes, result: ReplayResult, enlarged: float) -> None:
    """What lines and shades mean."""
    axis.plot([], [], color=INK, linewidth=3.5, label="landmark")
    if result.truth:
        axis.plot([], [], color=TRUTH, linewidth=4.0, alpha=0.5, label="truth")
    axis.plot([], [], color=INK, linewidth=1.0, label="estimate, bold at the end")
    larger = f", {enlarged:.0f} x enlarged" if enlarged != 1.0 else ""
    axis.plot([], [], "o", color=SOFT, markersize=12, alpha=0.4, label=f"{_SIGMAS:.0f}-sigma ellipse{larger}")
    axis.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, frameon=False, fontsize=9, borderpad=0.0
    )


def _draw_errors(axis: Axes, result: ReplayResult) -> None:
    """Distance between estimate and truth of every robot."""
    style(axis)
    begin_ns = result.stamp_ns[0]
    for name, errors in result.errors.items():
        time_s = (errors.stamp_ns - begin_ns) * 1e-9
        colour = colour_of(result.swarm.index_of[name])
        axis.plot(time_s, 1e3 * errors.position, color=colour, linewidth=0.9, alpha=0.85)
    every = np.concatenate([errors.position for errors in result.errors.values()])
    axis.set_ylim(0.0, 1.5e3 * max(float(np.percentile(every, 99.0)), 1e-4))
    axis.margins(x=0.0)
    axis.set_xlabel("time [s]", color=SOFT, fontsize=9)
    axis.set_ylabel("position\nerror [mm]", color=SOFT, fontsize=9)
