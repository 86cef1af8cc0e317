"""Linear speed variation: robots that drive straight, at up to 0.1 unit/s, over two intervals of 10 s."""

from __future__ import annotations

import time

import numpy as np

from bench.aerial.paper_methods import ComplexArray, identify_by_speeds
from bench.aerial.rates import SWARMS, Results
from bench.aerial.worlds import PERIOD_S
from swarm_loc_estimator.common.arrays import FloatArray

_SIGMA = 0.025  # Of each coordinate [unit]; with it the printed method has about the printed rate
_SCALE_SIGMA = 0.03
_SPEED = 0.1
_ARENA = (30.0, 22.0)


def measure(results: Results, trials: int, seed: int) -> None:
    """Success rates with direction and scale, all three places right."""
    rng = np.random.default_rng([seed, 2])
    for n in SWARMS:
        count = max(20, trials // max(1, n // 5))
        right, spent_s = 0, 0.0
        for _ in range(count):
            images, speeds = _simulated(rng, n)
            begin_s = time.process_time()
            way = np.concatenate([[0.0], np.cumsum(speeds) * PERIOD_S])
            answer = identify_by_speeds(images, way, _SIGMA, 1.0, _SCALE_SIGMA)
            spent_s += time.process_time() - begin_s
            right += answer == (0, 0, 0)
        results.count(f"linear.n{n}.success", right, count)
        results.values[f"linear.n{n}.us_per_robot_picture"] = spent_s / count / 3 * 1e6


def _simulated(rng: np.random.Generator, robots: int) -> tuple[ComplexArray, FloatArray]:
    """Positions in three images (3, robots), and the first robot's speeds (2,)."""
    start = (rng.uniform(-0.5, 0.5, (robots, 2)) * _ARENA) @ [1.0, 1.0j]
    direction = np.exp(1j * rng.uniform(-np.pi, np.pi, robots))
    speeds = rng.uniform(0.0, _SPEED, (2, robots))
    moved = np.vstack([np.zeros(robots), np.cumsum(speeds, axis=0) * PERIOD_S]) * direction
    noise = rng.normal(0.0, _SIGMA, (3, robots, 2)) @ [1.0, 1.0j]
    scale = 1.0 + _SCALE_SIGMA * rng.standard_normal()
    return scale * (start + moved) + noise, speeds[:, 0]
