"""The tables and the plot of the MRCLAM benchmark."""

from __future__ import annotations

import itertools
from collections.abc import Collection
from pathlib import Path

from matplotlib.axes import Axes

from bench.mrclam.jobs import MODELS, ONLINE, SMOOTHER, Results
from bench.shared.common import new_plot, save_plot, table, write_figures

COLUMNS = ("odometry", "landmarks", ONLINE, "unknown_start", SMOOTHER, "blind_robots")
FIGURES = ("position_rmse_m", "heading_rmse_deg", "nees", "misleading_share")
PUBLISHED = (
    ("CoLo centralized EKF", 0.099),
    ("CoLo best decentralized", 0.107),
    ("CoLo covariance intersection", 0.131),
)
"""Mean position error over the first 600 s of set 2 [m]: CoLo toolbox (see README)."""
_CASES_LABELLED = 4


def report(results: Results, sets: Collection[int]) -> None:
    """Print the tables, draw the plot and write the figures."""
    figures = results.figures
    rows = [
        [f"set {number} {model}", *(_cell(results, (number, model, column)) for column in COLUMNS)]
        for number, model in itertools.product(sets, MODELS)
    ]
    print("\nposition RMSE [m] / heading RMSE [deg] / NEES (ideal 3) / misleading [%]")
    print(table(["", *COLUMNS], rows))
    for (number, model, column), why in sorted(results.failures.items()):
        print(f"set {number} {model}, {column} failed: {why}")
    print("\nmean position error [m] over the first 600 s, landmarks + robots")
    print(table(["", "m"], [[*row] for row in beside_published(results.early)]))
    for number in sets:
        print(f"set {number}: replay {figures[f'set{number}.replay.speed_factor']:.0f} x real time")
    print(f"plot: {draw(results, sets)}")
    print(f"figures: {write_figures('mrclam', figures)}")


def beside_published(early: dict[tuple[int, str], float]) -> list[tuple[str, float]]:
    """Mean errors by name, ours and published ones."""
    ours = [(f"ours, set {k}, {model}", value) for (k, model), value in sorted(early.items())]
    return ours + [(f"{name}, set 2", value) for name, value in PUBLISHED]


def _cell(results: Results, key: tuple[int, str, str]) -> str:
    number, model, column = key
    if key in results.failures:
        return "failed"
    values = [results.figures.get(f"set{number}.{model}.{column}.{name}") for name in FIGURES]
    if values[0] is None:
        return "-"
    values[3] = None if values[3] is None else 100.0 * values[3]
    formats = ("{:.4f}", "{:.2f}", "{:.1f}", "{:.2f}")
    return "/".join("-" if v is None else f.format(v) for f, v in zip(formats, values, strict=True))


def draw(results: Results, sets: Collection[int]) -> Path:
    """Plot errors and NEES by column, and ours beside published errors; returns the file."""
    figure, axes = new_plot(5, width=5.8, height=4.4)
    labels = ("position RMSE [m]", "heading RMSE [deg]", "NEES", "misleading share")
    for axis, name, label in zip(axes, FIGURES, labels, strict=False):
        _bars(axis, results.figures, list(itertools.product(sets, MODELS)), name)
        axis.set_ylabel(label)
    for axis in axes[:2]:
        axis.set_yscale("log")
    axes[0].legend(fontsize=8)
    axes[2].axhspan(2.0, 5.0, color="0.93", zorder=0)
    axes[2].axhline(3.0, color="0.5", linestyle=":")
    rows = beside_published(results.early)[::-1]
    colours = ["0.6" if "CoLo" in name else "tab:blue" for name, _ in rows]
    bars = axes[4].barh([name for name, _ in rows], [value for _, value in rows], color=colours)
    axes[4].bar_label(bars, fmt="%.3f", fontsize=8)
    axes[4].set_xlabel("mean position error, first 600 s [m]")
    return save_plot(figure, "mrclam")


def _bars(axis: Axes, figures: dict[str, float], cases: list[tuple[int, str]], name: str) -> None:
    """Plot a group of bars per column, one per set and model; plain ones are pale."""
    width = 0.84 / len(cases)
    numbers = sorted({number for number, _ in cases})
    for place, (number, model) in enumerate(cases):
        found = [(x, figures.get(f"set{number}.{model}.{column}.{name}")) for x, column in enumerate(COLUMNS)]
        there = [(x + (place - 0.5 * (len(cases) - 1)) * width, v) for x, v in found if v is not None]
        bars = axis.bar(
            [x for x, _ in there],
            [v for _, v in there],
            width,
            color=f"C{numbers.index(number)}",
            alpha=0.45 if model == MODELS[0] else 1.0,
            label=f"set {number}, {model}",
        )
        if len(cases) <= _CASES_LABELLED:
            axis.bar_label(bars, fmt="{:.3g}", fontsize=6, rotation=90, padding=2)
    axis.margins(y=0.12)
    axis.set_xticks(range(len(COLUMNS)), [column.replace("_", "\n") for column in COLUMNS], fontsize=8)
