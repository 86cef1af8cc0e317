"""The report of a replay: a table, two pictures and one page with all of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from swarm_loc_estimator.io.report_html import html_report
from swarm_loc_estimator.io.report_plots import plot_errors, plot_paths
from swarm_loc_estimator.io.report_table import text_report

if TYPE_CHECKING:
    from pathlib import Path

    from swarm_loc_estimator.replay_result import ReplayResult


@dataclass(frozen=True)
class ReportFiles:
    """Where the report lies.

    Attributes:
        text: The table as text.
        page: The self-contained page.
        paths: Picture of the paths.
        errors: Picture of the errors over time; None without ground truth.
    """

    text: Path
    page: Path
    paths: Path
    errors: Path | None


def write_report(result: ReplayResult, folder: Path) -> ReportFiles:
    """Write report.txt, report.html, paths.png and, with ground truth, errors.png.

    Args:
        result: What to report.
        folder: Where to; created when missing, files of an earlier report are replaced.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text, page = folder / "report.txt", folder / "report.html"
    paths, errors = folder / "paths.png", folder / "errors.png"
    errors.unlink(missing_ok=True)
    text.write_text(text_report(result), encoding="utf-8")
    plot_paths(result, paths)
    pictures = {"Paths": paths}
    if plot_errors(result, errors):
        pictures["Errors over time"] = errors
    page.write_text(html_report(result, pictures), encoding="utf-8")
    return ReportFiles(text, page, paths, pictures.get("Errors over time"))
