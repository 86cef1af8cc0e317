"""Robots that drive at random, and what an overhead camera shows of them, under the paper's conditions.

Aerial self-localization paper, part III: an image every 10 s; speeds of 0.1 to 0.5 unit/s and turns of up
to 20 degrees/s, which change after 0 to 3 s; a robot that meets a wall or another one stops and turns on
the spot, at a random speed that it keeps until the way is free (10 to 20 degrees/s, either way: that is not
printed). The arena's size is not printed, but its scale of about 21.4 pixels per unit is: an image of 640 x
480 pixels shows 30 x 22 units of it. The dense arena has 4 x 4. The noise of a position (0.05 unit) and the
scale's error (2 %) are not printed either; with them the method of the paper has about the printed success
rate (`304ddb9b:bench/aerial/driving.py`).
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.identification.chain import ChainModel, Chains, Scale
from swarm_loc_estimator.identification.picture import Picture, TrackPoint

ComplexArray = NDArray[np.complex128]

PERIOD_S = 10.0
PERIOD_NS = 10_000_000_000
_STEP_S = 0.05
_ROBOT = 0.2  # Distance at which two robots meet [unit]
_MAX_CHANGE_S = 3.0
_TURN = np.radians(20.0)


@dataclass(frozen=True)
class Conditions:
    """Of a world."""

    robots: int = 2  # n
    images: int = 2  # How many
    arena: tuple[float, float] = (30.0, 22.0)  # Width and height of the rectangle [unit]
    sigma: float = 0.05  # Noise of each coordinate of a detection [unit]
    scale_sigma: float = 0.02  # By what share the scale is off, one standard deviation; drawn for each world
    detected: float = 1.0  # Share of robots in the picture that are detected
    false_detections: float = 0.0  # Mean number of further detections of an image
    view: float = 1.0  # Share of the arena's width and height, in the middle, that the camera sees
    scale: float = 1.0  # The true scale besides
    drift: float = 0.0  # Standard deviation of the scale's change from image to image


@dataclass(frozen=True)
class World:
    """What was simulated."""

    own: ComplexArray  # (k, n) where each robot is at each image by its own motion, complex [unit]
    own_heading: FloatArray  # (k, n) its heading, zero at first [rad]
    position: ComplexArray  # (k, n) where it truly is
    images: list[ComplexArray]  # Of each the detections (d,), complex
    robot: list[IntArray]  # Of each which robot (d,) every detection is; -1: none

    def place_of(self, robot: int, image: int) -> int:
        """Which detection of an image is a robot; -1: none."""
        found = np.flatnonzero(self.robot[image] == robot)
        return int(found[0]) if found.size else -1

    def track(self, robot: int, image: int) -> TrackPoint:
        """A robot's own track at an image; it has no noise."""
        place = self.own[image, robot]
        pose = np.array([place.real, place.imag, self.own_heading[image, robot]])
        return TrackPoint(pose, np.zeros((3, 3)))


def picture_of(positions: ComplexArray, sigma: float) -> Picture:
    """A picture of detections (d,) without headings."""
    pose = np.column_stack([positions.real, positions.imag, np.zeros(positions.size)])
    covariance = np.tile(np.diag([sigma**2, sigma**2, 1.0]), (positions.size, 1, 1))
    return Picture(pose, covariance, np.zeros(positions.size, dtype=bool))


def simulate(conditions: Conditions, rng: np.random.Generator) -> World:
    """A world."""
    truth, own, heading = _drive(conditions, rng)
    images, robots = [], []
    scale = conditions.scale * (1.0 + conditions.scale_sigma * rng.standard_normal())
    half = 0.5 * np.array(conditions.arena) * conditions.view
    for place in truth:
        seen = (np.abs(place.real) <= half[0]) & (np.abs(place.imag) <= half[1])
        seen &= rng.uniform(size=place.size) < conditions.detected
        false = rng.uniform(-half, half, (rng.poisson(conditions.false_detections), 2)) @ [1.0, 1.0j]
        noise = rng.normal(0.0, conditions.sigma, (seen.sum(), 2)) @ [1.0, 1.0j]
        found = np.concatenate([scale * place[seen] + noise, scale * false])
        which = np.concatenate([np.flatnonzero(seen), np.full(false.size, -1)])
        order = rng.permutation(found.size)
        images.append(found[order])
        robots.append(which[order])
        scale *= 1.0 + conditions.drift * rng.standard_normal()
    return World(own, heading, truth, images, robots)


def _drive(conditions: Conditions, rng: np.random.Generator) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """True places, own places and own headings (k, n) at the images."""
    n, half = conditions.robots, 0.5 * np.array(conditions.arena)
    place = (rng.uniform(-half, half, (n, 2)) @ [1.0, 1.0j]).astype(np.complex128)
    start = rng.uniform(-np.pi, np.pi, n)
    own, heading = np.zeros(n, dtype=complex), np.zeros(n)
    speed, turn, left_s = np.zeros(n), np.zeros(n), np.zeros(n)
    blocked = np.zeros(n, dtype=bool)
    kept = [(place.copy(), own.copy(), heading.copy())]
    steps = round(PERIOD_S / _STEP_S)
    for step_number in range(1, (conditions.images - 1) * steps + 1):
        changing = (left_s <= 0.0) & ~blocked
        count = int(changing.sum())
        speed[changing] = rng.uniform(0.1, 0.5, count)
        turn[changing] = rng.uniform(-_TURN, _TURN, count)
        left_s[changing] = rng.uniform(0.0, _MAX_CHANGE_S, count)
        heading += _STEP_S * turn
        step = _STEP_S * speed * np.exp(1j * heading)
        there = place + step * np.exp(1j * start)
        before = blocked
        blocked = (np.abs(there.real) > half[0]) | (np.abs(there.imag) > half[1]) | _meets(place, there)
        turn = np.where(
            blocked & ~before, rng.choice([-1.0, 1.0], n) * rng.uniform(0.5, 1.0, n) * _TURN, turn
        )
        step[blocked] = 0.0
        own += step
        place = np.where(blocked, place, there)
        left_s -= _STEP_S
        if step_number % steps == 0:
            kept.append((place.copy(), own.copy(), heading.copy()))
    truth, mine, headings = (np.array(column) for column in zip(*kept, strict=True))
    return truth, mine, headings


