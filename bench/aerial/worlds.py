"""Robots that drive at random, and what an overhead camera shows of them, under the paper's conditions.

Aerial self-localization paper, part III: an image every 10 s; speeds of 0.1 to 0.5 unit/s and turns of up
to 20 degrees/s, which change after 0 to 3 s; a robot that meets a wall or another one stops and turns on
the spot, at a random speed that it keeps until the way is free (10 to 20 degrees/s, either way: that is not
printed). The arena's size is not printed, but its scale of about 21.4 pixels per unit is: an image of 640 x
480 pixels shows 30 x 22 units of it. The dense arena has 4 x 4. The noise of a position (0.05 unit) and the
scale's error (2 %) are not printed either; with them the method of the paper has about the printed success
rate (`304ddb9b:bench/aerial/driving.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from swarm_loc_estimator.identification.picture import Picture, TrackPoint

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from swarm_loc_estimator.common.arrays import FloatArray, IntArray

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
