"""Large swarms whose robots are calibrated as they drive: what that costs, and how exact it is.

The grid of `bench.shared.grid`, but each robot's odometry reports its path and its turn by another scale,
its camera is turned, and the landmarks stand beside where the survey has them. All of that is estimated.
Errors of the second half of a run count, of the poses told as tracked.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bench.peers.scaling import second_half
from bench.scenarios.lived_run import Records, SimulatedRun
from bench.shared.common import flat, options_of, plot_by_size, table, write_figures
from bench.shared.grid import GridSettings, simulate_grid
from bench.shared.simulated_run import run_core, ticks
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.settings import Settings

SIZES = (100, 300, 1000)
ROBOT_SECONDS = 12_000.0  # A run of N robots is N-th of this long, and 40 s at most
PATH_SIGMA, TURN_SIGMA, YAW_SIGMA = 0.03, 0.05, 0.03
SURVEY_SIGMA = (0.02, 0.02)  # Of a landmark's place, either way [m], and of its yaw [rad]


def simulate_calibrated(settings: GridSettings) -> SimulatedRun:
    """The grid with systematic errors, and what is told of them."""
    run = simulate_grid(settings)
    rng = np.random.default_rng([settings.seed, 1])
    robots = len(run.swarm.robots)
    scales = 1.0 + np.array([PATH_SIGMA, TURN_SIGMA]) * rng.standard_normal((robots, 2))
    yaw = YAW_SIGMA * rng.standard_normal(robots)
    observer = np.repeat(run.frames["robot"].astype(np.int64), run.frames["count"])
    return replace(
        run,
        swarm=_described(run.swarm, rng),
        odometry=_scaled(run.odometry, scales),
        sightings=_turned(run.sightings, yaw[observer]),
    )


def _described(swarm: Swarm, rng: np.random.Generator) -> Swarm:
    """The swarm with sigmas, and landmarks surveyed beside where they are."""
    errors = rng.standard_normal((len(swarm.landmarks), 3)) * np.array(SURVEY_SIGMA)[[0, 0, 1]]
    marks = tuple(
        replace(
            mark,
            x=mark.x + float(error[0]),
            y=mark.y + float(error[1]),
            yaw=float(mark.yaw or 0.0) + float(error[2]),
            position_sigma=SURVEY_SIGMA[0],
            yaw_sigma=SURVEY_SIGMA[1],
        )
        for mark, error in zip(swarm.landmarks, errors, strict=True)
    )
    return Swarm(tuple(_with_sigmas(robot) for robot in swarm.robots), marks)


def _with_sigmas(robot: Robot) -> Robot:
    odometry = replace(robot.odometry, distance_scale_sigma=PATH_SIGMA, turn_scale_sigma=TURN_SIGMA)
    camera = None if robot.camera is None else replace(robot.camera, yaw_sigma=YAW_SIGMA)
    return replace(robot, odometry=odometry, camera=camera)


def _scaled(odometry: Records, scales: FloatArray) -> Records:
    """Odometry of which path and turn are reported by scales (N, 2)."""
    out: Records = odometry.copy()
    for robot, (path, turn) in enumerate(scales):
        rows = np.flatnonzero(odometry["robot"] == robot)
        rows = rows[np.argsort(odometry["stamp_ns"][rows], kind="stable")]
        poses = odometry["pose"][rows].astype(float)
        twists = se2.log(se2.between(poses[:-1], poses[1:])) / np.array([path, path, turn])
        for k, twist in enumerate(twists, 1):
            poses[k] = se2.compose(poses[k - 1], se2.exp(twist))
        out["pose"][rows] = poses
    return out


def _turned(sightings: Records, yaw: FloatArray) -> Records:
    """What cameras that are turned by angles (S,) see."""
    out: Records = sightings.copy()
    mount = np.column_stack([np.zeros((len(yaw), 2)), yaw])
    out["value"] = se2.between(mount, sightings["value"])
    return out


def measure(robots: int, seed: int) -> dict[str, float]:
    """CPU time of a run, and the figures of its second half."""
    run = simulate_calibrated(GridSettings(robots, seed, min(40.0, ROBOT_SECONDS / robots)))
    return second_half(run, Settings())


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    options = options_of(
        __doc__, arguments, robots=(SIZES, "swarm sizes"), seeds=((1, 2), "of the simulation")
    )
    warm_up = simulate_calibrated(GridSettings(robots=300, duration_s=2.0))
    run_core(warm_up, ticks(warm_up), Settings())  # compiles what is not compiled yet, or loads it
    results = {f"seed{seed}": {n: measure(n, seed) for n in options.robots} for seed in options.seeds}
    rows = [[seed, n, *one.values()] for seed, found in results.items() for n, one in found.items()]
    print(table(["seed", "robots", *next(iter(results["seed" + str(options.seeds[0])].values()))], rows))
    shown = {"cpu_s_per_s": "CPU seconds per second", "nees": "NEES"}
    print(f"plot: {plot_by_size('calibrated', results, shown, 'calibrated robots', '')}")
    sized = {f"n{n}": {seed: found[n] for seed, found in results.items()} for n in options.robots}
    print(f"figures: {write_figures('calibrated', flat(sized))}")


if __name__ == "__main__":
    main()