def _meets(place: ComplexArray, there: ComplexArray) -> np.typing.NDArray[np.bool_]:
    """Which robots would come closer to another one that they meet."""
    now = np.abs(place[:, None] - place[None, :])
    then = np.abs(there[:, None] - place[None, :])
    return np.asarray(((then < _ROBOT) & (then < now)).any(axis=1))


SWARMS = (2, 5, 10, 20, 50)  # Sizes of swarms for which everything is measured
_NORMAL_95 = 1.959964


class Rate(NamedTuple):
    """A share of trials."""

    successes: int  # How many
    trials: int  # Of how many

    @property
    def share(self) -> float:
        """Of successes."""
        return self.successes / self.trials

    @property
    def interval(self) -> tuple[float, float]:
        """That of 95 % confidence, after Wilson (1927)."""
        squared = _NORMAL_95**2
        middle = (self.successes + 0.5 * squared) / (self.trials + squared)
        variance = self.share * (1.0 - self.share) * self.trials + 0.25 * squared
        half = _NORMAL_95 * math.sqrt(variance) / (self.trials + squared)
        return max(0.0, middle - half), min(1.0, middle + half)


@dataclass
class Results:
    """What was measured."""

    rates: dict[str, Rate] = field(default_factory=dict)  # By the name of the figure
    values: dict[str, float] = field(default_factory=dict)  # Other figures by name

    def count(self, name: str, successes: int, trials: int) -> None:
        """Note a success rate, and tell of it."""
        self.rates[name] = rate = Rate(successes, trials)
        low, high = rate.interval
        print(f"{name}: {100.0 * rate.share:.1f} % ({100.0 * low:.1f} - {100.0 * high:.1f})", flush=True)

    def figures(self) -> dict[str, float]:
        """All figures, flat; rates with the ends of their intervals."""
        out = dict(self.values)
        for name, rate in self.rates.items():
            out[name] = rate.share
            out[f"{name}_low"], out[f"{name}_high"] = rate.interval
        return out


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


_SURE = 0.99
_ROBOTS_PER_WORLD_CALIBRATION = 4
_BINS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0 + 1e-12)


class Reliability(NamedTuple):
    """Answers by their probabilities."""

    probability: FloatArray  # (a,) of each best answer
    right: BoolArray  # (a,) whether it was

    def binned(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean probability, share of right answers and count of each bin that is not empty."""
        which = np.digitize(self.probability, _BINS) - 1
        counts = np.bincount(which, minlength=len(_BINS) - 1)
        some = counts > 0
        mean = np.bincount(which, self.probability, len(_BINS) - 1)[some] / counts[some]
        share = np.bincount(which, self.right, len(_BINS) - 1)[some] / counts[some]
        return mean, share, counts[some].astype(float)


def measure_calibration(results: Results, worlds: int, seed: int) -> Reliability:
    """Best answers after each image but the first, by what the estimator assumes by default."""
    rng = np.random.default_rng([seed, 7])
    probability, right = [], []
    for _ in range(worlds):
        conditions = _drawn(rng)
        model = ChainModel(scale=Scale(1.0, 0.02), scale_drift=conditions.drift / np.sqrt(PERIOD_NS * 1e-9))
        world = simulate(conditions, rng)
        for robot in range(min(conditions.robots, _ROBOTS_PER_WORLD_CALIBRATION)):
            for k, chains in enumerate(followed(world, robot, conditions, model)):
                found = chains.probabilities
                if k and found.size:
                    probability.append(float(found.max()))
                    right.append(int(found.argmax()) == world.place_of(robot, k))
    reliability = Reliability(np.array(probability), np.array(right))
    sure = reliability.probability >= _SURE
    results.count("calibration.right_share_at_99", int(reliability.right[sure].sum()), int(sure.sum()))
    results.values["calibration.answered_share_at_99"] = float(sure.mean())
    return reliability


def _drawn(rng: np.random.Generator) -> Conditions:
    """Any conditions: few robots and many, all in the picture and not, missed, false, drifting."""
    return Conditions(
        robots=int(rng.integers(2, 31)),
        images=int(rng.integers(3, 8)),
        arena=[(30.0, 22.0), (10.0, 10.0), (5.0, 5.0)][rng.integers(3)],
        detected=float(rng.uniform(0.85, 1.0)),
        false_detections=float(rng.choice([0.0, 0.3, 1.5])),
        view=float(rng.choice([1.0, 1.0, 0.75])),
        drift=float(rng.choice([0.0, 0.005])),
    )
