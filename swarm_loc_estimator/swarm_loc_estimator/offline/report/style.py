"""Style of all plots: colours, axes, units, file format; and the common map of a swarm."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image

from swarm_loc_estimator.common.arrays import FloatArray
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


def length_text(length: float) -> str:
    """A length [m] in its readable unit."""
    metre, unit = length_unit(length)
    return f"{metre * length:.{1 if unit == 'mm' else 2}f} {unit}"


def seconds_since(begin_ns: int, stamp_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Stamps as seconds since `begin_ns`."""
    return (stamp_ns - begin_ns).astype(np.float64) * 1e-9


def style(axis: Axes) -> None:
    """Format axes: light grid, no frame."""
    axis.grid(visible=True, color="#e4e8ec", linewidth=0.6)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axis.spines[side].set_color("#c3ccd4")
    axis.tick_params(colors=SOFT, labelsize=8, length=3)


def broken(stamp_ns: npt.NDArray[np.int64], rows: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
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

    Args:
        figure: Of a grid of axes.
        path: File to write.
        margins: None: as texts need it, but to measure them takes longer than to draw.
    """
    if margins is None:
        figure.set_layout_engine("constrained", w_pad=_PAD_IN, h_pad=_PAD_IN)
    else:
        _place(figure, margins)
    figure.set_dpi(_DPI)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()  # savefig would draw twice, the first time only to arrange the axes
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    image.quantize(_PALETTE).save(path, format="png")


def _place(figure: Figure, margins: Margins) -> None:
    """Place the axes of a figure."""
    width, height = figure.get_size_inches()
    grid: Any = figure.axes[0].get_gridspec()
    left, right, bottom, top, across, down = margins
    inside = np.array([width - left - right, height - bottom - top])
    gaps, counts = np.array([across, down]), np.array([grid.ncols, grid.nrows])
    wspace, hspace = gaps * counts / (inside - gaps * (counts - 1))
    figure.subplots_adjust(
        left / width, bottom / height, 1.0 - right / width, 1.0 - top / height, wspace, hspace
    )


_MAX_POINTS = 8000
_MAX_IDS = 40
_MARGIN = 0.05  # Margin around the world, as a share of its size


class WorldMap:
    """Draws a result on a map; all lengths in metres.

    Args:
        result: The run.

    Attributes:
        x: Limits from truth and landmarks; from estimates only without truth.
        y: Limits in y.
        radius: Of the disc of a robot.
    """

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
        self.x = (float(low[0]) - margin, float(high[0]) + margin)
        self.y = (float(low[1]) - margin, float(high[1]) + margin)
        self.radius = 0.014 * self.width / max(1.0, len(result.swarm.robots) / 30) ** 0.5

    @property
    def width(self) -> float:
        """Extent along x."""
        return self.x[1] - self.x[0]

    @property
    def shape(self) -> float:
        """Height over width."""
        return (self.y[1] - self.y[0]) / self.width

    def draw_world(self, axis: Axes) -> None:
        """Draw axes at equal scale, and the landmarks."""
        style(axis)
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
            truth = broken(track.stamp_ns, track.pose)[:: max(1, len(track.pose) // _MAX_POINTS)]
            axis.plot(truth[:, 0], truth[:, 1], color=TRUTH, linewidth=3.6, alpha=0.4, zorder=1)
        pose = result.poses[:, index][:: max(1, len(result.poses) // _MAX_POINTS)]
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


def label_map(axis: Axes) -> None:
    """Label the axes."""
    axis.set_xlabel("x in map [m]", color=SOFT, fontsize=9)
    axis.set_ylabel("y in map [m]", color=SOFT, fontsize=9)
