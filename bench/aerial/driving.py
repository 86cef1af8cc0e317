"""Random motion: chains over images, also in a dense arena."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bench.aerial.rates import SWARMS, Results
from bench.aerial.worlds import PERIOD_NS, Conditions, World, picture_of, simulate
from swarm_loc_estimator.identification.chain import ChainModel, Chains, Scale

_PAPERS = ChainModel(detection_probability=0.999, absent=1e-3, entering=1e-3, false_detections=0.01)
"""All robots are on each image, and nothing else."""
_UNKNOWN = replace(_PAPERS, scale=Scale(1.0, 0.5))
"""The scale anywhere from a half to one and a half, more or less."""
_ROBOTS_PER_WORLD = 5
_DENSE = (7, 9, 13)  # Numbers of images of the dense arena; the last one makes the figure


def measure(results: Results, worlds: int, seed: int) -> None:
    """All success rates of random motion; robots of one world share the error of its scale."""
    for n in SWARMS:
        _chained(results, n, max(10, worlds // 2), np.random.default_rng([seed, 4, n]))
    for images in _DENSE:
        conditions = Conditions(SWARMS[-1], images, (4.0, 4.0))
        rng = np.random.default_rng([seed, 5, images])
        right, trials, _ = _rate(conditions, _PAPERS, max(10, worlds // 5), rng)
        name = "dense.n50.last_picture.success"
        results.count(
            name if images == _DENSE[-1] else f"dense.n50.images{images}.last_picture.success", right, trials
        )


def _chained(results: Results, n: int, worlds: int, rng: np.random.Generator) -> None:
    """Four images with the scale known and not, five for the largest swarm."""
    right, trials, spent_us = _rate(Conditions(n, 4), _PAPERS, worlds, rng)
    results.count(f"chained4.n{n}.success", right, trials)
    results.values[f"chained4.n{n}.us_per_robot_picture"] = spent_us
    conditions = Conditions(n, 4, scale_sigma=0.2)
    results.count(f"random.n{n}.scale_unknown.success", *_rate(conditions, _UNKNOWN, worlds, rng)[:2])
    if n == SWARMS[-1]:
        results.count(f"chained5.n{n}.success", *_rate(Conditions(n, 5), _PAPERS, worlds, rng)[:2])


def _rate(
    conditions: Conditions, model: ChainModel, worlds: int, rng: np.random.Generator
) -> tuple[int, int, float]:
    """How many robots find themselves in the last image, of how many, and the time per image [us]."""
    right, trials, spent_s = 0, 0, 0.0
    for _ in range(worlds):
        world = simulate(conditions, rng)
        for robot in range(min(conditions.robots, _ROBOTS_PER_WORLD)):
            begin_s = time.process_time()
            *_, chains = followed(world, robot, conditions, model)
            spent_s += time.process_time() - begin_s
            right += int(np.argmax(chains.probabilities)) == world.place_of(robot, conditions.images - 1)
            trials += 1
    return right, trials, 1e6 * spent_s / trials / conditions.images


def followed(world: World, robot: int, conditions: Conditions, model: ChainModel) -> Iterator[Chains]:
    """The chains of a robot after each image of a world."""
    chains = Chains(model)
    for k, positions in enumerate(world.images):
        picture = picture_of(positions, conditions.sigma)
        chains = chains.advanced(picture, world.track(robot, k), k * PERIOD_NS)
        yield chains
