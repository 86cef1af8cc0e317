"""Blinking lights in events: where they are, how sure that is, and what is none of them."""

import numpy as np
import pytest
from blinking_lights import SIZE, light, noise, together
from hypothesis import given, settings
from hypothesis import strategies as st

from swarm_loc_estimator.common.messages.event_encoding import Events
from swarm_loc_vision.events.tracker import (
    MAX_SOURCES,
    LightSource,
    LightTracker,
    TrackerSettings,
    WindowReport,
    direction,
    direction_jacobian,
)

LASER, LED = LightSource(450.0, is_above=False), LightSource(1000.0, is_above=True)
SETTINGS = TrackerSettings()


def errors(
    reports: list[WindowReport], source: int, place: tuple[float, float], skipped: int = 1
) -> np.ndarray:
    """(R, 2) of a light's places, without those of the first windows."""
    found = [one for report in reports[skipped:] for one in report.sightings if one.source == source]
    return np.array([[one.u - place[0], one.v - place[1]] for one in found])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_laser_and_led_are_found_among_noise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    laser = (40.0 + 40.0 * rng.random(), 80.0 + 30.0 * rng.random())
    led = (40.0 + 40.0 * rng.random(), 20.0 + 30.0 * rng.random())
    events = together(light(rng, laser, 450.0, 0.5), light(rng, led, 1000.0, 0.5), noise(rng, 15.0, 0.5))
    reports = LightTracker([LASER, LED], SIZE, SETTINGS).track(events)
    assert len(reports) == 24
    for source, place in enumerate((laser, led)):
        wrong = errors(reports, source, place)
        assert len(wrong) == 23
        assert np.sqrt((wrong**2).mean(axis=0)).max() < 0.15


def test_covariances_are_about_right() -> None:
    """NEES of 2 is ideal; where pixels sit lasts, so single places may be worse, and none is absurd."""
    values = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        place = (60.0 + rng.random(), 90.0 + rng.random())
        events = together(light(rng, place, 450.0, 0.2), noise(rng, 5.0, 0.2))
        for report in LightTracker([LASER], SIZE, SETTINGS).track(events)[1:]:
            (one,) = report.sightings
            wrong = np.array([one.u - place[0], one.v - place[1]])
            values.append(wrong @ np.linalg.solve(one.covariance, wrong))
    assert 0.2 < np.mean(values) < 4.0


def test_noise_alone_is_no_light() -> None:
    rng = np.random.default_rng(4)
    reports = LightTracker([LASER, LED], SIZE, SETTINGS).track(together(noise(rng, 30.0, 1.0)))
    assert len(reports) == 49
    assert not any(report.sightings for report in reports)


def test_halves_are_kept_apart() -> None:
    """A light of the laser's frequency in the upper half is somebody else's."""
    rng = np.random.default_rng(5)
    events = together(light(rng, (60.0, 30.0), 450.0, 0.2), noise(rng, 1.0, 0.2))
    reports = LightTracker([LASER], SIZE, SETTINGS).track(events)
    assert not any(report.sightings for report in reports)


@pytest.mark.parametrize(
    ("apart", "places"),
    [
        (10.0, [(30.0, 40.0), (90.0, 30.0)]),
        (20.0, [(30.0, 40.0), (90.0, 30.0)]),
        (60.0, [(12.0 + 11.0 * k, 20.0 + 3.0 * k) for k in range(10)]),
    ],
)
def test_frequencies_are_told_apart(apart: float, places: list[tuple[float, float]]) -> None:
    rng = np.random.default_rng(6)
    sources = [LightSource(490.0 + apart * k, is_above=True) for k in range(len(places))]
    parts = [light(rng, place, one.frequency, 0.4) for place, one in zip(places, sources, strict=True)]
    reports = LightTracker(sources, SIZE, SETTINGS).track(together(*parts, noise(rng, 2.0, 0.4)))
    for source, place in enumerate(places):
        wrong = errors(reports, source, place)
        assert len(wrong) == 18
        assert np.abs(wrong).max() < 0.6


