"""Which markers are seen, what is reported of them, and when it arrives."""

import math
from dataclasses import replace

import numpy as np
import pytest
from exact_sightings import exact_values

from bench.scenarios.eight_run import VIEW, EightSettings, describe, simulate_eight, wall_markers
from bench.scenarios.lived_run import SIGHTING_DTYPE, SimulatedRun
from bench.scenarios.sightings import View, deliver, hidden, schedule_exposures
from swarm_loc_drivers.sim.worlds import W0, W2
from swarm_loc_estimator.common import se2


@pytest.fixture(scope="module")
def white() -> SimulatedRun:
    return simulate_eight(EightSettings(duration_s=30.0, errors=W0))


@pytest.mark.parametrize(
    ("marker", "seen"),
    [
        ((0.5, 0.0, math.pi), True),
        ((0.5, 0.0, 0.0), False),  # its back
        ((0.11, 0.0, math.pi), False),
        ((1.51, 0.0, math.pi), False),
        ((0.5, 0.5 * math.tan(math.radians(29.0)), math.pi), True),
        ((0.5, -0.5 * math.tan(math.radians(31.0)), math.pi), False),
        ((-0.5, 0.0, 0.0), False),  # behind the camera
        ((0.5, 0.0, math.pi + math.radians(64.0)), True),
        ((0.5, 0.0, math.pi - math.radians(66.0)), False),
    ],
)
def test_view(marker: tuple[float, float, float], *, seen: bool) -> None:
    assert bool(VIEW.sees(np.array(marker))) is seen


def test_a_view_of_half_a_turn_sees_everything_in_front() -> None:
    assert View(math.pi, 0.0, 2.0, math.pi).sees(np.array([[0.1, 1.0, 0.0], [-0.1, 1.0, 0.0]])).tolist() == [
        True,
        False,
    ]


@pytest.mark.parametrize(
    ("disc", "is_hidden"),
    [
        ((0.5, 0.03), True),
        ((0.5, 0.04), False),
        ((1.2, 0.0), False),
        ((-0.2, 0.0), False),
        ((np.nan, np.nan), False),
    ],
)
def test_a_disc_hides_only_what_is_behind_it(disc: tuple[float, float], *, is_hidden: bool) -> None:
    assert bool(hidden(np.zeros(2), np.array([1.0, 0.0]), np.array([disc]), 0.036)) is is_hidden


def test_the_arena_has_twenty_markers_that_face_inwards() -> None:
    marks = wall_markers()
    assert len(marks) == 20
    for mark in marks:
        assert mark.yaw is not None
        assert math.cos(mark.yaw) * mark.x + math.sin(mark.yaw) * mark.y < 0.0
        assert abs(mark.x) == pytest.approx(1.2) or abs(mark.y) == pytest.approx(0.8)
    places = np.array([[mark.x, mark.y] for mark in marks])
    around = np.linalg.norm(np.diff(places, axis=0, append=places[:1]), axis=1)
    assert np.isclose(around, 0.4).sum() == 16  # all but the four corners
    np.testing.assert_allclose(around[~np.isclose(around, 0.4)], 0.2 * math.sqrt(2.0))


def test_an_eight_shows_as_many_markers_as_the_papers_geometry_gives(white: SimulatedRun) -> None:
    _, _, own = exact_values(white)
    assert (own < 0).sum() / len(white.frames) == pytest.approx(2.3, abs=0.25)
    assert (own >= 0).sum() / len(white.frames) == pytest.approx(0.85, abs=0.15)


def test_white_noise_has_the_printed_sigmas(white: SimulatedRun) -> None:
    exact, robot, own = exact_values(white)
    error = white.sightings["value"] - exact
    error[:, 2] = se2.wrap_angle(error[:, 2])
    count = len(error)
    sigma = np.array([0.026, 0.029, 0.508])
    assert (np.abs(error.mean(axis=0)) < 4.0 * sigma / math.sqrt(count)).all()
    np.testing.assert_allclose(error.std(axis=0), sigma, rtol=4.0 / math.sqrt(2 * count))
    assert (own != robot).all()  # no robot sees itself
    assert VIEW.sees(exact).all()


def test_flips_mirror_the_heading_at_the_line_of_sight() -> None:
    exactly = replace(W0, forward_sigma=0.0, left_sigma=0.0, heading_sigma=0.0, flip_probability=0.25)
    run = simulate_eight(EightSettings(duration_s=20.0, errors=exactly))
    exact, _, _ = exact_values(run)
    value = run.sightings["value"]
    np.testing.assert_allclose(value[:, :2], exact[:, :2], atol=1e-12)
    towards = np.arctan2(exact[:, 1], exact[:, 0]) + math.pi
    straight = np.isclose(se2.wrap_angle(value[:, 2] - exact[:, 2]), 0.0, atol=1e-9)
    mirrored = np.isclose(se2.wrap_angle(value[:, 2] + exact[:, 2] - 2.0 * towards), 0.0, atol=1e-9)
    assert (straight | mirrored).all()
    assert (~straight).mean() == pytest.approx(0.25, abs=0.03)


