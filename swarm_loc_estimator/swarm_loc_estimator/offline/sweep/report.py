"""The results of a sweep: table.csv in the order of the grid, a plot for each varied value, and a page."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.files import replacing, write_whole
from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.offline.report.plots import SOFT, colour_of, length_unit, save, style
from swarm_loc_estimator.offline.report.report import Table, page_of, picture
from swarm_loc_estimator.offline.sweep.sweep import FIGURES, Line, Sweep
from swarm_loc_estimator.timeline.settings import Settings

Row = Mapping[str, Any]  # Column -> value; None where there is none

_FAILURE = "failure"
_LOG_FROM = 10.0  # Ratio of the greatest to the least value from which their axis is logarithmic
_TICKS = 8  # Maximum number of values that are labelled, and joined by lines
_UNITS = {name: spec.unit for name, spec in number_specs(Settings).items()}
_UNITS["lost"] = "share of the messages"
_WITHOUT_TRUTH = "No ground truth to compare with: the plots show what the estimator itself reports."
_FAILED = "replays failed; the plots are without them."


class Metric(NamedTuple):
    """A column of figures to plot, its title, and its unit."""

    column: str
    title: str
    unit: str


_ERRORS = (
    Metric("position_rmse_m", "position RMSE", "m"),
    Metric("heading_rmse_deg", "heading RMSE", "deg"),
    Metric("nees", "NEES, ideal 3", ""),
)
_REPORTED = (
    Metric("position_sigma_m", "reported sigma of position", "m"),
    Metric("tracked_share", "share of poses TRACKED", "%"),
)


SWEEP_FILES = ("jobs.jsonl", "table.csv", "*.png", "sweep.html")


def rows_of(sweep: Sweep, finished: Mapping[str, Line]) -> list[Row]:
    """The rows of the table, in the order of the grid."""
    rows: list[Row] = []
    for job in sweep.jobs:
        line = finished[job.key]
        figures = {name: line.get("figures", {}).get(name) for name in FIGURES}
        rows.append({**job.cells, **figures, _FAILURE: line.get("reason")})
    return rows


def write_results(rows: Sequence[Row], varied: Sequence[str], folder: Path) -> Path:
    """Write table.csv, a PNG for each varied value, and sweep.html; returns the page.

    The folder must exist; files of the same names are replaced.
    """
    cells = [[*rows[0]], *([_text(value) for value in row.values()] for row in rows)]
    with replacing(folder / "table.csv") as part, part.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(cells)
    judged = any(row["position_rmse_m"] is not None for row in rows)
    pictures = {f"Against {name}": folder / f"{name}.png" for name in varied}
    for name, path in zip(varied, pictures.values(), strict=True):
        draw(rows, name, _ERRORS if judged else _REPORTED, path)
    page = folder / "sweep.html"
    failed = sum(row[_FAILURE] is not None for row in rows)
    remarks = [*([] if judged else [_WITHOUT_TRUTH]), *([f"{failed} {_FAILED}"] if failed else [])]
    remark = "".join(f"<p>{one}</p>" for one in remarks)
    shown = [picture(heading, path) for heading, path in pictures.items()]
    table = f"<h2>All replays</h2>{Table(cells[1:], cells[0]).html()}"
    write_whole(page, page_of("Sweep", ["<h1>Sweep</h1>", remark, *shown, table]))
    return page


def draw(rows: Sequence[Row], by: str, metrics: Sequence[Metric], path: Path) -> None:
    """Plot metrics against one column: a line per bag, the mean over all else, and the span of the seeds."""
    values: list[Any] = list(dict.fromkeys(row[by] for row in rows))
    values = values if isinstance(values[0], str) else sorted(values)
    is_many = len(values) > _TICKS
    bags = list(dict.fromkeys(row["bag"] for row in rows))
    short = len({Path(bag).name for bag in bags}) == len(bags)
    figure = Figure(figsize=(4.2 * len(metrics), 3.6 + 0.2 * ((len(bags) + 2) // 3)))
    for axis, metric in zip(figure.subplots(1, len(metrics), squeeze=False)[0], metrics, strict=True):
        known = [row for row in rows if row[metric.column] is not None]
        scale, unit = _scale(metric, [row[metric.column] for row in known])
        of = _UNITS.get(by, "1")
        style(axis, f"{metric.title}{unit and f' [{unit}]'}", f"{by}{'' if of == '1' else f' [{of}]'}")
        places = _place(axis, values)
        for index, bag in enumerate(bags):
            own = [row for row in known if row["bag"] == bag]
            low, mean, high = scale * _span(
                [[r for r in own if r[by] == one] for one in values], metric.column
            )
            (line,) = axis.plot(
                places, mean, "o" if is_many else "o-", color=colour_of(index), markersize=4, linewidth=1.6
            )
            line.set_label(Path(bag).name if short else bag)
            if not is_many:
                axis.fill_between(places, low, high, color=colour_of(index), alpha=0.18, linewidth=0)
        axis.set_ylim(bottom=0.0)
    note = "means over all other values" + ("" if is_many else "; band: least to greatest mean of the seeds")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=3, frameon=False, fontsize=9)
    figure.suptitle(note, x=0.005, ha="left", fontsize=9, color=SOFT)
    save(figure, path)


def _place(axis: Axes, values: Sequence[Any]) -> list[float]:
    """Where the values are on the horizontal axis, with their ticks."""
    if isinstance(values[0], str):
        axis.set_xticks(range(len(values)), values, rotation=20, ha="right")
        return [float(k) for k in range(len(values))]
    if min(values) > 0.0 and max(values) > _LOG_FROM * min(values):
        axis.set_xscale("log")
        axis.minorticks_off()
    if len(values) <= _TICKS:
        axis.set_xticks(values, [f"{one:g}" for one in values])
    return [float(one) for one in values]


def _scale(metric: Metric, values: Sequence[float]) -> tuple[float, str]:
    """What values are multiplied by to be in a readable unit, and this unit."""
    if metric.unit == "m":
        return length_unit(max(values, default=1.0))
    return (100.0, "%") if metric.unit == "%" else (1.0, metric.unit)


def _span(groups: Sequence[Sequence[Row]], column: str) -> FloatArray:
    """Least, mean and greatest (3, n) of the means that seeds have in each group; NaN for an empty one.

    A row without a seed, since nothing is lost, counts for every seed.
    """
    found: list[tuple[float, ...]] = []
    for rows in groups:
        seeds = {row["seed"] for row in rows} - {None} or {None}
        by_seed = [[row[column] for row in rows if row["seed"] in (seed, None)] for seed in seeds]
        means = [float(np.mean(one)) for one in by_seed if one] or [math.nan]
        found.append((min(means), float(np.mean(means)), max(means)))
    return np.stack([np.array(one) for one in zip(*found, strict=True)])


def _text(value: object) -> str:
    """A value in the table: numbers to six digits, so that processors agree; "" for None."""
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
