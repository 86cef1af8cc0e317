"""UWB ranges: bytes to measurements, laws of the models, unknown starts, links that contradict."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core_geometry import nees
from core_messages import SECOND, T0
from core_run import ALL, IN_ORDER, TOGETHER, errors, on_time, play_messages, ticks
from core_world import Plan, World, simulate
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import ODOMETRY, encode
from swarm_loc_estimator.common.messages.cdr import RANGE as PAIR_TYPE
from swarm_loc_estimator.common.messages.cdr import RANGES as MESSAGE_TYPE
from swarm_loc_estimator.common.messages.poses import encode_odometry
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.doctor.doctor import evidence_of_bag, examine, lines_of
from swarm_loc_estimator.filter.measurements import LossReason, Measurements, Verdict, select
from swarm_loc_estimator.filter.models import MODELS, RANGE, RANGE_DIFFERENCE
from swarm_loc_estimator.offline.recorded_bag import unwatched
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.precompile import size_of
from swarm_loc_estimator.sensors.inputs import Ingest
from swarm_loc_estimator.swarm.swarm import Anchor, Robot, StartSigma, Swarm, UwbDevice
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.settings import Settings

SIGMA = 0.02
SQUARE = ((-1.5, -1.5, 0.8), (1.5, -1.5, 1.0), (1.5, 1.5, 0.8), (-1.5, 1.5, 1.0))
LINE = ((-1.5, -1.5, 0.8), (0.0, -1.5, 0.8), (1.5, -1.5, 0.8))
HUGE = 2**64 - 1


def device(index: int) -> UwbDevice:
    """The radio of a robot: off the centre of its base, without a bias."""
    noise = UwbDevice(index + 1, range_sigma=SIGMA, difference_sigma=1.5 * SIGMA, range_bias_sigma=0.0)
    return replace(noise, x=0.02, y=-0.03, z=0.1)


def world_of(
    seed: int, places: Sequence[tuple[float, float, float]] = SQUARE, bias_sigma: float = SIGMA, **plan: Any
) -> World:
    """Robots with radios that see nothing, and anchors."""
    world = simulate(Plan(reach=0.0, **plan), seed)
    robots = (replace(one, camera=None, uwb=device(k)) for k, one in enumerate(world.swarm.robots))
    anchors = tuple(Anchor(100 + k, *place, range_bias_sigma=bias_sigma) for k, place in enumerate(places))
    return replace(world, swarm=Swarm(tuple(robots), anchors=anchors))


@dataclass(frozen=True)
class Measured:
    """A range or a difference, as the radio of a robot gives it."""

    robot: int
    stamp_ns: int
    device: int
    range: float
    reference: int = 0
    variance: float = 0.0

    def data(self) -> bytes:
        """The message."""
        one = {name: getattr(self, name) for name in ("device", "reference", "range", "variance")}
        return encode({"header": {"stamp": self.stamp_ns}, "ranges": [one]}, MESSAGE_TYPE)


def antenna(world: World, step: int, address: int) -> FloatArray:
    for anchor in world.swarm.anchors:
        if anchor.address == address:
            return np.array([anchor.x, anchor.y, anchor.z])
    radio = device(address - 1)
    x, y, _ = se2.compose(world.truth[step, address - 1], [radio.x, radio.y, 0.0])
    return np.array([x, y, radio.z])


def ranges_of(world: World, seed: int, *, between: bool = False, differences: bool = False) -> list[Measured]:
    """Each link five times a second, one after the other.

    Anchors have the biases that their description allows. Half of the variance repeats while a range changes
    by less than 0.3 m, as with real radios.
    """
    rng, found = np.random.default_rng([seed, 7]), []
    anchors = [one.address for one in world.swarm.anchors]
    bias = {one.address: one.range_bias_sigma * rng.standard_normal() for one in world.swarm.anchors}
    links = [(robot, to) for robot in range(len(world.swarm.robots)) for to in anchors]
    if between:
        links += [(k, other + 1) for k in range(len(world.swarm.robots)) for other in range(k)]
    for number, (robot, to) in enumerate(links):
        before, repeated = np.inf, 0.0
        for step in range(1 + number % 4, world.stamp_ns.size, 4):
            own, reference = antenna(world, step, robot + 1), anchors[0] if differences else 0
            value = float(np.linalg.norm(antenna(world, step, to) - own))
            if reference == to:
                continue
            if reference:
                value -= float(np.linalg.norm(antenna(world, step, reference) - own))
            left = np.exp(-abs(value - before) / 0.3)
            repeated, before = left * repeated + np.sqrt(1.0 - left**2) * rng.standard_normal(), value
            noise = (1.5 if reference else 1.0) * SIGMA * np.sqrt(0.5) * (repeated + rng.standard_normal())
            noise += bias.get(to, 0.0) - bias.get(reference, 0.0)
            found.append(Measured(robot, int(world.stamp_ns[step]), to, value + noise, reference))
    return sorted(found, key=lambda one: one.stamp_ns)


def run(
    world: World, measured: Sequence[Measured], settings: Settings = IN_ORDER, late_s: float = 0.0
) -> tuple[Estimator, list[Estimate]]:
    """A world whose ranges come as bytes, late by up to so much."""
    rng, estimator, ingest = np.random.default_rng(0), Estimator(world.swarm, settings), Ingest(world.swarm)
    arrivals = [(one.stamp_ns + int(rng.uniform(0.0, late_s) * SECOND), one) for one in measured]
    handle = [ingest.handle_of[f"{robot.name}/ranges"] for robot in world.swarm.robots]
    messages = [SerializedMessage(handle[one.robot], one.data(), t) for t, one in arrivals]
    ticks_ns = ticks(T0, int(world.stamp_ns[-1]) + int(late_s * SECOND), 0.25)
    return estimator, play_messages(estimator, ingest, messages, on_time(world), ticks_ns)


# --- bytes to measurements


def converted(swarm: Swarm, *measured: Measured) -> tuple[Measurements, dict[str, int]]:
    ingest, estimator = Ingest(swarm), Estimator(swarm)
    handle = {k: ingest.handle_of[f"{r.name}/ranges"] for k, r in enumerate(swarm.robots) if r.uwb}
    batch = MessageBatch.of([SerializedMessage(handle[one.robot], one.data(), T0) for one in measured])
    (part,) = ingest.read(batch)
    return estimator.convert(part).rows["ranges"], estimator.drops


TWO = Swarm(
    (Robot("a", uwb=device(0)), Robot("b", uwb=device(1)), Robot("c")),
    anchors=(Anchor(100, 1.0, 2.0, 0.5), Anchor(HUGE, -1.0, 2.0, 0.5, range_bias=0.3)),
)


@pytest.mark.parametrize(
    ("one", "reason"),
    [
        (Measured(0, T0, 7, 1.0), "uwb_unknown_address"),
        (Measured(0, T0, 0, 1.0), "uwb_unknown_address"),
        (Measured(0, T0, 100, 1.0, reference=7), "uwb_unknown_address"),
        (Measured(0, T0, 1, 1.0), "uwb_own_address"),
        (Measured(0, T0, 100, 1.0, reference=1), "uwb_own_address"),
        (Measured(0, T0, 100, 1.0, reference=100), "uwb_equal_addresses"),
        (Measured(0, T0, 100, -0.1), "uwb_negative_range"),
        (Measured(0, T0, 100, np.nan), "non_finite"),
        (Measured(0, T0, 100, np.inf), "non_finite"),
        (Measured(0, T0, 100, 1e7), "absurd"),
        (Measured(0, T0, 100, 1.0, variance=-1.0), "bad_covariance"),
        (Measured(0, T0, 100, 1.0, variance=np.nan), "bad_covariance"),
        (Measured(0, T0, 100, 1.0, variance=np.inf), "bad_covariance"),
    ],
)
def test_a_useless_range_is_dropped_and_counted_by_its_reason(one: Measured, reason: str) -> None:
    found, drops = converted(TWO, one, Measured(1, T0, 100, 2.0))
    assert drops == {reason: 1}
    assert found.value[:, 0].tolist() == [2.0]


def test_ranges_of_a_robot_without_a_radio_are_dropped() -> None:
    ingest, estimator = Ingest(TWO), Estimator(TWO)
    assert "c/ranges" not in ingest.handle_of
    message = SerializedMessage(ingest.handle_of["a/ranges"], Measured(0, T0, 100, 1.0).data(), T0)
    (part,) = ingest.read(MessageBatch.of([message]))
    rows = part["ranges"]._replace(robot=np.array([2]))
    estimator.convert(replace(part, rows={"ranges": rows}))
    assert estimator.drops == {"no_uwb": 1}


def test_a_difference_of_two_robots_is_dropped_as_three_poses_would_be_in_it() -> None:
    swarm = replace(TWO, robots=(*TWO.robots[:2], Robot("c", uwb=device(2))))
    assert converted(swarm, Measured(0, T0, 2, 0.1, reference=3))[1] == {"uwb_two_robots": 1}


def test_biases_and_scale_are_taken_out_and_the_variance_is_of_the_true_range() -> None:
    radio = replace(device(0), range_bias=0.1, range_scale=1.25)
    swarm = replace(TWO, robots=(Robot("a", uwb=radio), *TWO.robots[1:]))
    measured = Measured(0, T0, HUGE, 2.9), Measured(0, T0, HUGE, 0.8, reference=100, variance=0.01)
    found, _ = converted(swarm, *measured)
    np.testing.assert_allclose(found.value[:, 0], [(2.9 - 0.3 - 0.1) / 1.25, (0.8 - 0.3) / 1.25])
    np.testing.assert_allclose(found.covariance[:, 0, 0], [(SIGMA / 1.25) ** 2, 0.01 / 1.25**2 + 0.2**2])


def test_a_reference_on_a_robot_changes_places_with_the_anchor() -> None:
    found, _ = converted(TWO, Measured(0, T0, 100, 0.5, reference=2), Measured(0, T0, 2, -0.5, reference=100))
    assert select(found, slice(0, 1)).equals(select(found, slice(1, 2)))
    assert found.target.tolist() == [1, 1]


def test_a_node_of_robots_with_radios_compiles_what_fuses_their_ranges() -> None:
    assert [size_of(swarm, Settings()) for swarm in (TWO, Swarm((Robot("a"),)))] == ["large", "small"]


# --- laws of the models

POSES = st.tuples(*[st.floats(-5.0, 5.0)] * 2, st.floats(-3.0, 3.0)).map(np.array)


def between_robots(model: int, observer: int = 0, target: int = 1) -> Measurements:
    many = Measurements.empty(1)
    many.model[:], many.observer[:], many.target[:] = model, observer, target
    many.sensor[:], many.marker[:], many.height[:] = (0.1, -0.2, 0.0), (-0.3, 0.1, 0.0), (0.3, 0.5)
    return many.row(0)


@given(POSES, POSES)
def test_a_range_is_the_same_from_both_ends(a: FloatArray, b: FloatArray) -> None:
    one = between_robots(RANGE)
    back = one._replace(sensor=one.marker, marker=one.sensor, height=one.height[::-1])
    there, here = MODELS[RANGE].predicted(one, a, b), MODELS[RANGE].predicted(back, b, a)
    np.testing.assert_allclose(there.value, here.value, atol=1e-12)
    np.testing.assert_allclose(there.observer_jacobian, here.target_jacobian, atol=1e-9)


@pytest.mark.parametrize("number", [RANGE, RANGE_DIFFERENCE])
@given(POSES, POSES, POSES)
def test_moving_the_map_changes_no_value(number: int, move: FloatArray, a: FloatArray, b: FloatArray) -> None:
    one, moved = between_robots(number), between_robots(number)
    one.reference[:] = (1.0, 2.0, 0.7)
    moved.reference[:2], moved.reference[2] = se2.transform_points(move, [1.0, 2.0]), 0.7
    value = MODELS[number].predicted(one, a, b).value
    again = MODELS[number].predicted(moved, se2.compose(move, a), se2.compose(move, b)).value
    np.testing.assert_allclose(again, value, atol=1e-9)


def test_antennas_at_one_place_have_a_finite_model() -> None:
    one = between_robots(RANGE)
    one = one._replace(sensor=np.zeros(3), marker=np.zeros(3), height=np.zeros(2))
    for model in (RANGE, RANGE_DIFFERENCE):
        for part in MODELS[model].predicted(one, np.zeros(3), np.zeros(3)):
            assert np.isfinite(part).all()
            np.testing.assert_array_equal(part, 0.0)


# --- estimates


@ALL
@pytest.mark.parametrize("differences", [False, True], ids=["ranges", "differences"])
def test_errors_are_as_large_as_the_covariances_say(settings: Settings, differences: bool) -> None:
    squared, distance = [], []
    for seed in range(3):
        # the bias of a reference is noise, and batches do not know the covariance with biases: less sure
        exact = differences or settings is not IN_ORDER
        world = world_of(seed, bias_sigma=0.0 if exact else SIGMA, robots=3, duration_s=10.0)
        measured = ranges_of(world, seed, between=not differences, differences=differences)
        _, estimates = run(world, measured, settings)
        error = errors(world, estimates)[12:]
        covariance = np.array([one.covariances for one in estimates])[12:]
        squared.append(nees(error, covariance).mean(axis=0))
        distance.append(np.square(error[..., :2]).sum(axis=-1).mean())
    assert 1.0 < np.mean(squared) < 6.0
    assert np.sqrt(np.mean(distance)) < 0.03


def test_robots_without_a_start_are_located_in_any_order_of_arrival() -> None:
    world = world_of(11, robots=2, duration_s=8.0, start_known=(False,))
    measured = ranges_of(world, 11, between=True)
    estimator, estimates = run(world, measured)
    assert estimates[0].status.tolist() == [Status.WAITING] * 2
    assert estimates[-1].status.tolist() == [Status.TRACKED] * 2
    error = errors(world, estimates)
    assert np.nanmax(np.hypot(error[..., 0], error[..., 1])) < 0.3
    assert np.hypot(*error[-1, :, :2].T).max() < 0.05
    assert estimator.counters["constraints kept"] > 20
    late = run(world, measured, late_s=1.5)[1][-1]
    np.testing.assert_allclose(late.poses, run(world, measured, late_s=1e-9)[1][-1].poses, atol=0.05)
    again = run(world, list(reversed(measured)), late_s=1.5)[1][-1]
    np.testing.assert_allclose(again.poses, late.poses, atol=1e-9)


def straight(world: World, until_s: float) -> World:
    """The world until its robot turns: a part of its run is a line along x."""
    steps = round(until_s / 0.05)
    truth, events = world.truth.copy(), []
    for k in range(steps + 1):
        truth[k, :, 0], truth[k, :, 1:] = -0.6 + 0.2 * 0.05 * k, (0.1, 0.0)
    for event in world.events:
        k = round((event.stamp_ns - T0) / (0.05 * SECOND))
        pose = event.pose
        if k <= steps:
            pose = (0.2 * 0.05 * k, 0.0, 0.0)
        elif pose is not None:
            turn = 0.5 * 0.05 * (k - steps)
            at = 0.2 * 0.05 * steps + 0.4 * np.sin(turn), 0.4 * (1.0 - np.cos(turn)), turn
            pose, truth[k, 0] = at, (-0.6 + at[0], 0.1 + at[1], at[2])
        events.append(replace(event, pose=pose))
    return replace(world, truth=truth, events=tuple(events))


@pytest.mark.parametrize("seed", range(3))
def test_the_mirror_image_beside_a_line_of_anchors_stays_open_until_the_robot_turns(seed: int) -> None:
    world = straight(world_of(seed, LINE, robots=1, duration_s=12.0, start_known=(False,), noise=0.0), 5.0)
    _, estimates = run(world, ranges_of(world, seed))
    time_s = np.array([(one.stamp_ns - T0) / SECOND for one in estimates])
    located = np.array([one.status[0] != Status.WAITING for one in estimates])
    assert not located[time_s < 5.0].any()
    assert located[-1]
    error = errors(world, estimates)[located, 0]
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.3


def test_one_anchor_locates_nobody() -> None:
    world = world_of(5, SQUARE[:1], robots=1, duration_s=10.0, start_known=(False,))
    _, estimates = run(world, ranges_of(world, 5))
    assert all(one.status[0] == Status.WAITING for one in estimates)


@ALL
def test_a_link_that_is_too_long_for_seconds_is_named_and_the_pose_stays_right(settings: Settings) -> None:
    world = world_of(20, robots=2, duration_s=10.0)
    begin_ns, end_ns = T0 + 3 * SECOND, T0 + 7 * SECOND
    measured = [
        replace(one, range=one.range + 0.5)
        if one.robot == 0 and one.device == 101 and begin_ns < one.stamp_ns < end_ns
        else one
        for one in ranges_of(world, 20)
    ]
    until = [one for one in measured if one.stamp_ns < end_ns]
    estimator, _ = run(world, until, settings)
    (named,) = estimator.contradictions(end_ns)
    assert named.text == "excluding robot_0's measurements of anchor 101: inconsistent with all others"
    estimator, estimates = run(world, measured, settings)
    assert estimator.contradictions(int(world.stamp_ns[-1])) == []
    assert (np.array([one.status for one in estimates[4:]]) == Status.TRACKED).all()
    error = errors(world, estimates)[4:]
    assert np.hypot(error[..., 0], error[..., 1]).max() < 0.1


@ALL
def test_scattered_outliers_exclude_no_link(settings: Settings) -> None:
    world, rng = world_of(21, robots=2, duration_s=10.0), np.random.default_rng(3)
    measured = [
        replace(one, range=one.range + (1.0 if rng.uniform() < 0.1 else 0.0)) for one in ranges_of(world, 21)
    ]
    estimator, _ = run(world, measured, replace(settings, horizon_s=60.0))
    assert estimator.contradictions(int(world.stamp_ns[-1])) == []
    _, verdicts, _ = estimator.recent()
    assert np.mean(verdicts == Verdict.GATED) == pytest.approx(0.1, rel=0.3)


def test_a_bias_that_the_description_lacks_loses_no_robot() -> None:
    world = world_of(22, robots=2, duration_s=10.0)
    biased = [replace(one, range=one.range + 1.2 * SIGMA) for one in ranges_of(world, 22)]
    estimator, estimates = run(world, biased)
    links = len(world.swarm.robots) * len(world.swarm.anchors)
    assert len(estimator.contradictions(int(world.stamp_ns[-1]))) < links / 2
    assert (np.array([one.status for one in estimates[4:]]) != Status.WAITING).all()
    error = errors(world, estimates)[4:]
    assert np.hypot(error[..., 0], error[..., 1]).max() < 5.0 * SIGMA


@ALL
def test_an_anchor_with_an_inexact_survey_is_estimated(settings: Settings) -> None:
    world = world_of(30, bias_sigma=0.0, robots=3, duration_s=15.0)
    measured = ranges_of(world, 30)
    first = world.swarm.anchors[0]
    moved = replace(first, x=first.x + 0.12, y=first.y - 0.08, position_sigma=0.1)
    surveyed = replace(world, swarm=replace(world.swarm, anchors=(moved, *world.swarm.anchors[1:])))
    estimator, _ = run(surveyed, measured, settings)
    learned = estimator.learned().anchors
    assert np.hypot(learned[0].x - first.x, learned[0].y - first.y) < 0.04
    assert learned[0].position_sigma < 0.05
    assert learned[1:] == world.swarm.anchors[1:]


@ALL
@pytest.mark.parametrize("seed", range(3))
def test_the_biases_of_anchors_are_estimated(settings: Settings, seed: int) -> None:
    world = world_of(seed, bias_sigma=0.2, robots=3, duration_s=15.0)
    measured = ranges_of(world, seed)
    estimator, estimates = run(world, measured, settings)
    for anchor, before in zip(estimator.learned().anchors, world.swarm.anchors, strict=True):
        links = [one for one in measured if one.device == anchor.address]
        steps = [round((one.stamp_ns - T0) / (0.05 * SECOND)) for one in links]
        true = np.mean(
            [
                one.range - np.linalg.norm(antenna(world, k, one.device) - antenna(world, k, one.robot + 1))
                for one, k in zip(links, steps, strict=True)
            ]
        )
        assert anchor.range_bias == pytest.approx(true, abs=0.06)
        assert anchor.range_bias_sigma < 0.5 * before.range_bias_sigma
        assert (anchor.x, anchor.y, anchor.position_sigma) == (before.x, before.y, 0.0)
    error = errors(world, estimates)[20:]
    assert np.sqrt(np.square(error[..., :2]).sum(axis=-1).mean()) < 0.06


def with_radios(world: World, **changed: Any) -> World:
    robots = [replace(one, uwb=one.uwb and replace(one.uwb, **changed)) for one in world.swarm.robots]
    return replace(world, swarm=replace(world.swarm, robots=tuple(robots)))


@pytest.mark.parametrize("settings", [IN_ORDER, TOGETHER], ids=["order", "batch"])
@pytest.mark.parametrize("seed", range(3))
def test_the_bias_of_two_radios_is_estimated(settings: Settings, seed: int) -> None:
    """Of two robots that know their starts and nothing but the range between them."""
    world = with_radios(world_of(seed, (), robots=2, duration_s=15.0), range_bias_sigma=0.2)
    measured = [replace(one, range=one.range + 0.3) for one in ranges_of(world, seed, between=True)]
    estimator, estimates = run(world, measured, settings)
    found = [one.uwb for one in estimator.learned().robots if one.uwb is not None]
    assert sum(one.range_bias for one in found) == pytest.approx(0.3, abs=0.05)
    assert all(0.1 < one.range_bias_sigma < 0.2 for one in found)  # which of both has it stays unknown
    assert (estimates[-1].status == Status.TRACKED).all()
    assert np.hypot(*errors(world, estimates)[-1, :, :2].T).max() < 0.1


@ALL
def test_robots_that_stand_see_the_same_error_for_ever(settings: Settings) -> None:
    """A thousand ranges of one place are not a thousand looks."""
    world = world_of(3, SQUARE[:1], bias_sigma=0.0, robots=1, duration_s=50.0)
    still = [replace(one, pose=None if one.pose is None else (0.0, 0.0, 0.0)) for one in world.events]
    radios = with_radios(replace(world, events=tuple(still), truth=np.tile(world.truth[:1], (1001, 1, 1))))
    start = replace(radios.swarm.robots[0], start_sigma=StartSigma(0.5, 0.5, 0.01))
    radios = replace(radios, swarm=replace(radios.swarm, robots=(start,)))
    rng, away = (
        np.random.default_rng(3),
        float(np.linalg.norm(antenna(radios, 0, 100) - antenna(radios, 0, 1))),
    )
    stamps = [T0 + k * SECOND // 20 for k in range(1000)]
    measured = [
        Measured(0, t, 100, away + 0.05 + 0.03 * rng.standard_normal(), variance=0.05**2) for t in stamps
    ]
    _, estimates = run(radios, measured, settings)
    least = np.sqrt(np.linalg.eigvalsh(estimates[-1].covariances[0, :2, :2])[0])
    assert least > 0.02


def test_a_radio_that_jumps_is_named_and_its_robot_stays() -> None:
    world = world_of(23, (), robots=2, duration_s=15.0)
    jumps_ns = T0 + 5 * SECOND
    measured = [
        replace(one, range=one.range + (1.0 if one.stamp_ns > jumps_ns else 0.0))
        for one in ranges_of(world, 23, between=True)
    ]
    estimator, estimates = run(world, measured)
    assert (np.array([one.status for one in estimates]) != Status.WAITING).all()
    texts = [one.text for one in estimator.contradictions(int(world.stamp_ns[-1]))]
    assert "excluding robot_1's measurements of robot_0: inconsistent with all others" in texts or (
        "excluding robot_0's measurements of robot_1: inconsistent with all others" in texts
    )
    assert np.hypot(*errors(world, estimates)[-1, :, :2].T).max() < 0.2


def test_ranges_that_are_too_long_and_too_short_lose_a_robot_that_was_carried() -> None:
    world = world_of(24, robots=1, duration_s=20.0)
    truth = np.array(world.truth)
    truth[100:, 0, 0] += 1.0
    carried = replace(world, truth=truth)
    estimator, estimates = run(carried, ranges_of(carried, 24))
    assert [one.why for one in estimator.losses] == [LossReason.GATED]
    assert estimates[-1].status[0] == Status.TRACKED
    assert np.hypot(*errors(carried, estimates)[-1, 0, :2]) < 0.1


def test_both_orders_of_a_pair_are_one_link() -> None:
    swarm = replace(
        TWO, robots=(TWO.robots[0], replace(TWO.robots[1], uwb=replace(device(1), range_scale=1.1)))
    )
    found, _ = converted(swarm, Measured(0, T0, 2, 1.0), Measured(1, T0, 1, 1.1))
    assert found.received_from.tolist() == [0, 1]
    one, other = (select(found, slice(k, k + 1))._replace(received_from=np.zeros(1, int)) for k in range(2))
    np.testing.assert_allclose(other.value, one.value)
    for link in (one, other):
        assert (link.observer.tolist(), link.target.tolist()) == ([0], [1])
    np.testing.assert_array_equal(one.sensor, other.sensor)
    np.testing.assert_array_equal(one.height, other.height)


def pair_message(value: float, variance: float, *, limits: tuple[float, float] = (0.0, 0.0)) -> bytes:
    low, high = limits
    fields = {"min_range": low, "max_range": high, "range": value, "variance": variance}
    return encode({"header": {"stamp": T0, "frame_id": "n_1"}, **fields}, PAIR_TYPE)


def test_ranges_on_a_topic_of_two_radios_are_those_of_arrays(tmp_path: Path) -> None:
    """Either order, a variance or none, as before ROS 2 Iron; what is outside of the limits is none."""
    path = tmp_path / "swarm.yaml"
    path.write_text(
        "fileversion: 1\nrange_topic: /uwb/n_{from}/n_{to}/distance\n"
        "robots: {a: {uwb: {address: 1}}, b: {uwb: {address: 2}}}\nanchors: [{address: 16, x: 0, y: 0}]\n"
    )
    swarm = load_swarm(path)
    save_swarm(swarm, tmp_path / "again.yaml")
    assert load_swarm(tmp_path / "again.yaml") == swarm
    ingest = Ingest(swarm)
    sent = [
        ("uwb/n_1/n_2/distance", pair_message(1.5, 0.25)),
        ("uwb/n_16/n_2/distance", pair_message(2.5, 0.0)[:-4]),
        ("uwb/n_2/n_16/distance", pair_message(3.5, 0.0, limits=(0.5, 3.0))),
        ("uwb/n_2/n_1/distance", pair_message(float("inf"), 0.0)),
        ("uwb/n_2/n_1/distance", pair_message(4.5, 0.0)[:-8]),
    ]
    messages = [
        SerializedMessage(ingest.handle_of[name], data, T0 + k) for k, (name, data) in enumerate(sent)
    ]
    (batch,) = ingest.read(MessageBatch.of(messages))
    rows = batch["ranges"]
    assert rows.robot.tolist() == [0, 1]
    assert rows.device.tolist() == [2, 16]
    assert rows.range.tolist() == [1.5, 2.5]
    assert rows.variance.tolist() == [0.25, 0.0]
    assert rows.stamp_ns.tolist() == [T0, T0]
    assert rows.arrival_ns.tolist() == [T0, T0 + 1]
    assert batch.dropped == {"uwb_out_of_limits": 2, "bad_message": 1}
    names = {topic.name for topic in ingest.topics}
    assert "a/ranges" not in names
    assert "uwb/n_16/n_16/distance" not in names


def test_topics_of_two_radios_have_their_names(tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    path.write_text(
        "fileversion: 1\nrange_topic: /uwb/{from}/{to}\nrobots: {a: {uwb: {address: 1, name: from}}, b: {}}\n"
        "anchors: [{address: 0x10, x: 0, y: 0, name: n_to}, {address: 17, x: 1, y: 0}]\n"
    )
    swarm = load_swarm(path)
    save_swarm(swarm, tmp_path / "again.yaml")
    assert load_swarm(tmp_path / "again.yaml") == swarm
    names = {topic.name for topic in Ingest(swarm).topics if topic.kind.of_pairs}
    assert names == {"uwb/from/n_to", "uwb/n_to/from", "uwb/from/17", "uwb/17/from"}


@pytest.mark.parametrize("there", [True, False])
def test_a_pattern_that_fits_no_topic_is_named_with_the_topics_that_there_are(
    there: bool, tmp_path: Path
) -> None:
    robots = tuple(Robot(name, uwb=device(k), start=(0.0, 0.0, 0.0)) for k, name in enumerate("ab"))
    swarm = Swarm(robots, range_topic="uwb/{from}/{to}")
    stored = "radio/n_1/n_2" if not there else "uwb/2/1"
    with BagWriter(tmp_path / "bag") as writer:
        for name, message_type in ((stored, PAIR_TYPE), ("a/odom", ODOMETRY)):
            writer.add_topic(name, message_type)
        stamps = T0 + np.arange(20) * SECOND // 20
        still = encode_odometry("a/odom", "a/base_link", stamps, np.zeros((20, 3)), np.zeros((20, 3)))
        for now_ns, data in zip(stamps.tolist(), still, strict=True):
            writer.write("a/odom", now_ns, data)
            writer.write(stored, now_ns, pair_message(1.0, 0.0))
    said = [one for one in replay(tmp_path / "bag", swarm).remarks if "uwb/{from}/{to}" in one]
    doctored = [
        one
        for one in lines_of(examine(evidence_of_bag(tmp_path / "bag", swarm, 10.0, unwatched)))
        if "range_topic" in one
    ]
    assert bool(said) == bool(doctored) == (not there)
    for one in (*said, *doctored):
        assert "radio/n_1/n_2" in one
        assert "orrect range_topic" in one