def test_gross_errors_come_at_their_rate() -> None:
    rough = replace(W0, forward_sigma=1e-4, left_sigma=1e-4, heading_sigma=1e-4, gross_probability=0.05)
    run = simulate_eight(EightSettings(duration_s=20.0, errors=rough))
    exact, _, _ = exact_values(run)
    gross = np.abs(run.sightings["value"][:, :2] - exact[:, :2]).max(axis=1) > 1e-3
    assert gross.mean() == pytest.approx(0.05, abs=0.015)


def test_a_world_of_systematic_errors_differs_by_robot() -> None:
    still = replace(
        W2,
        forward_sigma=0.0,
        left_sigma=0.0,
        flip_probability=0.0,
        gross_probability=0.0,
        exposure_early_s=0.0,
    )
    flat = replace(still, map_position_sigma=0.0, face_position_sigma=0.0, turn_slip=0.0)
    run = simulate_eight(EightSettings(duration_s=20.0, errors=flat))
    exact, robot, _ = exact_values(run)
    value = run.sightings["value"]
    scale = np.linalg.norm(value[:, :2], axis=1) / np.linalg.norm(exact[:, :2], axis=1)
    turned = np.arctan2(value[:, 1], value[:, 0]) - np.arctan2(exact[:, 1], exact[:, 0])
    scales = [scale[robot == k] for k in range(5)]
    assert all(
        np.ptp(one) < 0.02 for one in scales
    )  # the camera's offset keeps it from being exactly constant
    assert 0.01 < np.std([one.mean() for one in scales]) < 0.05
    yaws = [turned[robot == k].mean() for k in range(5)]
    assert math.radians(0.6) < np.std(yaws) < math.radians(4.0)


def test_pictures_are_late_lost_and_out_of_order() -> None:
    run = simulate_eight(EightSettings(duration_s=60.0))
    late_s = (run.frames["arrival_ns"] - run.frames["stamp_ns"]) * 1e-9
    assert 0.150 <= late_s.min() < 0.155
    assert 0.295 < late_s.max() <= 0.300
    assert (np.diff(run.frames["arrival_ns"]) >= 0).all()
    assert (np.diff(run.frames["stamp_ns"]) < 0).any()
    assert len(run.frames) / (5 * 7.5 * 59.6) == pytest.approx(0.95, abs=0.03)
    late_s = (run.odometry["arrival_ns"] - run.odometry["stamp_ns"]) * 1e-9
    assert 0.002 <= late_s.min() < late_s.max() <= 0.020


def test_lost_pictures_take_their_sightings_with_them() -> None:
    rng = np.random.default_rng(3)
    exposures = schedule_exposures(rng, 3, 7.5, 0, 10_000_000_000)
    count = len(exposures[0])
    frame = np.repeat(np.arange(count), 2)
    sightings = np.zeros(2 * count, SIGHTING_DTYPE)
    sightings["marker_id"] = frame
    frames, kept = deliver(rng, exposures, frame, sightings, end_ns=9_000_000_000, loss=0.3)
    assert len(kept) == 2 * len(frames) < 2 * count
    shown = [np.unique(kept["marker_id"][f["first"] : f["first"] + f["count"]]) for f in frames]
    for one, ids in zip(frames, shown, strict=True):
        assert len(ids) == 1
        assert exposures[1][ids[0]] == one["stamp_ns"]
        assert exposures[0][ids[0]] == one["robot"]


@pytest.mark.parametrize("rate_hz", [20.0, 50.0])
def test_odometry_comes_at_its_rate_from_every_robot(rate_hz: float) -> None:
    run = simulate_eight(EightSettings(duration_s=10.0, odometry_rate_hz=rate_hz))
    for robot in range(5):
        own = run.odometry[run.odometry["robot"] == robot]
        stamps = np.sort(own["stamp_ns"])
        assert stamps[0] == run.start_ns
        assert (np.diff(stamps[1:]) == round(1e9 / rate_hz)).all()
        np.testing.assert_array_equal(own["pose"][own["stamp_ns"] == run.start_ns][0], 0.0)


def test_the_same_seed_gives_the_same_run_and_another_does_not() -> None:
    one, same, other = (
        simulate_eight(EightSettings(seed=seed, duration_s=5.0, errors=W2)) for seed in (7, 7, 8)
    )
    for name in ("odometry", "frames", "sightings"):
        assert getattr(one, name).tobytes() == getattr(same, name).tobytes()
        assert getattr(one, name).tobytes() != getattr(other, name).tobytes()


def test_an_unknown_start_stays_out_of_the_description() -> None:
    settings = EightSettings(start_known=False)
    swarm = describe(settings, np.zeros((5, 3)))
    assert all(robot.start is None for robot in swarm.robots)
    assert len(swarm.owner_of) == 5 * 5 + 20
