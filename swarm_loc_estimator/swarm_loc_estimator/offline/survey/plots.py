"""Picture of a survey: landmarks with ellipses, paths of robots, fixed cameras and anchors."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from swarm_loc_estimator.offline.report.style import INK, SOFT, colour_of, label_map, save, style
from swarm_loc_estimator.offline.survey.survey import Surveyed

_SIGMAS = 3.0
_LEAST_SHARE = 0.02
"""Size of the largest ellipse, as a share of the arena, to which all are enlarged if they are smaller."""


def draw(done: Surveyed, path: Path) -> Path:
    """Write a PNG."""
    problem, solution = done.problem, done.solution
    placed = np.isfinite(solution.landmark[:, 0])
    places = solution.landmark[placed, :2]
    figure = Figure(figsize=(8.0, 7.0))
    axis = figure.subplots()
    style(axis)
    axis.set_aspect("equal")
    label_map(axis)
    for robot in np.unique(problem.knots.robot).tolist():
        own = done.path[problem.knots.robot == robot]
        axis.plot(own[:, 0], own[:, 1], color=colour_of(robot), linewidth=0.8, alpha=0.6)
        name = problem.swarm.robots[robot].name
        if np.isfinite(own).all():
            axis.annotate(name, own[0, :2].tolist(), fontsize=8, color=colour_of(robot))
    size = float(np.ptp(places, axis=0).max()) if len(places) else 1.0
    axes = [np.linalg.eigh(one[:2, :2]) for one in solution.landmark_covariance[placed]]
    largest = max((_SIGMAS * math.sqrt(max(float(one[0][-1]), 0.0)) for one in axes), default=0.0)
    factor = _LEAST_SHARE * size / largest if largest > 0.0 else 1.0
    factor = factor if factor > 1.5 else 1.0
    for pose, (square, direction) in zip(solution.landmark[placed], axes, strict=True):
        width, height = (2.0 * factor * _SIGMAS * np.sqrt(np.maximum(square, 0.0))).tolist()
        angle = math.degrees(math.atan2(direction[1, 0], direction[0, 0]))
        axis.add_patch(Ellipse(pose[:2], width, height, angle=angle, facecolor=SOFT, alpha=0.35))
        ahead = 0.02 * size * np.array([math.cos(pose[2]), math.sin(pose[2])])
        axis.plot(*np.stack([pose[:2], pose[:2] + ahead]).T, color=INK, linewidth=1.5)
    marks = [mark for mark, is_in in zip(problem.swarm.landmarks, placed, strict=True) if is_in]
    for mark, place in zip(marks, places.tolist(), strict=True):
        axis.annotate(str(mark.id), place, (4, 4), textcoords="offset points", fontsize=7, color=INK)
    fixed = [(camera.name, camera.x, camera.y, "s") for camera in done.swarm.cameras]
    fixed += [(hex(anchor.address), anchor.x, anchor.y, "^") for anchor in done.swarm.anchors]
    for name, x, y, symbol in fixed:
        axis.plot(x, y, symbol, color=INK, markersize=7)
        axis.annotate(name, (x, y), (6, 4), textcoords="offset points", fontsize=8, color=INK)
    note = f"3-sigma ellipses, enlarged {factor:.0f} x" if factor > 1.0 else "3-sigma ellipses"
    axis.set_title(f"{len(marks)} landmarks ({note})", loc="left", fontsize=11, color=INK)
    save(figure, path)
    return path
