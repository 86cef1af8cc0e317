"""Angular variation: robots that turn on the spot by up to 9 degrees/s for 10 s, counter-clockwise."""

from __future__ import annotations

import time

import numpy as np

from bench.aerial.paper_methods import identify_by_turns, turn_misfits
from bench.aerial.rates import SWARMS, Results
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle

_SIGMA = np.radians(1.4)  # Of a heading: the mean deviation of a turn is then 1.6 degrees, as printed
_LARGEST_TURN = np.radians(90.0)
_ROTATIONS = (2, 3, 4)


def measure(results: Results, trials: int, seed: int) -> None:
    """Success rates of one rotation for all swarms, and of more for the largest one."""
    rng = np.random.default_rng([seed, 1])
    for n in SWARMS:
        headings, turns = _simulated(rng, trials, n, 1)
        found = turn_misfits(headings, turns).argmin(axis=-1)
        results.count(f"angular.n{n}.success", int(np.sum(found == 0)), trials)
        begin_s = time.process_time()
        for k in range(200):
            identify_by_turns(headings[k % trials], turns[k % trials])
        results.values[f"angular.n{n}.us_per_robot_picture"] = (time.process_time() - begin_s) / 200 * 1e6 / 2
    for rotations in _ROTATIONS:
        headings, turns = _simulated(rng, trials, SWARMS[-1], rotations)
        found = turn_misfits(headings, turns).argmin(axis=-1)
        name = f"angular.n{SWARMS[-1]}.rotations{rotations}.success"
        results.count(name, int(np.sum(found == 0)), trials)


def _simulated(
    rng: np.random.Generator, trials: int, robots: int, rotations: int
) -> tuple[FloatArray, FloatArray]:
    """Headings (trials, rotations + 1, robots) as measured, the first one's own turns (trials, rotations)."""
    turns = rng.uniform(0.0, _LARGEST_TURN, (trials, rotations, robots))
    start = rng.uniform(-np.pi, np.pi, (trials, 1, robots))
    headings = np.concatenate([start, start + np.cumsum(turns, axis=1)], axis=1)
    noisy = wrap_angle(headings + rng.normal(0.0, _SIGMA, headings.shape))
    return noisy, turns[:, :, 0]
