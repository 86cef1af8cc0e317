"""The tracker of blinking lights on simulated events: how far off, how sure, how fast."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from bench.shared.common import Cell, new_plot, rms, save_plot, table
from swarm_loc_drivers.sim.pushbot.event_camera import Blinking, CameraEvents, CameraNoise, EventCamera, Spot
from swarm_loc_drivers.sim.pushbot.optics import spot_brightness
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.event_encoding import Events
from swarm_loc_vision.events.tracker import LightSource, LightTracker, TrackerSettings

NOISES = (0.0, 1.0, 5.0, 15.0, 30.0)  # Noise events of a pixel [1/s]; the bar is at 15
BAR_NOISE = 15.0
DEPTHS_M = (0.3, 0.6, 1.0, 1.5, 2.0, 2.5)
SIZE = (128, 128)
_STEP_US, _STEPS = 5_000, 200
_LASER, _LED = Blinking(2222, 1111), Blinking(1000, 500)
SOURCES = (LightSource(450.0, is_above=False), LightSource(1000.0, is_above=True))
_SKIPPED = 5  # Windows in which a light is found at first


class Scene(NamedTuple):
    """A second of events with a laser spot that wanders slowly, and an LED."""

    events: list[CameraEvents]  # Of each step
    stamps_us: FloatArray  # (K,) middles of the steps [us]
    places: FloatArray  # (K, 2) true places of the spot there [px]


def scene(noise_rate: float, depth: float, seed: int) -> Scene:
    """What an event camera sees of its laser at a depth [m]."""
    rng = np.random.default_rng(seed)
    camera = EventCamera(CameraNoise(noise_rate=noise_rate), rng, seed)
    place = np.array([50.0, 75.0]) + 25.0 * rng.random(2)
    velocity = rng.uniform(-4.0, 4.0, 2)
    events, stamps, places = [], [], []
    for step in range(_STEPS):
        begin = 1_000_000 + step * _STEP_US
        after = place + velocity * _STEP_US * 1e-6
        spots = [
            Spot((place[0], place[1]), (after[0], after[1]), spot_brightness(depth), _LASER),
            Spot((40.0, 50.0), (40.0, 50.0), 20.0, _LED),
        ]
        events.append(camera.look(begin, begin + _STEP_US, spots, np.zeros((0, 3))))
        stamps.append(begin + 0.5 * _STEP_US)
        places.append(0.5 * (place + after))
        place = after
    return Scene(events, np.array(stamps), np.array(places))


def packet(seen: CameraEvents) -> Events:
    """Emulated events as the tracker takes them."""
    return Events(seen.x.astype(np.uint16), seen.y.astype(np.uint16), seen.polarity == 0, 1000 * seen.time_us)


class Score(NamedTuple):
    """How the tracker did on a scene: rms per axis [px], NEES (ideal 2), share of windows with the spot."""

    rms: float
    nees: float
    seen: float


def score(seen: Scene) -> Score:
    """Track a scene and hold the laser's places against the truth at their stamps."""
    tracker = LightTracker(SOURCES, SIZE, TrackerSettings())
    errors, nees, windows = [], [], 0
    for one in seen.events:
        for report in tracker.track(packet(one)):
            windows += 1
            for sighting in report.sightings:
                if windows <= _SKIPPED or sighting.source != 0:
                    continue
                truth = [np.interp(1e-3 * sighting.stamp_ns, seen.stamps_us, axis) for axis in seen.places.T]
                wrong = np.array([sighting.u, sighting.v]) - truth
                errors.append(wrong)
                nees.append(float(wrong @ np.linalg.solve(sighting.covariance, wrong)))
    share = len(errors) / max(1, windows - _SKIPPED)
    if not errors:
        return Score(float("nan"), float("nan"), 0.0)
    return Score(rms(errors), float(np.mean(nees)), share)


def throughput(seed: int, sources: int) -> float:
    """Events that the default tracker takes in a second of one core, in packets of 5 ms [1/s]."""
    seen = scene(BAR_NOISE, 0.7, seed)
    lights = [SOURCES[0], *(LightSource(700.0 + 30.0 * k, is_above=True) for k in range(sources - 1))]
    packets = [packet(one) for one in seen.events]
    rates = []
    for _ in range(3):
        tracker = LightTracker(lights, SIZE, TrackerSettings())
        begin_s = time.process_time()
        for one in packets:
            tracker.track(one)
        rates.append(sum(len(one.x) for one in packets) / (time.process_time() - begin_s))
    return max(rates)


def measure_tracker(seeds: int) -> dict[str, float]:
    """Figures of the trackers; prints tables and draws them.

    Args:
        seeds: Scenes of each kind.
    """
    by_noise = [_pooled([score(scene(noise, 0.77, seed)) for seed in range(seeds)]) for noise in NOISES]
    by_depth = [
        _pooled([score(scene(BAR_NOISE, depth, 100 + seed)) for seed in range(seeds)]) for depth in DEPTHS_M
    ]
    rates = {
        count: float(np.median([throughput(seed, count) for seed in range(seeds)])) for count in (1, 2, 11)
    }
    rows: list[list[Cell]] = [[noise, *one] for noise, one in zip(NOISES, by_noise, strict=True)]
    print(table(["noise/s/pixel, 0.77 m", "rms [px]", "NEES (ideal 2)", "share seen"], rows))
    depth_rows: list[list[Cell]] = [[d, *one] for d, one in zip(DEPTHS_M, by_depth, strict=True)]
    print(table(["depth [m], 15 noise/s/pixel", "rms [px]", "NEES (ideal 2)", "share seen"], depth_rows))
    rate_rows: list[list[Cell]] = [[count, 1e-6 * rate] for count, rate in rates.items()]
    print(table(["lights", "M events/s"], rate_rows))
    _draw(by_noise, by_depth)
    at_bar = by_noise[NOISES.index(BAR_NOISE)]
    return {
        "tracker.rms_px": at_bar.rms,
        "tracker.nees": at_bar.nees,
        "tracker.worst_depth_rms_px": max(one.rms for one in by_depth),
        "tracker.events_per_s": rates[2],
        "tracker.events_per_s.lights11": rates[11],
    }


def _pooled(scores: list[Score]) -> Score:
    """Of several scenes."""
    rms, nees, seen = np.array(scores).T
    return Score(float(np.sqrt(np.nanmean(rms**2))), float(np.nanmean(nees)), float(seen.mean()))


def _draw(by_noise: list[Score], by_depth: list[Score]) -> None:
    figure, (left, right) = new_plot(2)
    left.plot(NOISES, [one.rms for one in by_noise], marker="o")
    left.axhline(0.15, color="k", ls=":")
    left.set(xlabel="noise events of a pixel [1/s]", ylabel="rms per axis [px]", yscale="log")
    right.plot(DEPTHS_M, [one.rms for one in by_depth], marker="o")
    right.axhline(0.15, color="k", ls=":")
    right.set(xlabel="distance of the wall [m]", ylabel="rms per axis [px]", title="15 noise events/s/pixel")
    print(f"wrote {save_plot(figure, 'pushbot_tracker')}")
