"""Make the map of a bag with laser distances, or scans of lidars, and odometry, and draw it.

    replay_map recording --out out/hall
    replay_map recording --swarm swarm.yaml --walls walls.csv --led pushbot1=1000 --led pushbot2=1050

The swarm description is the `swarm.yaml` inside the bag's folder unless --swarm names another. The map goes
to OUT/map.yaml and OUT/map.pgm, a picture of it to OUT/map.png, the robots' stops to OUT/stops.csv. Mounts of
lidars that the description does not say come from the bag's static transforms. The same bag gives the same
files, byte for byte. Loops, refused and late scans, odometry that scans contradict, and places where the map
is in doubt are printed. --walls draws a floor plan below the map (x0,y0,x1,y1 [m] per line) and prints the
errors of the map's walls; with ground truth in the bag, the errors of the stops, too.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from swarm_loc_estimator.common import command_line as cli
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.command_line import argument, command
from swarm_loc_estimator.common.files import replacing
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.messages import led_frequencies
from swarm_loc_estimator.mapping.settings import MapperSettings
from swarm_loc_estimator.offline.map_replay import draw_map, map_figures, replay_map, truth_of
from swarm_loc_estimator.swarm.swarm_file import load_swarm

_MAP = cli.folder_to_write("map.*", "stops.csv")
_CONTRADICTED = 0.02  # Share of contradicted stops from which odometry is named


@command(
    __doc__,
    cli.add_bag,
    cli.add_remap,
    argument("--out", type=_MAP, default="out/map", help="folder for map and picture"),
    argument("--walls", type=Path, help="floor plan to draw below the map: x0,y0,x1,y1 a line"),
    argument("--led", action="append", default=[], metavar="ROBOT=HZ", help="frequency of LEDs"),
    partial(cli.add_set, what="a number of the mapper; may be given several times"),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    settings = cli.parameters_of(MapperSettings, options.set)
    swarm = load_swarm(options.swarm or cli.swarm_beside(options.bag))
    walls = read_walls(options.walls) if options.walls else np.zeros((0, 4))
    frequencies = led_frequencies(options.led, swarm.index_of)
    with cli.ProgressLine() as progress:
        mapper, feed, mounts = replay_map(options.bag, swarm, settings, frequencies, progress, options.remap)
    if not mapper.graph.count:
        missing = ", ".join(feed.missing()) or "the topics"
        print(f"There is no map: nothing usable came on {missing}.", file=sys.stderr)
        return 1
    path, image = save_map(mapper.occupancy(), options.out / "map")
    numbers = ((feed.number(index), robot.name) for index, robot in enumerate(swarm.robots))
    name_of = {number: name for number, name in numbers if number is not None}
    tracks = truth_of(options.bag, swarm)
    truth = {number: tracks[name] for number, name in name_of.items() if name in tracks}
    figures = map_figures(mapper, truth, walls).sentence()
    title = f"{mapper.graph.count} stops" + (f"\n{figures}" if figures else "")
    picture = draw_map(mapper.occupancy(), mapper.graph.poses, walls, options.out / "map.png", title)
    write_stops(mapper, name_of, options.out / "stops.csv")
    for reason, count in (feed.all_drops + feed.dropped_beams).items():
        print(f"dropped: {count} {reason}")
    for sentence in (*mounts, *feed.late, *findings(mapper, name_of)):
        print(sentence)
    print(figures or "nothing to compare with: no ground truth in the bag, no --walls")
    print(f"{mapper.graph.count} stops; map: {path}, {image}; picture: {picture}")
    return 0


def findings(mapper: CooperativeMapper, name_of: Mapping[int, str]) -> Iterator[str]:
    """Sentences on loops, refused scans, contradicted odometry, and places where the map is in doubt."""
    counts, graph = mapper.counters, mapper.graph
    loops = f"loops: {counts['loops_closed']} closed, {counts['loops_taken_back']} taken back"
    yield f"{loops}; scans refused: {counts['scans_refused']} of {counts['scans']}"
    contradicted = np.array(mapper.sweeps.contradicted, dtype=int)
    for number, name in name_of.items():
        mine = contradicted[graph.robot[contradicted] == number]
        count = int((graph.robot[: graph.count] == number).sum())
        if len(mine) > _CONTRADICTED * count:
            x, y = graph.states[mine[0], :2]
            what = f"scans contradict its odometry at {len(mine)} of {count} stops"
            yield f"{name}: {what}, first at x {x:.1f} m, y {y:.1f} m"
    for x, y in mapper.sweeps.doubts():
        yield f"the map is in doubt near x {x:.1f} m, y {y:.1f} m: scans do not agree there"


def read_walls(path: Path) -> FloatArray:
    """Walls (S, 4) from lines x0,y0,x1,y1 [m]; raises UserError if the file is no such table."""
    try:
        walls = np.loadtxt(path, delimiter=",", ndmin=2)
    except OSError as error:
        raise UserError(f"The walls '{path}' cannot be read: {error.strerror or error}.") from error
    except ValueError:
        walls = np.full((1, 4), np.nan)
    if walls.ndim != 2 or walls.shape[1] != 4 or not np.isfinite(walls).all():
        raise UserError(f"'{path}' is no table of x0,y0,x1,y1.")
    return walls


def write_stops(mapper: CooperativeMapper, name_of: Mapping[int, str], path: Path) -> None:
    """Write the stops of the robots: robot, time, x, y, theta on arrival."""
    robots = mapper.graph.robot[: mapper.graph.count].tolist()
    with replacing(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["robot", "stamp_ns", "x_m", "y_m", "theta_rad"])
        for stop, (robot, pose) in enumerate(zip(robots, mapper.graph.poses.tolist(), strict=True)):
            writer.writerow([name_of[robot], mapper.begin_ns.get(stop, ""), *pose])
