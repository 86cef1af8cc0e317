"""A swarm's world as a map: landmarks, true and estimated paths, robots."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import Circle

from swarm_loc_estimator.offline.report.style import INK, SOFT, TRUTH, broken, colour_of, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from swarm_loc_estimator.common.arrays import FloatArray
    from swarm_loc_estimator.offline.result import ReplayResult
    from swarm_loc_estimator.swarm.swarm import Landmark

_MAX_POINTS = 8000
_MAX_IDS = 40
_MARGIN = 0.05
"""Free space around the world, as a share of its size."""


class WorldMap:
    """The part of the plane that a result is about, and how it is drawn; all lengths in metres.

    Args:
        result: What to draw.

    Attributes:
        x: Limits; from truth and landmarks before estimates, which may be anywhere.
        y: Likewise.
        radius: Of the disc that stands for a robot.
    """

    def __init__(self, result: ReplayResult) -> None:
        self._result = result
        points = [track.pose[:, :2] for track in result.truth.values()]
        points += [np.array([[mark.x, mark.y] for mark in result.swarm.landmarks]).reshape(-1, 2)]
        if not result.truth:
            points.append(result.pose[..., :2].reshape(-1, 2))
        every = np.concatenate(points)
        every = every[np.isfinite(every).all(axis=1)]
        low, high = (every.min(axis=0), every.max(axis=0)) if len(every) else (np.zeros(2), np.zeros(2))
        margin = _MARGIN * max(float((high - low).max()), 0.5)
        self.x = (float(low[0]) - margin, float(high[0]) + margin)
        self.y = (float(low[1]) - margin, float(high[1]) + margin)
        self.radius = 0.014 * self.width / max(1.0, len(result.swarm.robots) / 30) ** 0.5

    @property
    def width(self) -> float:
        """Along x."""
        return self.x[1] - self.x[0]

    @property
    def shape(self) -> float:
        """Height over width."""
        return (self.y[1] - self.y[0]) / self.width

    def draw_world(self, axis: Axes) -> None:
        """Axes at equal scale, and the landmarks."""
        style(axis)
        axis.set(aspect="equal", xlim=self.x, ylim=self.y)
        for mark in self._result.swarm.landmarks:
            self._draw_landmark(axis, mark)

    def draw_ids(self, axis: Axes) -> None:
        """The landmarks' ids, where they are few enough to be read."""
        landmarks = self._result.swarm.landmarks
        for mark in landmarks if len(landmarks) <= _MAX_IDS else ():
            place, shift = (mark.x, mark.y), (4, 4)
            axis.annotate(str(mark.id), place, shift, textcoords="offset points", fontsize=7, color=SOFT)

    def draw_paths(self, axis: Axes, index: int, alpha: float) -> None:
        """A robot's true path broad, its estimated path thin above it."""
        result, colour = self._result, colour_of(index)
        name = result.swarm.robots[index].name
        if name in result.truth:
            track = result.truth[name]
            truth = broken(track.stamp_ns, track.pose)[:: max(1, len(track.pose) // _MAX_POINTS)]
            axis.plot(truth[:, 0], truth[:, 1], color=TRUTH, linewidth=3.6, alpha=0.4, zorder=1)
        pose = result.pose[:, index][:: max(1, len(result.pose) // _MAX_POINTS)]
        axis.plot(pose[:, 0], pose[:, 1], color=colour, linewidth=0.9, alpha=alpha, zorder=2)

    def draw_robot(self, axis: Axes, index: int, pose: FloatArray) -> None:
        """A disc with a nose at a pose (3,)."""
        x, y, theta = (float(value) for value in pose)
        colour = colour_of(index)
        axis.add_patch(
            Circle((x, y), self.radius, facecolor=colour, edgecolor="white", linewidth=0.9, zorder=6)
        )
        reach = 1.9 * self.radius
        axis.plot([x, x + reach * math.cos(theta)], [y, y + reach * math.sin(theta)], color=INK, zorder=7)

    def _draw_landmark(self, axis: Axes, mark: Landmark) -> None:
        """A bar that faces where the marker faces; a square where that is unknown."""
        if mark.yaw is None:
            axis.plot(mark.x, mark.y, "s", color=INK, markersize=4, zorder=4)
            return
        ahead = 0.013 * self.width * np.array([math.cos(mark.yaw), math.sin(mark.yaw)])
        across = np.array([-ahead[1], ahead[0]])
        place = np.array([mark.x, mark.y])
        axis.plot(*np.stack([place - across, place + across]).T, color=INK, linewidth=3.5, zorder=4)
        axis.plot(*np.stack([place, place + ahead]).T, color=INK, linewidth=1.2, zorder=4)


def last_pose(result: ReplayResult, index: int) -> tuple[FloatArray, FloatArray] | None:
    """A robot's last pose (3,) with its covariance (3, 3); None where it never had one."""
    known = np.flatnonzero(np.isfinite(result.pose[:, index]).all(axis=1))
    return (result.pose[known[-1], index], result.covariance[known[-1], index]) if len(known) else None


def label_map(axis: Axes) -> None:
    """Say what the axes are."""
    axis.set_xlabel("x in map [m]", color=SOFT, fontsize=9)
    axis.set_ylabel("y in map [m]", color=SOFT, fontsize=9)
