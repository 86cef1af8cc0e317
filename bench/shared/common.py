"""What all benchmarks share: the folder of results, tables, figures and the style of plots."""

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

OUT = Path(__file__).resolve().parents[2] / "out"  # Folder of results
SHARED = OUT.parents[1] / "shared"  # Recordings of others, next to the workspace
DEMO_BAG = OUT.parent / "bags" / "eight_five_robots"

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
Curves = Mapping[str, "ArrayLike | tuple[ArrayLike, ArrayLike]"]
"""Label -> values over a common abscissa, or values with an abscissa of their own; none of "" has a label."""


def options_of(doc: str | None, arguments: Sequence[str] | None = None, **options: Any) -> argparse.Namespace:
    """Options of a command line by name: default, help, and choices if any.

    A default that is a tuple takes several values, False is a switch; types are those of the defaults.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, (default, text, *choices) in options.items():
        flag = f"--{name.replace('_', '-')}"
        if default is False:
            parser.add_argument(flag, action="store_true", help=text)
            continue
        many = (
            {"nargs": "*", "type": type(default[0])}
            if isinstance(default, tuple)
            else {"type": type(default)}
        )
        parser.add_argument(flag, default=default, help=text, choices=choices[0] if choices else None, **many)
    return parser.parse_args(arguments)


def flat(results: Mapping[Any, Any], prefix: str = "") -> dict[str, float]:
    """Nested results as one mapping, names joined by points; what is not finite is left out."""
    out: dict[str, float] = {}
    for name, value in results.items():
        if isinstance(value, Mapping):
            out |= flat(value, f"{prefix}{name}.")
        elif math.isfinite(value):
            out[f"{prefix}{name}"] = value
    return out


def table(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """A table as text: numbers to three significant digits at the right, a dash for None."""
    texts = [[*columns], *([_text(cell) for cell in row] for row in rows)]
    widths = [max(len(text) for text in column) for column in zip(*texts, strict=True)]
    lines = ["  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in texts]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def rms(values: ArrayLike) -> float:
    """Root mean square of numbers."""
    return float(np.sqrt(np.mean(np.square(values))))


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


def plot_curves(
    name: str,
    *plots: tuple[str, str, ArrayLike, Curves],
    style: str = "-",
    folder: Path = OUT,
    **settings: Any,
) -> Path:
    """Plot curves side by side as out/NAME.png; returns the file.

    Args:
        name: Of the file.
        plots: Labels of abscissa and ordinate, abscissa (n,), and curves (n,) or (n, k) by name.
        style: Of all curves.
        folder: Of the file.
        settings: Of all axes, such as `yscale`.
    """
    figure, axes = new_plot(len(plots))
    for axis, (xlabel, ylabel, x, curves) in zip(axes, plots, strict=True):
        for label, values in curves.items():
            at, shown = values if isinstance(values, tuple) else (x, values)
            axis.plot(at, shown, style, label=label or None)
        axis.set(xlabel=xlabel, ylabel=ylabel, **settings)
        if any(curves):
            axis.legend(fontsize=8)
    path = save_plot(figure, name, folder)
    print(f"plot: {path}")
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
