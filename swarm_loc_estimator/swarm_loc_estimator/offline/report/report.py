"""The report of a replay: text, plots and one self-contained HTML page with a recording to play."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.files import write_whole
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.offline.export import estimates
from swarm_loc_estimator.offline.metrics import ErrorSummary
from swarm_loc_estimator.offline.report.plots import plot_errors, plot_overview, plot_paths
from swarm_loc_estimator.offline.result import RecordedMap, ReplayResult
from swarm_loc_estimator.timeline.estimate import Status
from swarm_loc_estimator.watch.page import (
    Frame,
    about,
    aerial_frame,
    map_frame,
    page,
    places_frame,
    poses_frame,
    recording,
    sightings_frame,
)

HEADER = (
    ("robot", ""),
    ("poses", ""),
    ("rmse", "m"),
    ("mean", "m"),
    ("median", "m"),
    ("95 %", "m"),
    ("max", "m"),
    ("rmse", "deg"),
    ("mean", "deg"),
    ("median", "deg"),
    ("95 %", "deg"),
    ("max", "deg"),
    ("NEES", "ideal 3"),
)
"""Column titles with their units; the first group is position, the second heading."""

GROUPS = (("", 2), ("position", 5), ("heading", 5), ("", 1))
"""Headings over the columns, with the number of columns below each."""


class Table(NamedTuple):
    """Texts under titles, for a terminal and for a page; below groups, the last row is set apart."""

    rows: Sequence[Sequence[str]]
    titles: Sequence[str] = ()
    units: Sequence[str] = ()  # Of the columns, "" for none
    groups: Sequence[tuple[str, int]] = ()  # Headings over the titles, with the number of columns of each

    def text(self) -> list[str]:
        """Lines with aligned columns: names to the left, numbers to the right."""
        units = [[unit and f"[{unit}]" for unit in self.units]] if self.units else []
        shown = [self.titles, *units, *self.rows]
        widths = [max(map(len, column)) for column in zip(*shown, strict=True)]
        lines = []
        for first, *others in shown:
            numbers = [f"{text:>{width}}" for text, width in zip(others, widths[1:], strict=True)]
            lines.append("  ".join([f"{first:<{widths[0]}}", *numbers]).rstrip())
        if not self.groups:
            return lines
        rule, groups, left = "-" * (sum(widths) + 2 * (len(widths) - 1)), [], [*widths]
        for name, count in self.groups:
            groups.append(f"{name:<{sum(left[:count]) + 2 * (count - 1)}}")
            del left[:count]
        return ["  ".join(groups).rstrip(), *lines[:2], rule, *lines[2:-1], rule, lines[-1]]

    def html(self) -> str:
        """The same, which scrolls sideways where it is wide."""
        units = [
            unit and f"<small>[{escape(unit)}]</small>" for unit in self.units or [""] * len(self.titles)
        ]
        titles = zip(self.titles, units, strict=True)
        groups = [f'<th class="group" colspan="{count}">{escape(name)}</th>' for name, count in self.groups]
        heads = [groups, [f"<th>{escape(name)}{unit}</th>" for name, unit in titles]]
        head = "".join(f"<tr>{''.join(cells)}</tr>" for cells in heads if cells)
        rows = ["<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row) + "</tr>" for row in self.rows]
        if groups:
            rows[-1] = rows[-1].replace("<tr>", "<tr class=pooled>", 1)
        above = f"<thead>{head}</thead>" if head else ""
        return f'<div class="wide"><table>{above}<tbody>{"".join(rows)}</tbody></table></div>'


POOLED, SMOOTHED = "all", "all, smoothed"


def summaries(result: ReplayResult) -> list[tuple[str, ErrorSummary]]:
    """Name and errors of each robot with ground truth, of all smoothed ones, and of all together."""
    if not result.errors:
        return []
    later = [(SMOOTHED, result.smoothed.overall)] if result.smoothed is not None else []
    return [*result.summaries.items(), *later, (POOLED, result.overall)]


def cells(name: str, row: ErrorSummary) -> list[str]:
    """A row of the error table, one text per column of `HEADER`."""
    position = (row.position_rmse, row.position_mean, row.position_median, row.position_p95, row.position_max)
    heading = (row.heading_rmse, row.heading_mean, row.heading_median, row.heading_p95, row.heading_max)
    return [
        name,
        str(row.count),
        *(_number(value, 4) for value in position),
        *(_number(math.degrees(value), 2) for value in heading),
        _number(row.nees, 2),
    ]


def _errors(result: ReplayResult) -> Table:
    titles, units = zip(*HEADER, strict=True)
    return Table([cells(name, row) for name, row in summaries(result)], titles, units, GROUPS)


SELF_CALIBRATED = (
    "robot",
    "path, true per reported",
    "turn, true per reported",
    "camera yaw [deg]",
    "distance, measured per true",
)
"""Column titles of the self-calibration of robots."""


def self_calibrated_robots(result: ReplayResult) -> list[list[str]]:
    """The self-calibration of robots, one text per column of `SELF_CALIBRATED`; a dash if not estimated."""
    rows = []
    for robot in result.self_calibrated.robots if result.self_calibrated else ():
        odometry, camera, sensor = robot.odometry, robot.camera, robot.sensor
        figures = [
            (odometry.distance_scale, odometry.distance_scale * odometry.distance_scale_sigma, 4),
            (odometry.turn_scale, odometry.turn_scale * odometry.turn_scale_sigma, 4),
            (math.degrees(camera.yaw), math.degrees(camera.yaw_sigma), 2) if camera else (0.0, 0.0, 2),
            (sensor.distance_scale, sensor.distance_scale * sensor.distance_scale_sigma, 4),
        ]
        if any(sigma for _, sigma, _ in figures):
            said = (f"{value:.{n}f} ± {sigma:.{n}f}" if sigma else "-" for value, sigma, n in figures)
            rows.append([robot.name, *said])
    return rows


def self_calibrated_landmarks(result: ReplayResult) -> str:
    """The self-calibration of landmarks in a sentence; "" if their positions are exact."""
    before = {mark.id: mark for mark in result.swarm.landmarks}
    after = [mark for mark in (result.self_calibrated or result.swarm).landmarks if mark.is_estimated]
    if not result.self_calibrated or not after:
        return ""
    moved = [100.0 * math.hypot(mark.x - before[mark.id].x, mark.y - before[mark.id].y) for mark in after]
    sigma = 100.0 * sum(mark.position_sigma for mark in after) / len(after)
    return (
        f"{len(after)} landmarks are {sum(moved) / len(moved):.1f} cm from their surveyed positions"
        f" (at most {max(moved):.1f} cm), with a standard deviation of {sigma:.1f} cm."
    )


def facts(result: ReplayResult) -> dict[str, str]:
    """Sizes, durations, speed and what is located by name."""
    rows = {
        "robots": str(len(result.swarm.robots)),
        "landmarks": str(len(result.swarm.landmarks)),
        "poses": str(len(result.stamp_ns)),
        "duration of the data": f"{result.data_s:.1f} s",
    }
    tracked = result.status == Status.TRACKED
    if tracked.size:
        known = (tracked & result.heading_known).mean()
        rows["tracked"] = f"{tracked.mean():.1%} of the robots' poses, {known:.1%} with a known heading"
    if math.isfinite(result.speed_factor):
        rows["duration of the run"] = f"{result.wall_s:.2f} s, {result.speed_factor:.0f} x real time"
    return rows


_WITHOUT_TRUTH = "No ground truth to compare with."
_SELF_CALIBRATION = "Self-calibration, with one standard deviation"


def text_report(result: ReplayResult) -> str:
    """The whole report as text."""
    lines = [result.title, "=" * len(result.title), ""]
    lines += _pairs(facts(result))
    lines += ["", *(_errors(result).text() if result.errors else [_WITHOUT_TRUTH])]
    if robots := self_calibrated_robots(result):
        lines += ["", _SELF_CALIBRATION, *Table(robots, SELF_CALIBRATED).text()]
    if marks := self_calibrated_landmarks(result):
        lines += ["", marks]
    if result.counters:
        lines += ["", "Counters", *_pairs(result.counters)]
    if result.remarks:
        lines += ["", *result.remarks]
    return "\n".join(lines) + "\n"


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _pairs(rows: Mapping[str, object]) -> list[str]:
    width = max(map(len, rows), default=0)
    return [f"  {name:<{width}}  {value}" for name, value in rows.items()]


REPORT_FILES = ("report.*", "overview.png", "paths.png", "errors.png")


@dataclass(frozen=True)
class ReportFiles:
    """Files of a report."""

    text: Path  # The table as text
    page: Path  # The self-contained page
    overview: Path  # Plot of the swarm on its map, and of its errors over time
    paths: Path | None  # Plot of each robot's path; None for one robot or more than nine
    errors: Path | None  # Plot of each robot's errors over time; None without ground truth


def write_report(result: ReplayResult, folder: Path | str) -> ReportFiles:
    """Write report.txt, report.html and overview.png, and if applicable paths.png and errors.png.

    The folder is created if missing; files of an earlier report are replaced.
    """
    folder = Path(folder)
    text, page, overview = (folder / name for name in ("report.txt", "report.html", "overview.png"))
    write_whole(text, text_report(result))
    plot_overview(result, overview)
    paths, errors = folder / "paths.png", folder / "errors.png"
    pictures = {"Overview": overview}
    for heading, path, plot in (("Paths", paths, plot_paths), ("Errors over time", errors, plot_errors)):
        if plot(result, path):
            pictures[heading] = path
        else:
            path.unlink(missing_ok=True)
    write_whole(page, html_report(result, pictures))
    return ReportFiles(text, page, overview, pictures.get("Paths"), pictures.get("Errors over time"))


_STYLE = """
:root { color-scheme: light dark; --ink: #22303c; --soft: #66757f; --line: #dfe4e8; --paper: #fff;
  --card: #f6f8fa; --accent: #0072b2; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6edf3; --soft: #9aa7b2; --line: #30363d;
  --paper: #0d1117; --card: #161b22; --accent: #56b4e9; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem clamp(1rem, 4vw, 2.5rem) 4rem; max-width: 1120px;
  background: var(--paper); color: var(--ink); font: 15px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.6rem; margin: 0 0 1rem; }
