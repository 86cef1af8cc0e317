"""Text report of a replay: error table, self-calibration, counters."""

from __future__ import annotations

import math
from collections.abc import Mapping

from swarm_loc_estimator.offline.metrics import ErrorSummary
from swarm_loc_estimator.offline.result import ReplayResult

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

POOLED = "all"


def summaries(result: ReplayResult) -> list[tuple[str, ErrorSummary]]:
    """Name and errors of each robot with ground truth, and of all together."""
    return [*result.summaries.items(), (POOLED, result.overall)] if result.errors else []


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
            rows.append([robot.name, *(_estimated(*figure) for figure in figures)])
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
    """Sizes, durations and speed by name."""
    rows = {
        "robots": str(len(result.swarm.robots)),
        "landmarks": str(len(result.swarm.landmarks)),
        "poses": str(len(result.stamp_ns)),
        "duration of the data": f"{result.data_s:.1f} s",
    }
    if math.isfinite(result.speed_factor):
        rows["duration of the run"] = f"{result.wall_s:.2f} s, {result.speed_factor:.0f} x real time"
    return rows


def text_report(result: ReplayResult) -> str:
    """The whole report as text."""
    lines = [result.title, "=" * len(result.title), ""]
    lines += _pairs(facts(result))
    rows = summaries(result)
    if rows:
        lines += ["", *_table([cells(name, row) for name, row in rows])]
    else:
        lines += ["", "No ground truth to compare with."]
    robots = self_calibrated_robots(result)
    if robots:
        head = "Self-calibration, with one standard deviation"
        lines += ["", head, *_columns([list(SELF_CALIBRATED), *robots])]
    lines += ["", self_calibrated_landmarks(result)] if self_calibrated_landmarks(result) else []
    if result.counters:
        lines += ["", "Counters", *_pairs(result.counters)]
    if result.remarks:
        lines += ["", *result.remarks]
    return "\n".join(lines) + "\n"


def _number(value: float, digits: int) -> str:
    """A number, or a dash for NaN."""
    if math.isnan(value):
        return "-"
    return f"{value:.{digits}f}"


def _estimated(value: float, sigma: float, digits: int) -> str:
    """A number with its standard deviation; a dash if it was not estimated."""
    return f"{value:.{digits}f} ± {sigma:.{digits}f}" if sigma else "-"


def _columns(rows: list[list[str]]) -> list[str]:
    """Aligned columns."""
    widths = [max(len(text) for text in column) for column in zip(*rows, strict=True)]
    return [_line(row, widths) for row in rows]


def _pairs(rows: Mapping[str, object]) -> list[str]:
    """One line per name and value."""
    width = max(map(len, rows), default=0)
    return [f"  {name:<{width}}  {value}" for name, value in rows.items()]


def _table(rows: list[list[str]]) -> list[str]:
    """Aligned columns under their titles, the pooled row set apart."""
    titles = [name for name, _ in HEADER]
    units = [f"[{unit}]" if unit else "" for _, unit in HEADER]
    widths = [max(len(text) for text in column) for column in zip(titles, units, *rows, strict=True)]
    groups, start = [], 0
    for name, count in GROUPS:
        groups.append(f"{name:<{sum(widths[start : start + count]) + 2 * (count - 1)}}")
        start += count
    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    body = [_line(row, widths) for row in rows]
    return [
        "  ".join(groups).rstrip(),
        _line(titles, widths),
        _line(units, widths),
        rule,
        *body[:-1],
        rule,
        body[-1],
    ]


def _line(texts: list[str], widths: list[int]) -> str:
    """One line: names to the left, numbers to the right."""
    first = f"{texts[0]:<{widths[0]}}"
    return "  ".join(
        [first, *(f"{text:>{width}}" for text, width in zip(texts[1:], widths[1:], strict=True))]
    ).rstrip()
