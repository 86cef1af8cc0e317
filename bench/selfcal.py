"""Calibration without ground truth: fitted to the first half of a recording, replayed on the second.

Real robots (MRCLAM sets, imported without calibration) by `set<k>.imported` and `set<k>.self`. Simulated bags
by their error as a share of that with their own description: calibrated from it (`<bag>.self`), with a wrong
one (`<bag>.wrong`), and calibrated from the wrong one (`<bag>.mended`).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.mrclam.__main__ import DEFAULT_FOLDER
from bench.mrclam.jobs import TICK_S, bag_of, prepare, sums_of
from bench.mrclam.sets import find_sets, load
from bench.shared.common import ProgressLine, table, write_figures
from swarm_loc_estimator.offline.calibration.fit import calibrate
from swarm_loc_estimator.offline.calibration.models import Options
from swarm_loc_estimator.offline.calibration.recording import Recording, rerun, started_at_truth
from swarm_loc_estimator.swarm.swarm import Swarm

_WRONG = 3  # Wrong descriptions of each bag
_BAGS = {"eight": Path("bags/eight_five_robots"), "w2": Path("bags/eight_five_robots_w2")}


def halves(recording: Recording) -> tuple[Recording, Recording]:
    """The first and the second half."""
    first, second = recording.halves_ns
    return recording.between(*first), recording.between(*second)


def errors(recording: Recording, swarm: Swarm) -> dict[str, float]:
    """Figures of the estimator, started at the truth."""
    sums = sums_of(rerun(recording, started_at_truth(swarm, recording), TICK_S).errors)
    return sums.figures if sums is not None else {}


def fitted(recording: Recording, swarm: Swarm, say: ProgressLine) -> tuple[Swarm, float]:
    """The swarm calibrated without ground truth, and the CPU time that it took [s]."""
    begin = time.process_time()
    blind = replace(recording, truth={})
    done = calibrate(blind, swarm, Options(alone=True), lambda share, what: say(f"{share:.0%} {what}"))
    return done.swarm, time.process_time() - begin


def wronged(swarm: Swarm, seed: int) -> Swarm:
    """The swarm with scales off by 5 %, cameras by 5 degrees, odometry by .1 s, noise by a factor of 3."""
    rng = np.random.default_rng(seed)
    path, turn, seen, yaw, late, noise = rng.choice([-1.0, 1.0], 6).tolist()
    more = 3.0**noise
    robots = []
    for robot in swarm.robots:
        o, s, camera = robot.odometry, robot.sensor, robot.camera
        odometry = replace(
            o,
            distance_scale=o.distance_scale + 0.05 * path,
            turn_scale=o.turn_scale + 0.05 * turn,
            delay_s=o.delay_s + 0.1 * late,
            wheel_noise=more * o.wheel_noise,
        )
        sensor = replace(
            s,
            distance_scale=s.distance_scale + 0.05 * seen,
            forward_sigma=more * s.forward_sigma,
            left_sigma=more * s.left_sigma,
            heading_sigma=more * s.heading_sigma,
        )
        camera = camera and replace(camera, yaw=camera.yaw + np.radians(5.0) * yaw)
        robots.append(replace(robot, odometry=odometry, sensor=sensor, camera=camera))
    return replace(swarm, robots=tuple(robots))


def simulated(name: str, bag: Path) -> dict[str, float]:
    """Figures of a bag whose description is right, as it is and made wrong."""
    recording, swarm = load(bag)
    first, second = halves(recording)
    right = errors(second, swarm)["position_rmse_m"]

    def ratio(one: Swarm) -> float:
        return errors(second, one)["position_rmse_m"] / right

    found = {f"{name}.self.ratio_to_described": ratio(fitted(first, swarm, ProgressLine(name))[0])}
    wrong = [wronged(swarm, seed) for seed in range(_WRONG)]
    found[f"{name}.wrong.ratio_to_described"] = max(map(ratio, wrong))
    mended = [ratio(fitted(first, one, ProgressLine(f"{name}, wrong {k}"))[0]) for k, one in enumerate(wrong)]
    return found | {f"{name}.mended.ratio_to_described": max(mended)}


def main() -> None:
    """Measure, print the table, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="*", type=int, default=[2, 3], help="numbers of MRCLAM sets")
    arguments = parser.parse_args()
    figures: dict[str, float] = {}
    found = find_sets(DEFAULT_FOLDER)
    for number in arguments.sets:
        prepare(number, found[number])
        recording, swarm = load(bag_of(number))
        first, second = halves(recording)
        own, cpu_s = fitted(first, swarm, ProgressLine(f"set {number}"))
        for name, one in (("imported", swarm), ("self", own)):
            figures |= {f"set{number}.{name}.{key}": value for key, value in errors(second, one).items()}
        figures[f"set{number}.self.cpu_s"] = cpu_s
    for name, bag in _BAGS.items():
        figures |= simulated(name, bag)
    print(table(("figure", "value"), list(figures.items())))
    print(write_figures("selfcal", figures))


if __name__ == "__main__":
    main()