def test_a_light_is_no_echo_of_half_its_frequency() -> None:
    """Where every other burst is lost, a light of 1000 Hz looks like one of 500 Hz."""
    rng = np.random.default_rng(8)
    rows = light(rng, (60.0, 30.0), 1000.0, 0.4)
    cycle = (rows[3] // 1e6).astype(int)
    rows = rows[:, rng.random(cycle.max() + 1)[cycle] > 0.15]
    sources = [LightSource(1000.0, is_above=True), LightSource(500.0, is_above=True)]
    reports = LightTracker(sources, SIZE, SETTINGS).track(together(rows))
    assert all([one.source for one in report.sightings] == [0] for report in reports[1:])


def test_the_spot_of_a_moving_robot_is_where_it_was_at_its_stamp() -> None:
    rng = np.random.default_rng(9)
    events = together(light(rng, (30.0, 90.0), 450.0, 0.5, drift=60.0), noise(rng, 2.0, 0.5))
    reports = LightTracker([LASER], SIZE, SETTINGS).track(events)
    wrong = [
        one.u - (30.0 + 60.0 * one.stamp_ns * 1e-9) for report in reports[1:] for one in report.sightings
    ]
    assert len(wrong) >= 20
    assert np.abs(wrong).max() < 0.4


@settings(max_examples=20, deadline=None)
@given(cuts=st.lists(st.integers(0, 4000), max_size=20))
def test_packets_of_any_size_give_the_same_reports(cuts: list[int]) -> None:
    rng = np.random.default_rng(10)
    events = together(light(rng, (60.3, 90.2), 450.0, 0.1), noise(rng, 2.0, 0.1))
    places = sorted(one for one in cuts if one < len(events.x))

    whole, cut = LightTracker([LASER], SIZE, SETTINGS).track(events), LightTracker([LASER], SIZE, SETTINGS)
    parts = [
        report
        for begin, end in zip([0, *places], [*places, len(events.x)], strict=True)
        for report in cut.track(Events._make(column[begin:end] for column in events))
    ]
    assert [(one.stamp_ns, [s[:4] for s in one.sightings]) for one in parts] == [
        (one.stamp_ns, [s[:4] for s in one.sightings]) for one in whole
    ]


def test_time_that_steps_back_begins_anew() -> None:
    rng = np.random.default_rng(11)
    events = together(light(rng, (60.3, 90.2), 450.0, 0.2))
    tracker = LightTracker([LASER], SIZE, SETTINGS)
    later = events._replace(time_ns=events.time_ns + 10**12)
    tracker.track(later)
    assert len(tracker.track(events)) == 9
    assert tracker.time_jumps == 1


def test_an_hour_without_events_makes_no_reports() -> None:
    rng = np.random.default_rng(12)
    events = together(light(rng, (60.3, 90.2), 450.0, 0.05))
    tracker = LightTracker([LASER], SIZE, SETTINGS)
    tracker.track(events)
    assert len(tracker.track(events._replace(time_ns=events.time_ns + 3600 * 10**9))) == 3


def test_more_lights_than_bits_are_refused() -> None:
    with pytest.raises(ValueError, match="33 lights"):
        LightTracker([LASER] * (MAX_SOURCES + 1), SIZE, SETTINGS)


@given(u=st.floats(-60, 60), v=st.floats(-60, 60))
def test_the_jacobian_of_directions_is_that_of_differences(u: float, v: float) -> None:
    step = 1e-4
    columns = [
        (np.array(direction(u + du, v + dv, 90.0)) - np.array(direction(u - du, v - dv, 90.0))) / (2 * step)
        for du, dv in ((step, 0.0), (0.0, step))
    ]
    np.testing.assert_allclose(direction_jacobian(u, v, 90.0), np.column_stack(columns), atol=1e-8)


def test_directions_are_to_the_left_and_up() -> None:
    bearing, elevation = direction(-90.0, 0.0, 90.0)
    assert (bearing, elevation) == pytest.approx((np.pi / 4, 0.0))
    assert direction(0.0, -90.0, 90.0) == pytest.approx((0.0, np.pi / 4))
