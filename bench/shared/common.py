"""What all benchmarks share: the folder of results, tables, figures and the style of plots."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
from matplotlib import pyplot as plt

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from swarm_loc_estimator.common.arrays import FloatArray, IntArray

OUT = Path(__file__).resolve().parents[2] / "out"  # Folder of results

_STYLE = {
    "figure.constrained_layout.use": True,
    "figure.dpi": 120,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "font.size": 10,
    "legend.frameon": False,
    "lines.linewidth": 1.8,
}

Cell = str | float | int | None


def table(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """A table as text: numbers to three significant digits at the right, a dash for None."""
    texts = [[*columns], *([_text(cell) for cell in row] for row in rows)]
    widths = [max(len(text) for text in column) for column in zip(*texts, strict=True)]
    lines = ["  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in texts]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def rms(values: ArrayLike) -> float:
    """Root mean square of numbers."""
    return float(np.sqrt(np.mean(np.square(values))))


def equal_parts(values: FloatArray, count: int) -> list[IntArray]:
    """Indices of values by size, in so many parts of about as many each."""
    return np.array_split(np.argsort(values, kind="stable"), count)


def write_figures(name: str, figures: Mapping[str, float], folder: Path = OUT / "bench") -> Path:
    """Write figures as one flat JSON object to out/bench/NAME.json; returns the file.

    Raises:
        ValueError: A figure is not finite; leave out what was not measured.
    """
    for key, value in figures.items():
        if not math.isfinite(value):
            raise ValueError(f"figure {key} of {name} is {value}; it must be finite.")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(dict(figures), indent=2) + "\n", encoding="utf-8")
    temporary.replace(path)
    return path


def new_plot(columns: int, *, width: float = 4.6, height: float = 3.6) -> tuple[Figure, list[Axes]]:
    """A figure with plots side by side, in the style of all benchmarks; sizes of one plot in inches."""
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type] # the stubs know the keys only as literals
        figure, axes = plt.subplots(1, columns, figsize=(width * columns, height), squeeze=False)
    return figure, list(axes[0])


def save_plot(figure: Figure, name: str, folder: Path = OUT) -> Path:
    """Save a figure as out/NAME.png and close it; returns the file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    figure.savefig(path)
    plt.close(figure)
    return path


def plot_by_size(
    name: str,
    results: Mapping[str, Mapping[int, Mapping[str, float]]],
    figures: Mapping[str, str],
    sizes: str,
    legend: str,
) -> Path:
    """Plot figures over sizes, a line for each variant, as out/NAME.png; returns the file.

    Args:
        name: Of the plot.
        results: Variant -> size -> figure -> value.
        figures: Figure to plot -> label with its unit.
        sizes: What the sizes count.
        legend: Title of the variants.
    """
    figure, axes = new_plot(len(figures), width=3.4)
    for axis, (key, label) in zip(axes, figures.items(), strict=True):
        for variant, found in results.items():
            axis.plot(list(found), [one[key] for one in found.values()], "o-", label=variant)
        axis.set(xlabel=sizes, ylabel=label, xlim=(0.0, None), ylim=(0.0, None))
    axes[0].legend(title=legend)
    return save_plot(figure, name)


def _text(cell: Cell) -> str:
    if cell is None:
        return "-"
    return f"{cell:.3g}" if isinstance(cell, float) else str(cell)


class ProgressLine:
    """A line of progress that is rewritten."""

    def __init__(self, what: str) -> None:
        self._what, self._shown = what, ""

    def __call__(self, text: str) -> None:
        """Print a text if it has changed."""
        if text != self._shown:
            print(f"\r{self._what}: {text:32}", end="", flush=True)
            self._shown = text
