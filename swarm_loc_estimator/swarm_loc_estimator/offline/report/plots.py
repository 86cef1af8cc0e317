"""Plots of a replay: the swarm on its map, the path of each robot, errors over time with 3-sigma bands.

The style of all plots (colours, axes, units, file format) stands here, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse
from matplotlib.patheffects import withStroke
from PIL import Image

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.files import replacing
from swarm_loc_estimator.offline.metrics import Errors, pool
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Landmark

INK, SOFT, TRUTH = "#22303c", "#6b7a86", "#9aa5b1"
# Okabe and Ito: distinguishable with any colour vision
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
_DPI = 120
_PAD_IN = 0.08
_PALETTE = 256  # Fewer colours halve the size of the file
_MILLIMETRES_BELOW_M = 0.1
_MIN_GAP_NS = 2_000_000_000


def colour_of(index: int) -> str:
    """The colour of a robot (index) in all plots."""
    return _COLOURS[index % len(_COLOURS)]


def length_unit(length: float) -> tuple[float, str]:
    """The readable unit of a length [m]: units per metre, and its name."""
    return (1e3, "mm") if abs(length) < _MILLIMETRES_BELOW_M else (1.0, "m")


def seconds_since(begin_ns: int, stamp_ns: IntArray) -> FloatArray:
    """Stamps as seconds since `begin_ns`."""
    return (stamp_ns - begin_ns).astype(np.float64) * 1e-9


def style(axis: Axes, title: str = "", x: str = "", y: str = "") -> None:
    """Format axes: light grid, no frame, a title to the left, labels."""
    axis.set_title(title, loc="left", fontsize=10, color=INK)
    axis.set_xlabel(x, color=SOFT, fontsize=9)
    axis.set_ylabel(y, color=SOFT, fontsize=9)
    axis.grid(visible=True, color="#e4e8ec", linewidth=0.6)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axis.spines[side].set_color("#c3ccd4")
    axis.tick_params(colors=SOFT, labelsize=8, length=3)


def broken(stamp_ns: IntArray, rows: FloatArray) -> FloatArray:
    """Rows with a row of NaN inserted in each gap of time, so that lines are interrupted there."""
    step_ns = np.diff(stamp_ns)
    if len(step_ns) == 0:
        return rows
    gaps = np.flatnonzero(step_ns > max(_MIN_GAP_NS, 5 * int(np.median(step_ns)))) + 1
    return np.insert(rows, gaps, np.nan, axis=0)


class Margins(NamedTuple):
    """Room around the axes of a figure, and between them [in]."""

    left: float
    right: float
    bottom: float
    top: float
    across: float
    down: float


def save(figure: Figure, path: Path, margins: Margins | None = None) -> None:
    """Write a PNG with few colours and without version or time: equal results give equal files.

    Without margins, they are as texts need it, but to measure them takes longer than to draw.
    """
    if margins is None:
        figure.set_layout_engine("constrained", w_pad=_PAD_IN, h_pad=_PAD_IN)
    else:
        _place(figure, margins)
    figure.set_dpi(_DPI)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()  # savefig would draw twice, the first time only to arrange the axes
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    with replacing(path) as part:
        image.quantize(_PALETTE).save(part, format="png")


def _place(figure: Figure, margins: Margins) -> None:
    width, height = figure.get_size_inches()
    grid: Any = figure.axes[0].get_gridspec()
    left, right, bottom, top, across, down = margins
    inside = np.array([width - left - right, height - bottom - top])
    gaps, counts = np.array([across, down]), np.array([grid.ncols, grid.nrows])
    wspace, hspace = gaps * counts / (inside - gaps * (counts - 1))
    figure.subplots_adjust(
        left / width, bottom / height, 1.0 - right / width, 1.0 - top / height, wspace, hspace
    )


_MAX_PATH_POINTS = 8000
_MAX_IDS = 40
_MARGIN = 0.05  # Margin around the world, as a share of its size


class WorldMap:
    """Draws a result on a map; all lengths in metres."""

    def __init__(self, result: ReplayResult) -> None:
        self._result = result
        points = [track.pose[:, :2] for track in result.truth.values()]
        points += [np.array([[mark.x, mark.y] for mark in result.swarm.landmarks]).reshape(-1, 2)]
        if not result.truth:
            points.append(result.poses[..., :2].reshape(-1, 2))
        every = np.concatenate(points)
        every = every[np.isfinite(every).all(axis=1)]
        low, high = (every.min(axis=0), every.max(axis=0)) if len(every) else (np.zeros(2), np.zeros(2))
        margin = _MARGIN * max(float((high - low).max()), 0.5)
        # Limits from truth and landmarks; without truth, from estimates
        self.x = (float(low[0]) - margin, float(high[0]) + margin)
        self.y = (float(low[1]) - margin, float(high[1]) + margin)  # Limits in y
        # Of the disc of a robot
        self.radius = 0.014 * self.width / max(1.0, len(result.swarm.robots) / 30) ** 0.5

    @property
    def width(self) -> float:
        """Extent along x."""
        return self.x[1] - self.x[0]

    @property
    def shape(self) -> float:
        """Height over width."""
        return (self.y[1] - self.y[0]) / self.width

    def draw_world(self, axis: Axes, title: str = "", x: str = "", y: str = "") -> None:
        """Draw axes at equal scale, and the landmarks."""
        style(axis, title, x, y)
        axis.set(aspect="equal", xlim=self.x, ylim=self.y)
        for mark in self._result.swarm.landmarks:
            self._draw_landmark(axis, mark)

    def draw_ids(self, axis: Axes) -> None:
        """Draw the ids of the landmarks, unless there are too many to read."""
        landmarks = self._result.swarm.landmarks
        for mark in landmarks if len(landmarks) <= _MAX_IDS else ():
            place, shift = (mark.x, mark.y), (4, 4)
            axis.annotate(str(mark.id), place, shift, textcoords="offset points", fontsize=7, color=SOFT)

    def draw_paths(self, axis: Axes, index: int, alpha: float) -> None:
        """Draw a robot's true path broad, its estimated path thin above it."""
        result, colour = self._result, colour_of(index)
        name = result.swarm.robots[index].name
        if name in result.truth:
            track = result.truth[name]
            truth = broken(track.stamp_ns, track.pose)[:: max(1, len(track.pose) // _MAX_PATH_POINTS)]
            axis.plot(truth[:, 0], truth[:, 1], color=TRUTH, linewidth=3.6, alpha=0.4, zorder=1)
        pose = result.poses[:, index][:: max(1, len(result.poses) // _MAX_PATH_POINTS)]
        axis.plot(pose[:, 0], pose[:, 1], color=colour, linewidth=0.9, alpha=alpha, zorder=2)

    def draw_robot(self, axis: Axes, index: int, pose: FloatArray) -> None:
        """Draw a disc with a nose at a pose (3,)."""
        x, y, theta = (float(value) for value in pose)
        colour = colour_of(index)
        axis.add_patch(
            Circle((x, y), self.radius, facecolor=colour, edgecolor="white", linewidth=0.9, zorder=6)
        )
        reach = 1.9 * self.radius
        axis.plot([x, x + reach * math.cos(theta)], [y, y + reach * math.sin(theta)], color=INK, zorder=7)

    def _draw_landmark(self, axis: Axes, mark: Landmark) -> None:
        """Draw a bar with the direction of the marker; a square if that is unknown."""
        if mark.yaw is None:
            axis.plot(mark.x, mark.y, "s", color=INK, markersize=4, zorder=4)
            return
        ahead = 0.013 * self.width * np.array([math.cos(mark.yaw), math.sin(mark.yaw)])
        across = np.array([-ahead[1], ahead[0]])
        place = np.array([mark.x, mark.y])
        axis.plot(*np.stack([place - across, place + across]).T, color=INK, linewidth=3.5, zorder=4)
        axis.plot(*np.stack([place, place + ahead]).T, color=INK, linewidth=1.2, zorder=4)


def last_pose(result: ReplayResult, index: int) -> tuple[FloatArray, FloatArray] | None:
    """A robot's last pose (3,) with its covariance (3, 3); None if it was never located."""
    known = np.flatnonzero(np.isfinite(result.poses[:, index]).all(axis=1))
    return (result.poses[known[-1], index], result.covariances[known[-1], index]) if len(known) else None


IN_MAP = "x in map [m]", "y in map [m]"  # Labels of axes
_MAP_IN, _ERRORS_IN = 6.6, 4.4
_ROOM_IN = 0.6  # Height of title, legend and axes
_AROUND_MAP = Margins(left=0.65, right=0.15, bottom=0.9, top=0.7, across=0.5, down=0.6)
_AROUND_PATHS = Margins(left=0.65, right=0.15, bottom=0.5, top=0.35, across=0.2, down=0.5)
_AROUND_ERRORS = Margins(left=0.7, right=0.15, bottom=0.5, top=0.7, across=0.5, down=0.2)
_TAIL_NS = 6_000_000_000
_SIGMAS = 3.0
_ENLARGED = 20.0
_SEEN = 0.05  # Ellipses are enlarged if the largest is smaller than this share of the map's width
_MAX_NAMES = 12
_STRETCHES = 120
_NAME_PT = np.array([42.0, 22.0])  # Distance of a name from its robot, horizontally and vertically


def plot_overview(result: ReplayResult, path: Path) -> None:
    """Draw paths, landmarks and the last poses until the truth ends; to the right, errors over time."""
    # sensors may stop when all ground truth has ended
    ends = [int(track.stamp_ns[-1]) for track in result.truth.values() if len(track.stamp_ns)]
    while_true = result.stamp_ns <= max(ends, default=-1)
    result = result.select(while_true) if while_true.any() else result
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
    save(figure, path, _AROUND_MAP)


def _title(result: ReplayResult) -> str:
    robots = f"{_counted(result.swarm.robots, 'robot')}, {_counted(result.swarm.landmarks, 'landmark')}"
    if not result.errors:
        return robots
    row = result.overall
    metre, unit = length_unit(row.position_rmse)
    position = f"{metre * row.position_rmse:.{1 if unit == 'mm' else 2}f} {unit}"
    heading = f"{math.degrees(row.heading_rmse):.1f}°"
    return f"{robots}: RMS error {position} and {heading}, NEES {row.nees:.1f} (ideal 3)"


def _counted(things: tuple[object, ...], name: str) -> str:
    """A number of things, such as "2 robots"."""
    return f"{len(things)} {name}{'' if len(things) == 1 else 's'}"


def _draw_swarm(axis: Axes, result: ReplayResult, world: WorldMap) -> float:
    """Draw landmarks, truth, paths and robots; returns the factor by which ellipses are enlarged."""
    world.draw_world(axis, "", *IN_MAP)
    ends = [last_pose(result, index) for index in range(len(result.swarm.robots))]
    sigmas = [math.sqrt(float(np.linalg.eigvalsh(one[:2, :2])[-1])) for _, one in filter(None, ends)]
    is_seen = not sigmas or 2.0 * _SIGMAS * max(sigmas) > _SEEN * world.width
    enlarged = 1.0 if is_seen else _ENLARGED
    late = result.stamp_ns >= result.stamp_ns.max(initial=0) - _TAIL_NS
    middle = np.mean([pose[:2] for pose, _ in filter(None, ends)] or [np.zeros(2)], axis=0)
    for index, end in enumerate(ends):
        world.draw_paths(axis, index, alpha=0.5)
        x, y, _ = result.poses[late, index].T
        axis.plot(x, y, color=colour_of(index), linewidth=2.4, zorder=3)
        if end is None:
            continue
        pose, covariance = end
        draw_ellipse(axis, pose, covariance, enlarged, colour_of(index))
        world.draw_robot(axis, index, pose)
        if len(ends) <= _MAX_NAMES:
            _draw_name(axis, result.swarm.robots[index].name, pose, middle, colour_of(index))
    return enlarged


def draw_ellipse(axis: Axes, pose: FloatArray, covariance: FloatArray, enlarged: float, colour: str) -> None:
    """Draw the 3-sigma ellipse of a position by the covariance (3, 3) of a pose (3,)."""
    variances, directions = np.linalg.eigh(covariance[:2, :2])
    minor, major = 2.0 * _SIGMAS * enlarged * np.sqrt(variances.clip(min=0.0))
    turn = math.degrees(math.atan2(directions[1, 1], directions[0, 1]))
    place = float(pose[0]), float(pose[1])
    axis.add_patch(Ellipse(place, major, minor, angle=turn, alpha=0.28, zorder=5, color=colour))


def _draw_name(axis: Axes, name: str, pose: FloatArray, middle: FloatArray, colour: str) -> None:
    """Write a robot's name next to its path, on the side away from the middle of the swarm."""
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
    larger = f", {enlarged:.0f} x enlarged" if enlarged != 1.0 else ""
    meanings = [
        Line2D([], [], color=INK, linewidth=3.5, label="landmark"),
        Line2D([], [], color=INK, linewidth=1.0, label=f"estimate, its last {_TAIL_NS * 1e-9:.0f} s bold"),
        Line2D([], [], color=SOFT, marker="o", linestyle="", markersize=11, alpha=0.4),
    ]
    meanings[-1].set_label(f"{_SIGMAS:.0f}-sigma ellipse{larger}")
    if judged:
        meanings.insert(1, Line2D([], [], color=TRUTH, linewidth=3.6, alpha=0.5, label="truth"))
    figure.legend(handles=meanings, loc="lower left", ncols=4, frameon=False, fontsize=9)


def _draw_errors(axis: Axes, title: str, of: Callable[[Errors], FloatArray], result: ReplayResult) -> None:
    """Plot an error over time: thin for each robot, bold for the RMS of the swarm."""
    style(axis, f"{title}, bold: RMS")
    begin_ns = int(result.stamp_ns[0])
    for name, errors in result.errors.items():
        line = np.column_stack([seconds_since(begin_ns, errors.stamp_ns), of(errors)])
        colour, alpha = colour_of(result.swarm.index_of[name]), min(0.6, 6.0 / len(result.errors))
        axis.plot(*broken(errors.stamp_ns, line).T, color=colour, linewidth=0.7, alpha=alpha)
    every = pool(list(result.errors.values()))
    off = of(every)
    known = np.isfinite(off)  # a heading may be unknown
    if known.any():
        axis.plot(*_rms(seconds_since(begin_ns, every.stamp_ns[known]), off[known]), color=INK, linewidth=1.8)
    axis.set(xmargin=0.0, ylim=(0.0, max(1.3 * _most(off), 1e-3)))


def _most(off: FloatArray) -> float:
    """The 99th percentile of the errors that are known; 0 without any."""
    return float(np.nanpercentile(off, 99.0)) if np.isfinite(off).any() else 0.0


def _rms(time_s: FloatArray, off: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Middles of equal intervals of time, and the RMS in each; NaN in empty ones."""
    edges = np.linspace(float(time_s.min()), np.nextafter(float(time_s.max()), math.inf), _STRETCHES + 1)
    counts, _ = np.histogram(time_s, edges)
    sums, _ = np.histogram(time_s, edges, weights=off**2)
    with np.errstate(invalid="ignore"):
        return (edges[:-1] + edges[1:]) / 2.0, np.sqrt(sums / counts)


_PANEL_IN = 3.7
_MAX_PANELS = 9
_MAX_ROWS = 6
_MAX_POINTS = 1500
_NEES_95 = (0.216, 9.348)  # 95 % bounds of the normalized squared error of three dimensions


def plot_paths(result: ReplayResult, path: Path) -> bool:
    """Draw each robot's true and estimated path in a panel of its own.

    Returns whether the file was written: not for one robot nor for more than `_MAX_PANELS`.
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
        world.draw_world(axis, robot.name, *(IN_MAP if index == (rows - 1) * columns else ()))
        axis.title.set(color=colour_of(index), fontweight="bold")
        world.draw_ids(axis)
        world.draw_paths(axis, index, alpha=0.9)
        if (end := last_pose(result, index)) is not None:
            world.draw_robot(axis, index, end[0])
    for place in range(len(robots), len(axes)):
        axes[place].set_visible(False)
        axes[place - columns].tick_params(labelbottom=True)
    save(figure, path, _AROUND_PATHS)
    return True


def plot_errors(result: ReplayResult, path: Path) -> bool:
    """Draw errors over time with their 3-sigma bands, and NEES; of many robots those with the largest errors.

    Returns whether the file was written: not without ground truth.
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
        colour, begin_ns = colour_of(result.swarm.index_of[name]), int(result.stamp_ns[0])
        _draw_errors_of(axes[row, :3], result.errors[name], colour, begin_ns, limits)
        if result.smoothed is not None:
            smoothed = result.smoothed.errors[name]
            _draw_errors_of(axes[row, :3], smoothed, INK, begin_ns, limits, is_above=True)
        _draw_nees(axes[row, 3], result.errors[name], colour, begin_ns)
        axes[row, 0].set_ylabel(name, color=colour, fontweight="bold")
    titles = (f"x error [{unit}]", f"y error [{unit}]", "heading error [deg]", "NEES")
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, loc="left", color=INK, fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]", color=SOFT, fontsize=9)
    note = "error (line) within the estimated 3-sigma band (shade); NEES with its 95 % bounds, ideal mean 3"
    if result.smoothed is not None:
        note += "; dark: smoothed"
    if len(shown) < len(names):
        note += f"; the {len(shown)} of {len(names)} robots with the largest errors"
    figure.suptitle(note, x=0.005, ha="left", fontsize=9, color=SOFT)
    save(figure, path, _AROUND_ERRORS)
    return True


def _error_limits(errors: list[Errors]) -> tuple[float, float]:
    """Axis limits of position [m] and heading [rad] from the 99th percentiles of all robots."""
    position = np.concatenate([np.abs(one.error[:, :2]).max(axis=1) for one in errors])
    heading = np.concatenate([np.abs(one.error[:, 2]) for one in errors])
    return 1.6 * max(_most(position), 1e-4), 1.6 * max(_most(heading), 1e-5)


def _draw_errors_of(
    axes: npt.NDArray[np.object_],
    errors: Errors,
    colour: str,
    begin_ns: int,
    limits: tuple[float, float],
    *,
    is_above: bool = False,
) -> None:
    """Plot one robot's errors in x, y and heading: with 3-sigma bands, or as lines above what is drawn."""
    rows = _thin(errors)
    time_s = seconds_since(begin_ns, errors.stamp_ns[rows])
    metre, _ = length_unit(limits[0])
    for column, (axis, scale) in enumerate(zip(axes, (metre, metre, math.degrees(1.0)), strict=True)):
        value, sigma = (scale * part[rows, column] for part in (errors.error, errors.sigma))
        line = broken(errors.stamp_ns[rows], np.column_stack([time_s, value]))
        lone = len(line) > len(rows)  # single points between gaps make no line
        axis.plot(*line.T, color=colour, linewidth=0.7, marker="." if lone else "", markersize=3)
        if is_above:
            continue
        style(axis)
        axis.fill_between(time_s, -3.0 * sigma, 3.0 * sigma, color=colour, alpha=0.16, linewidth=0)
        axis.axhline(0.0, color=SOFT, linewidth=0.5)
        limit = scale * limits[column == 2]
        axis.set_ylim(-limit, limit)
        axis.locator_params(axis="y", nbins=5)


def _draw_nees(axis: Axes, errors: Errors, colour: str, begin_ns: int) -> None:
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
    """Indices to draw: the largest error of each interval, so that no spike is lost."""
    count = len(errors.stamp_ns)
    if count <= _MAX_POINTS:
        return np.arange(count)
    size, position = math.ceil(count / _MAX_POINTS), errors.position
    return np.array([k + int(np.argmax(position[k : k + size])) for k in range(0, count, size)])
