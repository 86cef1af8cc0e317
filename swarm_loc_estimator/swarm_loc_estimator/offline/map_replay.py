"""Replay a bag through the mapper, message by message as it runs live; errors and a picture of its map."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.mapper_feed import MapperFeed, inputs_of
from swarm_loc_estimator.mapping.settings import MapperSettings
from swarm_loc_estimator.offline.recorded_bag import TruthReader, mounts_of_bag, renamed_topics
from swarm_loc_estimator.offline.report.plots import save
from swarm_loc_estimator.swarm.swarm import Swarm

_REPORT_EVERY = 1000


class ReplayedMap(NamedTuple):
    """What a bag has given."""

    mapper: CooperativeMapper  # After a last optimization
    feed: MapperFeed  # With the counts of used inputs
    mounts: list[str]  # A sentence for each mount that only transforms say


def replay_map(
    bag: Path,
    swarm: Swarm,
    settings: MapperSettings,
    frequencies: Mapping[str, float],
    progress: Callable[[float, str], None],
    remap: Mapping[str, str] = MappingProxyType({}),
) -> ReplayedMap:
    """Map a bag, with mounts by its static transforms where the description says none.

    The bag has `<robot>/odom`, `<robot>/laser` and, if frequencies of LEDs by robot [Hz] are given,
    `<robot>/lights`; of robots with a lidar `<robot>/scan`. `progress` is called now and then with the share
    done and what is being done. `remap` is as in `renamed_topics`. Raises UserError if the bag cannot be
    read, a topic cannot be mapped, or the robots cannot start.
    """
    source = {
        f"{robot.name}/{kind.topic}": (k, kind)
        for k, robot in enumerate(swarm.robots)
        for kind in inputs_of(robot, lights=True)
    }
    mounts = mounts_of_bag(bag, swarm, remap, source)
    mapper = CooperativeMapper(settings)
    feed = MapperFeed(mounts.described().robots, mapper, frequencies)
    with BagReader(bag, renamed_topics(remap, swarm, source)) as reader:
        for number, (topic, message_type, _, data) in enumerate(reader.messages(source)):
            robot, kind = source[topic]
            if message_type == kind.message_type:
                feed.add(robot, kind, data)
            else:
                feed.drops["other_type"] += 1
            if number % _REPORT_EVERY == 0:
                progress(reader.progress, "mapping")
    mapper.finish()
    return ReplayedMap(mapper, feed, mounts.remarks())


def truth_of(bag: Path, swarm: Swarm) -> dict[str, Trajectory]:
    """Ground truth of a bag by robot, for evaluation only; empty without any."""
    with BagReader(bag) as reader:
        truth = TruthReader(swarm, reader.topics)
        for batch in reader.batches(truth.topics):
            truth.add(batch)
    return truth.tracks()


COVERED_M = 0.06  # A piece of wall is covered if a cell within this distance is occupied [m]
_SPACING_M = 0.01


class MapFigures(NamedTuple):
    """Quality of a map; NaN without ground truth or floor plan."""

    stops: int  # Number of stops with ground truth
    position_m: float  # RMS position error of these stops
    heading_rad: float  # RMS heading error of these stops
    wall_m: float  # Mean distance of occupied cells from the nearest wall
    coverage: float  # Share of the walls with an occupied cell nearby

    def sentence(self) -> str:
        """The figures as a sentence."""
        parts = []
        if self.stops:
            parts.append(
                f"{self.stops} stops within {100.0 * self.position_m:.1f} cm and"
                f" {math.degrees(self.heading_rad):.2f} deg RMS"
            )
        if not math.isnan(self.coverage):
            parts.append(f"{100.0 * self.coverage:.0f} % of the walls, {100.0 * self.wall_m:.1f} cm off")
        return "; ".join(parts)


def map_figures(mapper: CooperativeMapper, truth: Mapping[int, Trajectory], walls: FloatArray) -> MapFigures:
    """Compare the map and the stops of a mapper with true trajectories in map, by the index of the robot.

    `walls` (S, 4) are segments x0, y0, x1, y1 of the floor plan [m], if any.
    """
    # estimated minus true poses (n, 3) of the stops that have ground truth
    errors = [np.zeros((0, 3))]
    for stop, begin_ns in mapper.begin_ns.items():
        if (track := truth.get(int(mapper.graph.robot[stop]))) is not None:
            pose, known = interpolate(track, np.array([begin_ns]), DEFAULT_GAP_NS)
            errors.append((mapper.graph.states[stop, :3] - pose)[known])
    off = np.concatenate(errors)
    off[:, 2] = wrap_angle(off[:, 2])
    position = math.sqrt(np.mean(np.square(off[:, :2]).sum(axis=1))) if len(off) else math.nan
    heading = math.sqrt(np.mean(np.square(off[:, 2]))) if len(off) else math.nan
    # distances between occupied cells and walls
    occupancy = mapper.occupancy()
    cells = occupancy.centres(occupancy.occupied)
    if not len(walls) or not len(cells):
        return MapFigures(len(off), position, heading, math.nan, math.nan)
    pieces = []  # points in the middle of equal pieces of walls
    for x0, y0, x1, y1 in walls:
        count = max(1, math.ceil(math.hypot(x1 - x0, y1 - y0) / _SPACING_M))
        share = ((np.arange(count) + 0.5) / count)[:, None]
        pieces.append(np.array([x0, y0]) + share * np.array([x1 - x0, y1 - y0]))
    points = np.concatenate(pieces)
    wall = float(cKDTree(points).query(cells)[0].mean())
    coverage = float((cKDTree(cells).query(points)[0] < COVERED_M).mean())
    return MapFigures(len(off), position, heading, wall, coverage)


_WIDTH_IN = 9.0
_PIXELS = 1500  # Cells of a picture along a side from which some are left out


def draw_map(
    occupancy: OccupancyMap, stops: FloatArray, walls: FloatArray, path: Path, title: str = ""
) -> Path:
    """Draw the probability of cells, stops (k, 3) and walls (S, 4) to a PNG; returns it."""
    low = occupancy.corner
    high = low + occupancy.cell * np.array(occupancy.log_odds.shape)
    width, height = high - low
    figure = Figure(figsize=(_WIDTH_IN, max(2.0, _WIDTH_IN * height / width)))
    axes = figure.add_subplot()
    every = max(1, max(occupancy.log_odds.shape) // _PIXELS)
    extent = (low[0], high[0], low[1], high[1])
    shown = occupancy.log_odds[::every, ::every].T
    axes.imshow(shown, origin="lower", extent=extent, cmap="gray_r", vmin=-5.0, vmax=5.0)
    segments = [wall.reshape(2, 2) for wall in walls]
    axes.add_collection(LineCollection(segments, colors="C0", linewidths=1.0, alpha=0.7))
    axes.plot(stops[:, 0], stops[:, 1], ".", color="C3", markersize=3.0)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title or f"{len(stops)} stops")
    save(figure, path)
    return path
