"""A range-only sensor added from outside the product, and the Jacobians of all registered models."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_messages import SECOND, T0
from core_run import play, settled, ticks
from core_world import Plan, World, simulate
from scipy.stats import chi2

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.streams import MessageBatch, Messages, SerializedMessage
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements
from swarm_loc_estimator.filter.models import MODELS, SCAN, MeasurementModel, Prediction, register
from swarm_loc_estimator.offline.recorded_bag import read_bag, unwatched
from swarm_loc_estimator.sensors.inputs import SENSORS, Ingest
from swarm_loc_estimator.sensors.sensor import Sensor
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings

BAG = Path(__file__).parents[3] / "bags" / "eight_one_robot_slow"
SIGMA_M = 0.03


def predict_range(one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
    (sx, sy, _), (mx, my, _) = se2.compose(observer, one.sensor), se2.compose(target, one.marker)
    distance = np.hypot(mx - sx, my - sy)
    toward = np.array([[mx - sx, my - sy]]) / distance
    moved_observer, moved_target = ([[1.0, 0.0, -y], [0.0, 1.0, x]] for x, y in ((sx, sy), (mx, my)))
    return Prediction(np.array([distance]), -toward @ moved_observer, toward @ moved_target)


RANGE = MeasurementModel("range", 100, ("distance [m]",), (False,), 1, predict_range)
LAYOUT = struct.Struct("<qqd")


class Range(NamedTuple):
    """A message: a distance to a robot, or to anchor a as -1 - a."""

    stamp_ns: int
    target: int
    distance: float
    frame_id: str = ""


class RangeRows(NamedTuple):
    """Ranges (k,) in columns."""

    robot: IntArray
    stamp_ns: IntArray
    target: IntArray
    distance: FloatArray
    arrival_ns: IntArray


class RangeSensor(Sensor):
    """Takes the place of the sensor of this name."""

    name, topic, message_type, model = "ranges", "ranges", "my_msgs/msg/Range", RANGE.number

    @classmethod
    def decode(cls, data: bytes) -> Range:
        """Read a message."""
        return Range(*LAYOUT.unpack(data))

    @classmethod
    def columns(cls, messages: Messages[Range]) -> RangeRows:
        """Messages in columns."""
        target = np.array([one.target for one in messages.decoded], dtype=np.int64)
        distance = np.array([one.distance for one in messages.decoded], dtype=float)
        return RangeRows(messages.robot, messages.stamp_ns, target, distance, messages.arrival_ns)

    def measure(self, rows: RangeRows) -> Measurements:
        """A measurement per range."""
        out, anchor = self.measurements(rows), -1 - rows.target
        anchors = np.array([(mark.x, mark.y, 0.0) for mark in self.swarm.landmarks])
        out.target[:], out.landmark[:] = np.maximum(rows.target, NOBODY), np.maximum(anchor, NOBODY)
        out.marker[:] = np.where(rows.target[:, None] < 0, anchors[anchor], 0.0)
        out.value[:, 0], out.covariance[:] = rows.distance, np.diag([SIGMA_M**2, 1.0, 1.0])
        return out


def ranges(world: World, seed: int, outliers: float = 0.0) -> list[tuple[int, Range]]:
    """Ranges of all robots to two anchors and to the next robot, five times a second."""
    rng, found = np.random.default_rng([seed, 9]), []
    robots = len(world.swarm.robots)
    places = {-1 - a: (world.swarm.landmarks[a].x, world.swarm.landmarks[a].y) for a in (0, 3)}
    for k in range(4, world.stamp_ns.size, 4):
        for robot in range(robots):
            for target in (-1, -4, (robot + 1) % robots):
                there = places[target] if target < 0 else world.truth[k, target, :2]
                distance = np.hypot(*(there - world.truth[k, robot, :2])) + rng.normal(0.0, SIGMA_M)
                distance += 1.0 if rng.uniform() < outliers else 0.0
                found.append((robot, Range(int(world.stamp_ns[k]), target, float(distance))))
    return found


IN_ORDER = Settings(fusion_period_s=0.0)
TOGETHER = Settings(fusion_period_s=0.2, policy=Policy(large_from=1, batch_from=2))
SPARSE = Settings(fusion_period_s=0.2, sparse_from=2)
ALL = pytest.mark.parametrize("settings", [IN_ORDER, TOGETHER, SPARSE], ids=["order", "batch", "sparse"])


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(MODELS, RANGE.number, RANGE)
    monkeypatch.setitem(SENSORS, RangeSensor.name, RangeSensor)


def world_of(seed: int) -> World:
    """Robots that see nothing."""
    return simulate(Plan(4, 16.0, reach=0.0), seed)


def run(
    world: World, measured: list[tuple[int, Range]], settings: Settings, late_s: float = 0.0
) -> tuple[Estimator, list[Estimate]]:
    """A world with ranges, all of which are late by up to so much."""
    rng, estimator, ingest = np.random.default_rng(0), Estimator(world.swarm, settings), Ingest(world.swarm)
    events = [(e.stamp_ns + int(rng.uniform(0.0, late_s) * SECOND), e) for e in world.events]
    messages = [
        (
            ingest.handle_of[f"{world.swarm.robots[robot].name}/ranges"],
            LAYOUT.pack(*one[:3]),
            one.stamp_ns + int(rng.uniform(0.0, late_s) * SECOND),
        )
        for robot, one in measured
    ]
    messages.sort(key=lambda message: message[2])
    estimates, begin_ns = [], T0 - 1
    for now_ns in ticks(T0, int(world.stamp_ns[-1]) + 2 * SECOND, 0.25):
        batch = MessageBatch.of([SerializedMessage(*one) for one in messages if begin_ns < one[2] <= now_ns])
        for part in ingest.read(batch):
            estimator.receive(part)
        estimates += play(estimator, [(t, e) for t, e in events if begin_ns < t <= now_ns], [now_ns])
        begin_ns = now_ns
    return estimator, estimates


def errors(world: World, estimates: list[Estimate]) -> tuple[FloatArray, FloatArray]:
    """Errors (T, N, 3) and covariances (T, N, 3, 3) at whole seconds of the world."""
    whole = [e for e in estimates if e.stamp_ns % SECOND == 0 and e.stamp_ns <= world.stamp_ns[-1]][4:]
    error = wrapped(np.array([e.poses - world.at(e.stamp_ns) for e in whole]))
    return error, np.array([e.covariances for e in whole])


@ALL
def test_ranges_make_poses_better_and_the_errors_stay_as_large_as_the_covariances_say(
    settings: Settings,
) -> None:
    squared, with_ranges, without = [], [], []
    for seed in range(4):
        world = world_of(900 + seed)
        estimator, estimates = run(world, ranges(world, seed), settings)
        error, covariance = errors(world, estimates)
        assert settled(estimator)["USED"] > 900
        squared.append(nees(error, covariance).mean(axis=0))
        with_ranges.append(np.square(error[..., :2]).mean())
        error, _ = errors(world, run(world, [], settings)[1])
        without.append(np.square(error[..., :2]).mean())
    assert np.sqrt(np.mean(with_ranges)) < 0.4 * np.sqrt(np.mean(without))
    samples = np.size(squared)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 3 * samples) / samples
    assert low < np.mean(squared) < high


@ALL
def test_late_and_shuffled_ranges_give_the_same(settings: Settings) -> None:
    world = world_of(910)
    measured = ranges(world, 1)
    expected = run(world, measured, settings)[1][-1]
    found = run(world, measured, settings, late_s=1.5)[1][-1]
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-9)
    np.testing.assert_allclose(found.covariances, expected.covariances, atol=1e-9)


@ALL
def test_outliers_are_gated_with_the_one_degree_of_freedom_of_the_sensor(settings: Settings) -> None:
    np.testing.assert_allclose(RANGE.gate([0.95, 0.999]), chi2.ppf([0.95, 0.999], 1))
    world = world_of(920)
    measured = ranges(world, 2, outliers=0.1)
    estimator, estimates = run(world, measured, replace(settings, horizon_s=60.0))
    rows, verdicts, nis = estimator.recent()
    gated = verdicts == 2
    assert gated.sum() == pytest.approx(0.1 * rows.size, rel=0.3)
    assert nis[gated].min() > chi2.ppf(0.999, 1) >= nis[~gated].max()
    error, _ = errors(world, estimates)
    assert np.sqrt(np.square(error[..., :2]).mean()) < 0.05


@ALL
def test_a_model_that_fails_is_gated_and_leaves_poses_finite(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    def predict(one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
        found = predict_range(one, observer, target)
        return found if one.landmark >= 0 else found._replace(value=np.array([np.nan]))

    world = world_of(930)
    monkeypatch.setitem(MODELS, RANGE.number, replace(RANGE, predict=predict))
    estimator, estimates = run(world, ranges(world, 3), settings)
    assert settled(estimator)["GATED"] > 300
    assert settled(estimator)["USED"] > 600
    error, covariance = errors(world, estimates)
    assert np.isfinite(error).all()
    assert np.isfinite(covariance).all()
    assert np.sqrt(np.square(error[..., :2]).mean()) < 0.1


def test_malformed_messages_are_counted_and_the_others_are_read() -> None:
    world = world_of(950)
    ingest = Ingest(world.swarm)
    handle = ingest.handle_of[f"{world.swarm.robots[0].name}/ranges"]
    good = LAYOUT.pack(T0, -1, 2.0)
    batch = MessageBatch.of([SerializedMessage(handle, one, T0) for one in (good, good[:7], b"", good)])
    (part,) = ingest.read(batch)
    assert part.rows["ranges"].distance.tolist() == [2.0, 2.0]
    assert part.dropped == {"bad_message": 2}
    (part,) = ingest.read(MessageBatch.of([SerializedMessage(handle, b"", T0)]))
    assert part.rows["ranges"].robot.size == 0


@pytest.mark.parametrize("place", ["decode", "columns", "measure", "measurements"])
def test_an_error_of_a_sensor_costs_its_own_readings_only_and_is_named(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> Any:
        raise ZeroDivisionError("by my sensor")

    class Broken(RangeSensor):
        pass

    if place == "measurements":
        nothing: Any = [None] * len(Measurements._fields)
        monkeypatch.setattr(Broken, "measure", lambda *_: Measurements(*nothing))
    else:
        monkeypatch.setattr(Broken, place, fail)
    monkeypatch.setitem(SENSORS, RangeSensor.name, Broken)
    world = world_of(960)
    measured = ranges(world, 5)
    error = "AttributeError" if place == "measurements" else "ZeroDivisionError"
    with pytest.warns(RuntimeWarning, match=f"the code of the sensor 'ranges' raised {error}"):
        estimator, estimates = run(world, measured, IN_ORDER)
    assert estimator.drops == {f"ranges_{error}": len(measured)}
    monkeypatch.setitem(SENSORS, RangeSensor.name, RangeSensor)
    np.testing.assert_array_equal(estimates[-1].poses, run(world, [], IN_ORDER)[1][-1].poses)


def test_a_sensor_without_any_message_in_a_bag_is_named() -> None:
    swarm = load_swarm(BAG / "swarm.yaml")
    summary = read_bag(BAG, swarm, lambda _: None, unwatched)
    assert [f"The bag holds no message on {robot.name}/ranges." for robot in swarm.robots] == [
        remark for remark in summary.remarks if "no message on" in remark
    ]
    assert not summary.unusable


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("model", 77),
        ("observer", 99),
        ("observer", -2),
        ("target", "observer"),
        ("target", 99),
        ("landmark", 99),
        ("landmark", -2),
        ("sensor", np.nan),
        ("marker", np.inf),
        ("stamp_variance", -1.0),
        ("gate", np.nan),
    ],
)
def test_measurements_that_no_model_can_use_are_dropped_and_counted(
    field: str, value: float | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Spoiled(RangeSensor):
        def measure(self, rows: RangeRows) -> Measurements:
            found = super().measure(rows)
            getattr(found, field)[:] = getattr(found, value) if isinstance(value, str) else value
            return found

    world = world_of(940)
    measured = ranges(world, 4)
    monkeypatch.setitem(SENSORS, RangeSensor.name, Spoiled)
    estimator, estimates = run(world, measured, IN_ORDER)
    assert estimator.drops["bad_measurement"] == len(measured)
    np.testing.assert_array_equal(estimates[-1].poses, run(world, [], IN_ORDER)[1][-1].poses)


@pytest.mark.parametrize("number", [*(one.number for one in MODELS.values() if one.predict), RANGE.number])
@pytest.mark.parametrize("seed", range(3))
def test_jacobians_of_all_models_agree_with_finite_differences(number: int, seed: int) -> None:
    model, rng, step = MODELS[number], np.random.default_rng(seed), 1e-6
    many = Measurements.empty(1)
    many.model[:], many.observer[:], many.target[:], many.has_heading[:] = number, 0, 1, True
    many.sensor[:], many.marker[:], poses = *rng.normal(size=(2, 1, 3)), rng.normal(size=(2, 3))
    many.height[:], many.reference[:] = rng.normal(size=2), rng.normal(size=3)
    one = many.row(0)
    predicted = model.predicted(one, *poses)
    assert 1 <= model.gated <= predicted.value.size <= 3
    for side, jacobian in enumerate((predicted.observer_jacobian, predicted.target_jacobian)):
        for j in range(3):
            moved = poses.copy()
            moved[side] = se2.compose(se2.exp(step * np.eye(3)[j]), moved[side])
            slope = model.innovation(model.predicted(one, *moved).value, predicted.value) / step
            np.testing.assert_allclose(jacobian[:, j], slope, atol=2e-5)


def test_a_model_whose_measurements_become_others_has_no_prediction() -> None:
    with pytest.raises(ValueError, match="measurements of the model 'scan' have no prediction"):
        MODELS[SCAN].predicted(Measurements.empty(1).row(0), np.zeros(3), np.zeros(3))


def test_a_number_stands_for_one_model() -> None:
    with pytest.raises(ValueError, match="the number 100 of the measurement model 'range' is not free"):
        register(RANGE)


@pytest.mark.parametrize("gated", [0, 4])
def test_a_model_gates_one_to_three_components(gated: int) -> None:
    with pytest.raises(ValueError, match=f"'range' gates {gated} components but must gate 1, 2 or 3"):
        register(replace(RANGE, number=101, gated=gated))
