"""Events of blinking lights for tests, made apart from the emulator: bursts of the pixels around a place."""

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.event_encoding import Events

SIZE = (128, 128)


def light(
    rng: np.random.Generator, place: tuple[float, float], frequency: float, seconds: float, drift: float = 0.0
) -> FloatArray:
    """Rows x, y, on, time [ns] of a light at a place that drifts along its row [px/s]."""
    half_ns = 0.5e9 / frequency
    switch = np.arange(int(2 * frequency * seconds))
    offset = np.arange(-3, 4)
    dx, dy = (grid.ravel() for grid in np.meshgrid(offset, offset))
    u = place[0] + drift * switch * half_ns * 1e-9
    x = np.rint(u)[:, None] + dx
    y = np.broadcast_to(np.rint(place[1]) + dy, x.shape)
    square = (x - u[:, None]) ** 2 + (y - place[1]) ** 2
    count = np.clip(np.floor(4.0 - square + 0.3 * rng.standard_normal(x.shape)), 0, 4).astype(int)
    which = np.repeat(np.arange(count.size), count.ravel())
    within = np.arange(len(which)) - np.repeat(np.cumsum(count.ravel()) - count.ravel(), count.ravel())
    at = switch[which // len(dx)]
    time_ns = at * half_ns + 30_000 + 50_000 * within + rng.normal(0.0, 10_000.0, len(which))
    return np.stack([x.ravel()[which], y.ravel()[which], 1 - at % 2, np.maximum(time_ns, 0.0)])


def noise(rng: np.random.Generator, rate: float, seconds: float) -> FloatArray:
    """Noise events at a rate per pixel and second."""
    count = rng.poisson(rate * SIZE[0] * SIZE[1] * seconds)
    places = rng.integers(0, 128, (2, count))
    return np.stack([*places, rng.integers(0, 2, count), rng.uniform(0.0, seconds * 1e9, count)])


def together(*parts: FloatArray) -> Events:
    """All of them in the order of time."""
    rows = np.concatenate(parts, axis=1)
    rows = rows[:, np.argsort(rows[3], kind="stable")]
    x, y = rows[:2].astype(np.uint16)
    return Events(x, y, rows[2].astype(bool), rows[3].astype(np.int64))
