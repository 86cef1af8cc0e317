"""A picture of a map, over the floor plan where there is one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.mapping.grid.occupancy import OccupancyMap

_WIDTH_IN = 9.0


def draw_map(
    occupancy: OccupancyMap, stops: FloatArray, walls: FloatArray, path: Path, title: str = ""
) -> Path:
    """Draw the probability of cells, stops (k, 3) and walls (S, 4) to a PNG; returns it."""
    low = occupancy.corner
    high = low + occupancy.cell * np.array(occupancy.log_odds.shape)
    width, height = high - low
    figure = Figure(figsize=(_WIDTH_IN, max(2.0, _WIDTH_IN * height / width)), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    extent = (low[0], high[0], low[1], high[1])
    axes.imshow(occupancy.log_odds.T, origin="lower", extent=extent, cmap="gray_r", vmin=-5.0, vmax=5.0)
    segments = [wall.reshape(2, 2) for wall in walls]
    axes.add_collection(LineCollection(segments, colors="C0", linewidths=1.0, alpha=0.7))
    axes.plot(stops[:, 0], stops[:, 1], ".", color="C3", markersize=3.0)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title or f"{len(stops)} stops")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Software": None})
    return path
