"""Figures, table and pictures of the runs in rendered worlds."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from bench.epuck.rendered import WORLD, RenderedRun, run_rendered
from bench.epuck.seen import Seen, count_seen
from bench.graph.listener import starting_swarm
from bench.shared.common import OUT, Cell, ProgressLine, new_plot, save_plot, table
from swarm_loc_drivers.sim.worlds import WORLDS
from swarm_loc_estimator.offline.metrics import ErrorSummary
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.report.plots import INK, colour_of, plot_overview
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.settings import Settings
from swarm_loc_vision.markers.detector import precompile

OUTPUT_NS = 100_000_000
"""Interval of the compared poses, as in the other rows of the benchmark; poses come twice as often."""
_LANDMARK_COLOUR = "#E69F00"
_PICTURE_IN = (12.8, 9.6)
_WIDE_PX = 50.0  # The distance is written below wider markers only

Describe = Callable[[Swarm], Swarm]


@dataclass(frozen=True)
class Rendered:
    """Results of one world."""

    run: RenderedRun  # The recorded run
    seen: Seen  # Statistics of detections
    paper: ReplayResult  # The same data by the filter of the paper


def rendered_worlds(
    seeds: Sequence[int], duration_s: float, describe: Describe, paper: Describe, settings: Settings
) -> list[Rendered]:
    """Run worlds one after the other, with a line of progress.

    Args:
        seeds: Of the worlds.
        duration_s: Of driving [s].
        describe: Changes the swarm description for the estimator of the graph.
        paper: Changes the swarm description for the filter of the paper.
        settings: Of the filter of the paper.

    Raises:
        LiveError: A node has ended, or the graph has stopped.
    """
    precompile()  # once, not in every robot's detector at a time
    swarm, worlds = starting_swarm(WORLDS[WORLD]), []
    for count, seed in enumerate(seeds, start=1):
        folder = OUT / "epuck_rendered" / f"seed{seed}"
        shutil.rmtree(folder, ignore_errors=True)
        say = ProgressLine(f"rendered world {count} of {len(seeds)}")
        run = run_rendered(describe(swarm), seed, duration_s, folder, say)
        say("looking at what was seen")
        papers = replay(run.described_bag, paper(swarm), settings)
        worlds.append(Rendered(run, count_seen(run), papers))
        say("done")
        print()
    return worlds


def errors_within(result: ReplayResult, begin_ns: int, end_ns: int) -> ErrorSummary:
    """Errors ten times a second between two stamps, of all robots."""
    within = (result.stamp_ns >= begin_ns) & (result.stamp_ns <= end_ns) & (result.stamp_ns % OUTPUT_NS == 0)
    return result.select(within).overall


def figures_of(one: Rendered, settling_s: float) -> dict[str, float]:
    """The figures of one world; errors after `settling_s`."""
    run, seen = one.run, one.seen
    settled_ns = run.begin_ns + round(settling_s * 1e9)
    live = errors_within(run.live, settled_ns, run.end_ns)
    paper = errors_within(one.paper, settled_ns, run.end_ns)
    detectors_s = sum(used for node, used in run.cpu_s.items() if node.endswith("/marker_detector"))
    arrived = seen.frames - seen.lost
    return {
        "robots5.position_cm": 100.0 * live.position_mean,
        "robots5.heading_deg": float(np.degrees(live.heading_mean)),
        "robots5.nees": live.nees,
        "robots5.paper.position_cm": 100.0 * paper.position_mean,
        "robots5.paper.heading_deg": float(np.degrees(paper.heading_mean)),
        "robots5.recall": seen.found / seen.visible,
        "robots5.false_ids": float(seen.false_ids),
        "robots5.detections_per_frame": seen.detections / arrived,
        "robots5.frames": float(seen.frames),
        "robots5.lost_frames": seen.lost / seen.frames,
        "robots5.cpu_ms_per_frame": 1e3 * detectors_s / arrived,
        "robots5.estimator_cpu": run.cpu_s["estimator"] / run.duration_s,
        "robots5.world_cpu": run.cpu_s["epuck_world"] / run.duration_s,
        "robots5.pose_age_ms": 1e3 * float(np.percentile(run.age_s, 95.0)),
    }


def report(worlds: Sequence[Rendered], settling_s: float) -> dict[str, float]:
    """Print the table, plot the first world, and return the means."""
    figures = [figures_of(one, settling_s) for one in worlds]
    means = {key: float(np.mean([one[key] for one in figures])) for key in figures[0]}
    rows: list[list[Cell]] = [
        [key.removeprefix("robots5."), *(one[key] for one in figures), mean] for key, mean in means.items()
    ]
    print(table(["rendered", *(f"seed {one.run.seed}" for one in worlds), "mean"], rows))
    OUT.mkdir(parents=True, exist_ok=True)
    plot_overview(worlds[0].run.live, OUT / "epuck_rendered.png")
    print(f"plot: {OUT / 'epuck_rendered.png'}")
    if (picture := draw_picture(worlds[0].run)) is not None:
        print(f"plot: {picture}")
    return {f"rendered.{key}": value for key, value in means.items()}


def draw_picture(run: RenderedRun) -> Path | None:
    """Draw the image with the most detections and these on it; None without any."""
    reported = {(name, one.stamp_ns): one.detections for name, seen in run.seen.items() for one in seen}
    shown = [key for key in run.pictures if key in reported]
    if not shown:
        return None
    name, stamp_ns = max(shown, key=lambda key: (len(reported[key]), key))
    message, detections = run.pictures[name, stamp_ns], reported[name, stamp_ns]
    figure, (axes,) = new_plot(1, width=_PICTURE_IN[0], height=_PICTURE_IN[1])
    gray = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width)
    axes.imshow(gray, cmap="gray", vmin=0, vmax=255)
    owners = run.live.swarm.owner_of
    for one in detections:
        owner = owners[int(one["id"])].robot_index
        colour = _LANDMARK_COLOUR if owner < 0 else colour_of(owner)
        _draw_detection(axes, one, colour)
    seconds = (stamp_ns - run.begin_ns) * 1e-9
    axes.set_title(f"what {name} sees after {seconds:.1f} s: {len(detections)} markers read", color=INK)
    axes.set_axis_off()
    names = [(robot.name, colour_of(index)) for index, robot in enumerate(run.live.swarm.robots)]
    meanings = [("landmark", _LANDMARK_COLOUR), *(one for one in names if one[0] != name)]
    handles = [Line2D([], [], color=colour, linewidth=2.4, label=label) for label, colour in meanings]
    axes.legend(handles=handles, loc="lower right", frameon=True, facecolor="white", framealpha=0.9)
    return save_plot(figure, "epuck_rendered_picture")


def _draw_detection(axes: Axes, detection: NDArray[np.void], colour: str) -> None:
    """Draw the outline of a marker, its first corner, its id and its distance."""
    corners = detection["corners_px"].reshape(4, 2)
    axes.add_patch(Polygon(corners, closed=True, fill=False, edgecolor=colour, linewidth=2.0))
    axes.plot(*corners[0], "o", color=colour, markersize=4)
    place = (float(corners[:, 0].mean()), float(corners[:, 1].max()))
    is_wide = np.ptp(corners[:, 0]) > _WIDE_PX
    distance = f"\n{float(detection['position'][2]):.2f} m" if is_wide else ""
    text = axes.annotate(
        f"{int(detection['id'])}{distance}",
        place,
        (0, -6),
        textcoords="offset points",
        ha="center",
        va="top",
        fontsize=10,
        color=colour,
        fontweight="bold",
    )
    text.set_path_effects([withStroke(linewidth=2.5, foreground="black")])
