"""Swarms seen from above for the tests of the core: odometry, and anonymous detections of aerial images."""

from dataclasses import dataclass, replace

import numpy as np
from core_messages import SECOND, T0, Event
from core_world import Plan, World, simulate
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.detections import ANONYMOUS_DTYPE

SIGMA, HEADING_SIGMA = 0.01, 0.1
_STEP_NS = 50_000_000


@dataclass(frozen=True)
class View:
    """What the overhead camera shows."""

    period_s: float = 0.5  # Time between images
    detected: float = 1.0  # Share of the robots detected
    false: float = 0.0  # Mean number of false detections of an image
    headings: bool = False  # Whether the pattern shows the heading
    half: float = 5.0  # Half the width of the square in view [m]
    noise: float = 1.0  # Scale of all noise


@dataclass(frozen=True)
class AerialWorld:
    """A world with its images."""

    world: World  # With the events of the images
    robot: dict[int, IntArray]  # Stamp of an image -> which robot each of its detections is; -1: none


def seen_from_above(plan: Plan, view: View, seed: int) -> AerialWorld:
    """A simulated swarm whose robots see nothing themselves."""
    world = simulate(replace(plan, landmarks=0, reach=0.0), seed)
    rng = np.random.default_rng([seed, 7])
    images, robot = [], {}
    every = round(view.period_s * SECOND / _STEP_NS)
    for k in range(0, world.stamp_ns.size, every):
        shown, which = _image(rng, view, world.truth[k])
        stamp_ns = int(world.stamp_ns[k])
        images.append(Event(-1, stamp_ns, aerial=shown))
        robot[stamp_ns] = which
    events = sorted([*world.events, *images], key=lambda event: event.stamp_ns)
    return AerialWorld(replace(world, events=tuple(events)), robot)


def _image(rng: np.random.Generator, view: View, poses: FloatArray) -> tuple[NDArray[np.void], IntArray]:
    """Detections (d,) of robots at poses (N, 3), and whose they are (d,)."""
    visible = (np.abs(poses[:, :2]).max(axis=1) < view.half) & (rng.uniform(size=len(poses)) < view.detected)
    robots = np.flatnonzero(visible)
    false = np.zeros((rng.poisson(view.false), 3))
    false[:, :2] = rng.uniform(-1.0, 1.0, (len(false), 2))
    noisy = poses[robots] + view.noise * rng.normal(0.0, [SIGMA, SIGMA, HEADING_SIGMA], (robots.size, 3))
    found = np.concatenate([noisy, false])
    which = np.concatenate([robots, np.full(len(false), -1)])
    order = rng.permutation(len(found))
    shown = np.zeros(len(found), dtype=ANONYMOUS_DTYPE)
    shown["x"], shown["y"] = found[order, 0], found[order, 1]
    shown["theta"] = found[order, 2] if view.headings else np.nan
    shown["covariance"] = np.diag([SIGMA**2, SIGMA**2, HEADING_SIGMA**2])
    return shown, which[order]


def seconds(stamp_ns: int) -> float:
    return (stamp_ns - T0) / SECOND
