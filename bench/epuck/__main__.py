"""The e-puck paper's experiments on simulated worlds, many seeds each.

    make bench-epuck
    make bench-epuck ARGS="--worlds 24"

W0 has the printed sigmas as white noise. W2 has hidden systematic errors that together look like the paper's
experiment: unknown yaw and scale of every camera, a badly surveyed map, late stamps, turns that slip. There
"paper" is the paper's own filter (closest stored state, printed sigmas, no gate), and "selfcal" estimates
yaw, scale, slip and the map along with the poses. Errors are those of poses ten times a second as they come
out, while sightings are still 150-300 ms late.
"""

import math
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import numpy as np

from bench.scenarios.eight_run import EightSettings, simulate_eight
from bench.scenarios.lived_run import SimulatedRun
from bench.shared.common import Cell, new_plot, options_of, save_plot, table, write_figures
from bench.shared.simulated_run import errors_of, mean_nees, run_core, ticks
from swarm_loc_drivers.sim.worlds import W0, W2, W2_FAST, ErrorModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.settings import Settings

SLOW, FAST = 0.06, 0.08
W0_SEEDS, WORLDS, FAST_WORLDS = 6, 24, 8
SETTLING_S = 10.0
LAPS_S = 108.0
PAPER_STATE_PERIOD_S = 1.0 / 7.5
_PROCESSES = 2

_ASIDE_M, _ASIDE = 0.3, 0.5
"""How far from the optical axis markers are [m], [rad] in the worse half of a picture.

A focal length that is not known stretches distances, which is estimated, but also moves what is aside.
"""

PAPER = {"w2.paper.robots1": (2.90, 1.86), "w2.paper.robots5": (2.02, 1.56)}
"""Mean errors [cm], [deg] that the paper reports for its robots, one and five (section VI)."""

Prepare = Callable[[Swarm], Swarm]


@dataclass(frozen=True)
class Case:
    """One row of the report."""

    name: str  # Of its figures
    robots: int  # How many drive the eight
    seeds: int  # Of the worlds
    world: ErrorModel  # Hidden imperfections
    speed: float = SLOW  # [m/s]
    filter: str = "white"  # How the swarm is described and what the estimator does, of `FILTERS`


@dataclass(frozen=True)
class Outcome:
    """Mean errors of one world: position [cm], heading [deg], and NEES."""

    position_cm: float
    heading_deg: float
    nees: float


def as_described(swarm: Swarm) -> Swarm:
    """The swarm as the world describes it."""
    return swarm


def papers_own(swarm: Swarm) -> Swarm:
    """The paper's settings: printed sigmas, k_s = 2e-4 m for each wheel (errata, reading A), no gate."""
    robots = (
        replace(
            robot,
            odometry=replace(robot.odometry, wheel_noise=2e-4),
            sensor=replace(robot.sensor, gate_probability=1.0),
        )
        for robot in swarm.robots
    )
    return replace(swarm, robots=tuple(robots))


def self_calibrating(swarm: Swarm) -> Swarm:
    """A description with the sizes of the systematic errors, not their values."""
    landmarks = (replace(mark, position_sigma=0.02, yaw_sigma=0.03) for mark in swarm.landmarks)
    return Swarm(tuple(_self_calibrating(robot) for robot in swarm.robots), tuple(landmarks))


def _self_calibrating(robot: Robot) -> Robot:
    camera, spread_s = robot.camera, W2.exposure_early_s
    return replace(
        robot,
        faces=tuple(replace(face, position_sigma=W2.face_position_sigma) for face in robot.faces),
        odometry=replace(robot.odometry, turn_scale_sigma=0.1, distance_scale_sigma=0.01),
        camera=camera and replace(camera, yaw_sigma=0.03),
        sensor=replace(
            robot.sensor,
            forward_sigma=0.01,
            left_sigma=0.01,
            heading_sigma=0.12,
            distance_scale_sigma=0.03,
            residual_position_sigma=W2.scale_sigma * _ASIDE_M,
            residual_heading_sigma=W2.scale_sigma * _ASIDE,
            time_offset_s=-0.5 * spread_s,
            time_sigma_s=spread_s / math.sqrt(12.0),
        ),
    )


FILTERS: dict[str, tuple[Prepare, Settings]] = {
    "white": (as_described, Settings()),
    "paper": (papers_own, Settings(max_fault_score=1e9)),
    "selfcal": (self_calibrating, Settings()),
}


def cases(worlds: int) -> list[Case]:
    """All cases, long ones first."""
    rows = [
        Case(f"{name}.{kind}.robots{robots}", robots, count, world, speed, kind)
        for name, world, speed, count in (
            ("w2", W2, SLOW, worlds),
            ("w2fast", W2_FAST, FAST, min(worlds, FAST_WORLDS)),
        )
        for robots in (5, 1)
        for kind in ("paper", "selfcal")
    ]
    return rows + [Case(f"w0.robots{robots}", robots, min(worlds, W0_SEEDS), W0) for robots in (5, 1)]


