"""The report of a replay: a table, pictures, and one page with all of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from swarm_loc_estimator.offline.report.html import html_report
from swarm_loc_estimator.offline.report.overview import plot_overview
from swarm_loc_estimator.offline.report.plots import plot_errors, plot_paths
from swarm_loc_estimator.offline.report.table import text_report

if TYPE_CHECKING:
    from pathlib import Path

    from swarm_loc_estimator.offline.result import ReplayResult


@dataclass(frozen=True)
class ReportFiles:
    """Where the report lies.

    Attributes:
        text: The table as text.
        page: The self-contained page.
        overview: Picture of the swarm on its map, and of its errors over time.
        paths: Picture of each robot's path; None for one robot or very many.
        errors: Picture of each robot's errors over time; None without ground truth.
    """

    text: Path
    page: Path
    overview: Path
    paths: Path | None
    errors: Path | None


def write_report(result: ReplayResult, folder: Path) -> ReportFiles:
    """Write report.txt, report.html and overview.png; paths.png and errors.png where they say more.

    Args:
        result: What to report.
        folder: Where to; created when missing, files of an earlier report are replaced.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text, page, overview = (folder / name for name in ("report.txt", "report.html", "overview.png"))
    text.write_text(text_report(result), encoding="utf-8")
    plot_overview(result, overview)
    paths, errors = folder / "paths.png", folder / "errors.png"
    pictures = {"Overview": overview}
    for heading, path, plot in (("Paths", paths, plot_paths), ("Errors over time", errors, plot_errors)):
        path.unlink(missing_ok=True)
        if plot(result, path):
            pictures[heading] = path
    page.write_text(html_report(result, pictures), encoding="utf-8")
    return ReportFiles(text, page, overview, pictures.get("Paths"), pictures.get("Errors over time"))
