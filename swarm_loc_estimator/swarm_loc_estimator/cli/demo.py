"""Play a bag of five simulated e-pucks into the live graph over DDS, and check the poses.

    demo
    demo bags/eight_five_robots --rate 1 --out out/demo

It prints the error table and ends with status 1 if the errors exceed the limits of this bag.
The report (report.txt, report.html, overview.png, paths.png, errors.png) and the nodes' output (nodes.log)
are in --out.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

import numpy as np

from swarm_loc_estimator.common import command_line as cli
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.command_line import argument, command
from swarm_loc_estimator.common.launch import GraphOptions
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.nodes.playback import clock_step_ns
from swarm_loc_estimator.offline import live_run
from swarm_loc_estimator.offline.report.report import REPORT_FILES, write_report
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Status
from swarm_loc_estimator.watch.server import free_port

BAG = Path("bags/eight_five_robots")
RATE = 3.0
_REPORT = cli.folder_to_write(*REPORT_FILES, "*.log")

# Limits of the bag of the demo, where the errors are 3 mm, 1.2 degrees and NEES 3.
_POSITION_M = 0.010
_HEADING_DEG = 3.0
_NEES = (1.5, 6.0)
_COVERAGE = 0.95
_GAP_NS = 200_000_000

_REDRAW_S = 0.2
_REDRAW_UNWATCHED_S = 5.0


@command(
    __doc__,
    argument("bag", nargs="?", type=Path, default=BAG, help=f"what to play (default: {BAG})"),
    argument("--rate", type=cli.number_in(0.1, 100.0), default=RATE, help=f"speed (default: {RATE:g})"),
    argument("--out", type=_REPORT, default="out/demo", help="folder for the report"),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    swarm_file = cli.swarm_beside(options.bag)
    progress = _Progress(load_swarm(swarm_file))
    print(f"Playing {options.bag} at {options.rate:g} x into the live graph", flush=True)
    port = free_port()
    print(f"Watch it live: http://127.0.0.1:{port}/", flush=True)
    bag, rate = str(options.bag), options.rate
    graph = GraphOptions(str(swarm_file), bag=bag, rate=rate, watch=True, watch_port=port)
    live = live_run.play_live(graph, log=options.out / "nodes.log", watch=progress)
    progress.close()
    compared = live_run.compare_with_replay(live, options.bag)
    files = write_report(live.result, options.out)
    print(files.text.read_text(encoding="utf-8"))
    print("\n".join(live_facts(live, compared)))
    print(f"\nReport:  {files.page}\nPicture: {files.overview}")
    failures = failed_bars(live)
    for failure in failures:
        print(failure, file=sys.stderr)
    return 1 if failures else 0


def live_facts(live: live_run.LiveRun, compared: live_run.Agreement) -> list[str]:
    """Performance of the live graph, in words."""
    # the time of reception is known to a step of /clock
    age_s = float(np.percentile(live.age_s, 95)) + 1e-9 * clock_step_ns(live.rate)
    live_line = (
        f"Live:    {live.received} of {live.sent} messages received;"
        f" {len(live.result.stamp_ns)} poses of all robots, 95 % of them less than {1e3 * age_s:.0f} ms old;"
        f" {live.estimator_core:.2f} of a core"
    )
    replay_line = (
        f"Replay:  the same bag offline gives poses {1e3 * compared.rms_m:.2f} mm from these (RMS);"
        f" {compared.equal_share:.0%} are equal, the others lack what was just on its way"
    )
    return [live_line, replay_line]


def failed_bars(live: live_run.LiveRun) -> list[str]:
    """One sentence for each limit that the poses exceed."""
    result, row, failures = live.result, live.result.overall, []
    heading_deg, share = math.degrees(row.heading_rmse), coverage(live)
    states = zip(result.swarm.robots, result.status[-1], strict=True)
    waiting = [robot.name for robot, status in states if status != Status.TRACKED]
    if not row.position_rmse < _POSITION_M:
        failures.append(f"Position RMSE is {row.position_rmse:.4f} m, not below {_POSITION_M} m.")
    if not heading_deg < _HEADING_DEG:
        failures.append(f"Heading RMSE is {heading_deg:.2f} deg, not below {_HEADING_DEG} deg.")
    if not _NEES[0] <= row.nees <= _NEES[1]:
        failures.append(f"NEES is {row.nees:.2f}, not within {_NEES[0]} to {_NEES[1]}.")
    if waiting:
        failures.append(f"Not tracked at the end: {', '.join(waiting)}.")
    if not share > _COVERAGE:
        failures.append(f"Only {share:.1%} of the ground truth has a pose, not {_COVERAGE:.0%}.")
    return failures


def coverage(live: live_run.LiveRun) -> float:
    """Share of the ground truth that has an estimated pose."""
    result = live.result
    tracks = ((result.track(result.swarm.index_of[name]), truth) for name, truth in result.truth.items())
    there = [interpolate(track, truth.stamp_ns, _GAP_NS)[1] for track, truth in tracks]
    return float(np.concatenate(there).mean()) if there else 0.0


class _Progress:
    """Shows the progress of the bag: one line in a terminal, a few lines in a log."""

    def __init__(self, swarm: Swarm) -> None:
        self._swarm = swarm
        self._in_terminal = sys.stdout.isatty()
        self._said_s = 0.0

    def __call__(self, recorder: live_run.Recorder, content: live_run.BagContent) -> None:
        pause_s = _REDRAW_S if self._in_terminal else _REDRAW_UNWATCHED_S
        if time.monotonic() < self._said_s + pause_s:
            return
        self._said_s = time.monotonic()
        line = self._line(recorder, content)
        print(f"\r{line}\x1b[K" if self._in_terminal else f"{line}\n", end="", flush=True)

    def close(self) -> None:
        if self._in_terminal:
            print()

    def _line(self, recorder: live_run.Recorder, content: live_run.BagContent) -> str:
        poses = live_run.read_poses(recorder.raw[-1])
        at_s = (poses.stamp_ns - content.begin_ns) * 1e-9
        tracked = int(np.sum(poses.status == Status.TRACKED))
        errors = []
        for index, robot in enumerate(self._swarm.robots):
            if robot.name in content.truth:
                truth, _ = interpolate(content.truth[robot.name], np.array([poses.stamp_ns]), _GAP_NS)
                errors.append(se2.between(truth[0], poses.pose[index])[:2])
        squares = np.sum(np.array(errors).reshape(-1, 2) ** 2, axis=1)
        squares = squares[np.isfinite(squares)]
        rms = f", error {1e3 * math.sqrt(float(np.mean(squares))):4.1f} mm" if squares.size else ""
        total_s = (content.end_ns - content.begin_ns) * 1e-9
        return f"  {at_s:5.1f} of {total_s:.1f} s, {tracked} of {len(poses.status)} robots tracked{rms}"