def simulate(case: Case, seed: int) -> SimulatedRun:
    """Simulate a world of a case."""
    run = simulate_eight(EightSettings(seed, LAPS_S, case.robots, case.speed, case.world))
    prepare = FILTERS[case.filter][0]
    run = replace(run, swarm=prepare(run.swarm))
    if case.filter == "paper":  # images belong to the closest stored state
        frames, period_ns = run.frames.copy(), round(PAPER_STATE_PERIOD_S * 1e9)
        frames["stamp_ns"] = (frames["stamp_ns"] + period_ns // 2) // period_ns * period_ns
        run = replace(run, frames=frames)
    return run


def outcome(task: tuple[Case, int]) -> tuple[str, Outcome]:
    """Run a case in one world."""
    case, seed = task
    run = simulate(case, seed)
    stamp_ns = ticks(run)
    result = run_core(run, stamp_ns, FILTERS[case.filter][1])
    settled = stamp_ns >= run.start_ns + SETTLING_S * 1e9
    errors, covariances = errors_of(result.poses, run, stamp_ns)[settled], result.covariances[settled]
    located = ~np.isnan(errors[..., 0])
    errors, covariances = errors[located], covariances[located]
    return case.name, Outcome(
        100.0 * float(np.mean(np.hypot(errors[:, 0], errors[:, 1]))),
        float(np.degrees(np.mean(np.abs(errors[:, 2])))),
        mean_nees(errors, covariances),
    )


def measure(rows: Sequence[Case]) -> dict[str, list[Outcome]]:
    """Run all cases in all their worlds, with a line of progress."""
    tasks = [(case, seed) for case in rows for seed in range(1, case.seeds + 1)]
    results: dict[str, list[Outcome]] = {case.name: [] for case in rows}
    with ProcessPoolExecutor(_PROCESSES, get_context("spawn")) as pool:
        for done, (name, one) in enumerate(pool.map(outcome, tasks), start=1):
            results[name].append(one)
            print(f"\r{done} of {len(tasks)} runs, {name:24}", end="", flush=True)
    print()
    return results


def report(results: dict[str, list[Outcome]]) -> dict[str, float]:
    """Print the table, draw the plot, and return the figures."""
    rows: list[list[Cell]] = []
    figures: dict[str, float] = {}
    for name, ones in results.items():
        position = np.array([one.position_cm for one in ones])
        values = {
            "position_cm": float(position.mean()),
            "heading_deg": float(np.mean([one.heading_deg for one in ones])),
            "nees": float(np.mean([one.nees for one in ones])),
        }
        figures |= {f"{name}.{key}": value for key, value in values.items()}
        low, high = np.percentile(position, [10, 90])
        paper_cm, paper_deg = PAPER.get(name, (None, None))
        rows.append(
            [
                name,
                len(ones),
                values["position_cm"],
                f"{low:.2f}-{high:.2f}",
                paper_cm,
                values["heading_deg"],
                paper_deg,
                values["nees"],
            ]
        )
    head = ["case", "worlds", "position cm", "10-90 %", "paper cm", "heading deg", "paper deg", "NEES"]
    print(table(head, rows))
    draw(results)
    return figures


def draw(results: dict[str, list[Outcome]]) -> None:
    """Plot the errors of every world by case."""
    figure, axes = new_plot(2, width=6.4, height=4.4)
    names = list(results)
    for k, (axis, key) in enumerate(zip(axes, ("position_cm", "heading_deg"), strict=True)):
        for row, name in enumerate(names):
            values = [getattr(one, key) for one in results[name]]
            axis.plot(values, np.full(len(values), row), ".", color="C0", alpha=0.6)
            axis.plot(np.mean(values), row, "D", color="C1")
            if name in PAPER:
                axis.plot(PAPER[name][k], row, "|", color="C3", markersize=18, markeredgewidth=2)
        axis.set(
            xlabel=f"mean {key}: one dot per world, diamond: all, bar: the paper's robots", xlim=(0, None)
        )
        axis.set_yticks(range(len(names)), names if not k else [""] * len(names))
        axis.invert_yaxis()
    print(f"plot: {save_plot(figure, 'epuck')}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = options_of(__doc__, arguments, worlds=(WORLDS, "how many of W2, and at most of the others"))
    rows = cases(options.worlds)
    outcome((replace(rows[-1], robots=2), 1))  # compiles what is not compiled yet
    figures = report(measure(rows))
    print(f"figures: {write_figures('epuck', figures)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