h2 { font-size: 1.1rem; margin: 2.2rem 0 .7rem; }
.facts { display: flex; flex-wrap: wrap; gap: .7rem; padding: 0; margin: 0; }
.facts div { background: var(--card); border: 1px solid var(--line); border-radius: 8px;
  padding: .55rem .9rem; }
.facts dt { color: var(--soft); font-size: .8rem; }
.facts dd { margin: 0; font-weight: 600; }
.facts .headline dd { color: var(--accent); font-size: 1.25rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .5rem; text-align: right; white-space: nowrap;
  border-bottom: 1px solid var(--line); }
th { color: var(--soft); font-weight: 500; font-size: .85rem; line-height: 1.25; }
th:first-child, td:first-child { text-align: left; padding-left: 0; padding-right: 1rem;
  position: sticky; left: 0; background: var(--paper); }
th.group { text-align: center; color: var(--ink); }
tr.pooled td { font-weight: 650; border-top: 2px solid var(--soft); }
img { display: block; width: 100%; min-width: 42rem; background: #fff;
  border: 1px solid var(--line); border-radius: 8px; }
.player { width: 100%; height: min(75vh, 46rem); border: 1px solid var(--line); border-radius: 8px; }
ul { padding-left: 1.2rem; }
small { display: block; color: var(--soft); }
"""


def html_report(result: ReplayResult, pictures: dict[str, Path]) -> str:
    """One self-contained HTML page, with pictures: heading -> PNG file below it."""
    remarks = "".join(f"<li>{escape(remark)}</li>" for remark in result.remarks)
    run, counters = recorded(result), [[name, str(count)] for name, count in result.counters.items()]
    parts = [
        f"<h1>{escape(result.title)}</h1>",
        _facts(result),
        remarks and f"<h2>Remarks</h2><ul>{remarks}</ul>",
        "<h2>Errors against ground truth</h2>"
        + (_errors(result).html() if result.errors else f"<p>{_WITHOUT_TRUTH}</p>"),
        run and f'<h2>Run</h2><iframe class="player" title="The run" srcdoc="{escape(page(run))}"></iframe>',
        *(picture(heading, path) for heading, path in pictures.items()),
        _self_calibration(result),
        f"<h2>Counters</h2>{Table(counters).html()}" if counters else "",
    ]
    return page_of(result.title, parts)


def page_of(title: str, parts: Sequence[str]) -> str:
    """A page in the style of reports, of parts that are HTML; empty ones are left out."""
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style>"
    )
    body = "\n".join(part for part in parts if part)
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def _facts(result: ReplayResult) -> str:
    cards = [("", *one) for one in facts(result).items()]
    if rows := summaries(result):
        figures = cells(*rows[-1])
        pooled = {"position RMSE": f"{figures[2]} m", "heading RMSE": f"{figures[7]}°", "NEES": figures[12]}
        cards = [*(("headline", *one) for one in pooled.items()), *cards]
    shown = "".join(
        f'<div class="{kind}"><dt>{escape(name)}</dt><dd>{escape(text)}</dd></div>'
        for kind, name, text in cards
    )
    return f'<dl class="facts">{shown}</dl>'


def _self_calibration(result: ReplayResult) -> str:
    rows, sentence = self_calibrated_robots(result), self_calibrated_landmarks(result)
    table = Table(rows, SELF_CALIBRATED).html() if rows else ""
    return f"<h2>{_SELF_CALIBRATION}</h2>{table}<p>{escape(sentence)}</p>" if rows or sentence else ""


def picture(heading: str, path: Path) -> str:
    """A plot embedded in the page."""
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    name = escape(heading)
    return f'<h2>{name}</h2><div class="wide"><img alt="{name}" src="data:image/png;base64,{data}"></div>'


_Thing = TypeVar("_Thing", bound=Frame | RecordedMap)
MAX_BYTES = 12_000_000
"""Of poses and sightings before compression; maps, goals and aerial images have limits of their own."""
_MAP_BYTES, _GOAL_BYTES, _IMAGE_BYTES = 6_000_000, 1_000_000, 2_000_000
_BYTES_PER_FRAME, _BYTES_PER_ROBOT, _BYTES_PER_SIGHTING = 800, 64, 17
_GAP_NS = 500_000_000


def recorded(result: ReplayResult) -> str:
    """The run as text for the page of `watch`, thinned out to `MAX_BYTES`; "" if there is nothing to show."""
    if not len(result.stamp_ns) or not result.swarm.robots:
        return ""
    seen = sum(len(one.observer) for _, one in result.sightings) * _BYTES_PER_SIGHTING
    each = _BYTES_PER_FRAME + _BYTES_PER_ROBOT * len(result.swarm.robots)
    stride = -(-(each * len(result.stamp_ns)) // (MAX_BYTES // 2))
    seen_stride = max(1, -(-seen // (MAX_BYTES // 2)))
    frames = [*map(poses_frame, estimates(result, stride)), *_truth(result, stride)]
    frames += [sightings_frame(stamp_ns, one) for stamp_ns, one in result.sightings[::seen_stride]]
    frames += [map_frame(one.log_ns, one.grid) for one in _thinned(result.maps, _MAP_BYTES)]
    frames += _thinned(_goals(result), _GOAL_BYTES)
    frames += _thinned([aerial_frame(*one) for one in result.images], _IMAGE_BYTES)
    header = about(result.swarm, result.title, commands=False)
    header["losses"] = [[one.robot, one.stamp_ns * 1e-6, one.cause] for one in result.losses]
    return recording(header, sorted(frames, key=lambda frame: frame.stamp_ns))


def _truth(result: ReplayResult, stride: int) -> Iterator[Frame]:
    """The ground truth at the stamps of the poses."""
    stamps_ns = np.asarray(result.stamp_ns[::stride])
    robots = [index for index, one in enumerate(result.swarm.robots) if one.name in result.truth]
    if not robots:
        return
    names = [result.swarm.robots[index].name for index in robots]
    found = [interpolate(result.truth[name], stamps_ns, _GAP_NS) for name in names]
    pose, known = (np.stack([one[part] for one in found], axis=1) for part in (0, 1))
    for k, stamp_ns in enumerate(stamps_ns.tolist()):
        there = np.flatnonzero(known[k])
        yield places_frame("truth", stamp_ns, [robots[i] for i in there], pose[k, there])


def _goals(result: ReplayResult) -> list[Frame]:
    """The goals of all robots whenever one of them changes."""
    index_of, newest = result.swarm.index_of, dict[int, FloatArray]()
    rows = [
        (int(track.stamp_ns[k]), index_of[name], track.pose[k])
        for name, track in result.goals.items()
        for k in range(len(track.stamp_ns))
    ]
    frames = []
    for stamp_ns, robot, pose in sorted(rows, key=lambda row: row[:2]):
        newest[robot] = pose
        frames.append(places_frame("goals", stamp_ns, [*newest], np.array([*newest.values()])))
    return frames


def _thinned(things: Sequence[_Thing], max_bytes: int) -> list[_Thing]:
    """The last of them and others, evenly spaced: as many as would fit, were all as large as the largest."""
    size = max((len(one.data) for one in things), default=1)
    stride: int = max(1, -(-len(things) // max(1, max_bytes // size)))
    kept: list[_Thing] = list(things[::-1][::stride])
    return kept[::-1]
