"""A sensor added from outside the product, that of the example, and the Jacobians of all models."""

import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_messages import SECOND, T0
from core_run import play, settled, ticks
from core_world import Plan, World, simulate
from own_sensor import BEACONS, SIGMA_M, BeaconRows, BeaconSensor
from scipy.stats import chi2

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements, Verdict
from swarm_loc_estimator.filter.models import MODELS, Prediction
from swarm_loc_estimator.filter.models import register as register_model
from swarm_loc_estimator.offline.recorded_bag import read_bag, unwatched
from swarm_loc_estimator.sensors.inputs import SENSORS, Ingest, register
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings

BAG = Path(__file__).parents[3] / "bags" / "eight_one_robot_slow"
LAYOUT = struct.Struct("<qqd")
del SENSORS[BeaconSensor.name], MODELS[BeaconSensor.model]  # known in these tests only


class RobotsToo(BeaconSensor):
    """Distances to beacons, and to robots: beacon -1 - k is on robot k."""

    name = topic = "distances"

    def measure(self, rows: BeaconRows) -> Measurements:
        """Convert readings (k,)."""
        out = super().measure(rows._replace(beacon=np.maximum(rows.beacon, 0)))
        out.reading[:], out.target[:] = rows.beacon, np.maximum(-1 - rows.beacon, NOBODY)
        return out

    @staticmethod
    def predict(one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
        """Predict the distance."""
        if one.target == NOBODY:
            return BeaconSensor.predict(one, observer, target)
        found = BeaconSensor.predict(one._replace(marker=target), observer, target)
        (ux, uy, _), (x, y, _) = -found.observer_jacobian[0], target
        return found._replace(target_jacobian=np.array([[ux, uy, uy * x - ux * y]]))


Reading = tuple[int, bytes, int]  # Robot, message, stamp [ns]
IN_ORDER = Settings(fusion_period_s=0.0)
TOGETHER = Settings(fusion_period_s=0.2, policy=Policy(large_from=1, batch_from=2))
SPARSE = Settings(fusion_period_s=0.2, sparse_from=2)
ALL = pytest.mark.parametrize("settings", [IN_ORDER, TOGETHER, SPARSE], ids=["order", "batch", "sparse"])


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    register(RobotsToo)
    yield
    del SENSORS[RobotsToo.name], MODELS[RobotsToo.model]


def world_of(seed: int) -> World:
    """Robots that see nothing."""
    return simulate(Plan(4, 16.0, reach=0.0), seed)


def distances(world: World, seed: int, outliers: float = 0.0) -> list[Reading]:
    """Distances of all robots to two beacons and to the next robot, five times a second."""
    rng, found = np.random.default_rng([seed, 9]), []
    for k in range(4, world.stamp_ns.size, 4):
        for robot in range(len(world.swarm.robots)):
            other = (robot + 1) % len(world.swarm.robots)
            for beacon in (1, 2, -1 - other):
                there = BEACONS[beacon] if beacon > 0 else world.truth[k, other, :2]
                distance = np.hypot(*(there - world.truth[k, robot, :2])) + rng.normal(0.0, SIGMA_M)
                distance += 1.0 if rng.uniform() < outliers else 0.0
                stamp_ns = int(world.stamp_ns[k])
                found.append((robot, LAYOUT.pack(stamp_ns, beacon, distance), stamp_ns))
    return found


def run(
    world: World, measured: list[Reading], settings: Settings = IN_ORDER, late_s: float = 0.0
) -> tuple[Estimator, list[Estimate]]:
    """A world with readings, all of which are late by up to so much."""
    rng, estimator, ingest = np.random.default_rng(0), Estimator(world.swarm, settings), Ingest(world.swarm)
    events = [(e.stamp_ns + int(rng.uniform(0.0, late_s) * SECOND), e) for e in world.events]
    handles = [ingest.handle_of[f"{robot.name}/distances"] for robot in world.swarm.robots]
    messages = [
        SerializedMessage(handles[robot], data, stamp_ns + int(rng.uniform(0.0, late_s) * SECOND))
        for robot, data, stamp_ns in measured
    ]
    messages.sort(key=lambda message: message.log_ns)
    estimates, begin_ns = [], T0 - 1
    for now_ns in ticks(T0, int(world.stamp_ns[-1]) + 2 * SECOND, 0.25):
        arrived = [one for one in messages if begin_ns < one.log_ns <= now_ns]
        for part in ingest.read(MessageBatch.of(arrived)):
            estimator.receive(part)
        estimates += play(estimator, [(t, e) for t, e in events if begin_ns < t <= now_ns], [now_ns])
        begin_ns = now_ns
    return estimator, estimates


def errors(world: World, estimates: list[Estimate]) -> tuple[FloatArray, FloatArray]:
    """Errors (T, N, 3) and covariances (T, N, 3, 3) at whole seconds of the world."""
    whole = [e for e in estimates if e.stamp_ns % SECOND == 0 and e.stamp_ns <= world.stamp_ns[-1]][4:]
    error = wrapped(np.array([e.poses - world.at(e.stamp_ns) for e in whole]))
    return error, np.array([e.covariances for e in whole])


def rms(error: FloatArray) -> float:
    """Root mean square of both components of positions."""
    return float(np.sqrt(np.square(error[..., :2]).mean()))


@ALL
def test_distances_make_poses_better_and_the_errors_stay_as_large_as_the_covariances_say(
    settings: Settings,
) -> None:
    squared, measured, blind = [], [], []
    for seed in range(4):
        world = world_of(900 + seed)
        estimator, estimates = run(world, distances(world, seed), settings)
        error, covariance = errors(world, estimates)
        assert settled(estimator)["USED"] > 900
        squared.append(nees(error, covariance).mean(axis=0))
        measured.append(rms(error))
        blind.append(rms(errors(world, run(world, [], settings)[1])[0]))
    assert np.linalg.norm(measured) < 0.4 * np.linalg.norm(blind)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 3 * np.size(squared)) / np.size(squared)
    assert low < np.mean(squared) < high


@ALL
def test_late_and_shuffled_readings_give_the_same(settings: Settings) -> None:
    world = world_of(910)
    measured = distances(world, 1)
    expected = run(world, measured, settings)[1][-1]
    found = run(world, measured, settings, late_s=1.5)[1][-1]
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-9)
    np.testing.assert_allclose(found.covariances, expected.covariances, atol=1e-9)


@ALL
def test_outliers_are_gated_with_the_one_degree_of_freedom_of_the_model(settings: Settings) -> None:
    np.testing.assert_allclose(MODELS[RobotsToo.model].gate([0.95, 0.999]), chi2.ppf([0.95, 0.999], 1))
    world = world_of(920)
    estimator, estimates = run(world, distances(world, 2, outliers=0.1), replace(settings, horizon_s=60.0))
    rows, verdicts, nis = estimator.recent()
    gated = verdicts == Verdict.GATED
    assert gated.sum() == pytest.approx(0.1 * rows.size, rel=0.3)
    assert nis[gated].min() > chi2.ppf(RobotsToo.gate_probability, 1) >= nis[~gated].max()
    assert rms(errors(world, estimates)[0]) < 0.05


@ALL
def test_a_model_that_fails_is_gated_and_leaves_poses_finite(settings: Settings) -> None:
    def predict(one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
        found = RobotsToo.predict(one, observer, target)
        return found if one.target == NOBODY else found._replace(value=np.array([np.nan]))

    world, model = world_of(930), MODELS[RobotsToo.model]
    MODELS[RobotsToo.model] = replace(model, predict=predict)
    estimator, estimates = run(world, distances(world, 3), settings)
    assert settled(estimator)["GATED"] > 300
    assert settled(estimator)["USED"] > 600
    error, covariance = errors(world, estimates)
    assert np.isfinite(error).all()
    assert np.isfinite(covariance).all()
    assert rms(error) < 0.1


def test_malformed_messages_are_counted_and_the_others_are_read() -> None:
    world = world_of(950)
    ingest = Ingest(world.swarm)
    handle = ingest.handle_of[f"{world.swarm.robots[0].name}/distances"]
    good = LAYOUT.pack(T0, 1, 2.0)
    batch = MessageBatch.of([SerializedMessage(handle, one, T0) for one in (good, good[:7], b"", good)])
    (part,) = ingest.read(batch)
    assert part["distances"].distance.tolist() == [2.0, 2.0]
    assert part.dropped == {"bad_message": 2}
    (part,) = ingest.read(MessageBatch.of([SerializedMessage(handle, b"", T0)]))
    assert part["distances"].robot.size == 0


def fail(*_: object) -> Any:
    raise ZeroDivisionError("by my sensor")


@pytest.mark.parametrize(
    ("method", "broken", "error"),
    [
        ("decode", staticmethod(fail), "ZeroDivisionError"),
        ("columns", staticmethod(fail), "ZeroDivisionError"),
        ("measure", fail, "ZeroDivisionError"),
        ("measure", lambda _, rows: rows, "TypeError: measure must return Measurements, not BeaconRows"),
        ("measure", lambda *_: None, "TypeError: measure must return Measurements, not NoneType"),
    ],
)
def test_an_error_of_a_sensor_costs_its_own_readings_only_and_is_named(
    method: str, broken: Callable[..., Any], error: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = world_of(960)
    measured, expected = distances(world, 5), run(world, [])[1][-1]
    monkeypatch.setattr(RobotsToo, method, broken)
    with pytest.warns(RuntimeWarning, match=f"'distances' raised {error}"):
        estimator, estimates = run(world, measured)
    assert estimator.drops == {f"distances_{error.partition(':')[0]}": len(measured)}
    np.testing.assert_array_equal(estimates[-1].poses, expected.poses)


def test_a_sensor_without_any_message_in_a_bag_is_named() -> None:
    swarm = load_swarm(BAG / "swarm.yaml")
    summary = read_bag(BAG, swarm, lambda _: None, unwatched)
    assert [f"The bag holds no message on {robot.name}/distances." for robot in swarm.robots] == [
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
        ("height", np.nan),
        ("reference", np.inf),
        ("stamp_variance", -1.0),
        ("gate", np.nan),
    ],
)
def test_measurements_that_no_model_can_use_are_dropped_and_counted(
    field: str, value: float | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    measure = RobotsToo.measure

    def spoiled(self: RobotsToo, rows: BeaconRows) -> Measurements:
        found = measure(self, rows)
        getattr(found, field)[:] = getattr(found, value) if isinstance(value, str) else value
        return found

    monkeypatch.setattr(RobotsToo, "measure", spoiled)
    world = world_of(940)
    measured = distances(world, 4)
    estimator, estimates = run(world, measured)
    assert estimator.drops["bad_measurement"] == len(measured)
    np.testing.assert_array_equal(estimates[-1].poses, run(world, [])[1][-1].poses)


@pytest.mark.parametrize(
    "name", [*(model.name for model in MODELS.values() if model.predict is not None), RobotsToo.name]
)
@pytest.mark.parametrize("seed", range(3))
def test_jacobians_of_all_models_agree_with_finite_differences(name: str, seed: int) -> None:
    (model,) = [model for model in MODELS.values() if model.name == name]
    rng, step, one = np.random.default_rng(seed), 1e-6, Measurements.empty(1)
    one.model[:], one.observer[:], one.target[:], one.has_heading[:] = model.number, 0, 1, True
    for column in (one.sensor, one.marker, one.height, one.reference):
        column[:] = rng.normal(size=column.shape)
    poses, row = rng.normal(size=(2, 3)), one.row(0)
    predicted = model.predicted(row, *poses)
    assert 1 <= model.gated <= predicted.value.size <= 3
    for side, jacobian in enumerate((predicted.observer_jacobian, predicted.target_jacobian)):
        for j in range(3):
            moved = poses.copy()
            moved[side] = se2.compose(se2.exp(step * np.eye(3)[j]), moved[side])
            slope = model.innovation(model.predicted(row, *moved).value, predicted.value) / step
            np.testing.assert_allclose(jacobian[:, j], slope, atol=2e-5)


def test_a_name_stands_for_one_sensor_and_a_number_for_one_model() -> None:
    with pytest.raises(ValueError, match="there is a sensor 'distances' already"):
        register(RobotsToo)
    number = RobotsToo.model
    with pytest.raises(ValueError, match=f"the number {number} of the measurement model 'distances' is not"):
        register_model(MODELS[number])


@pytest.mark.parametrize("gated", [0, 4])
def test_a_model_gates_one_to_three_components(gated: int) -> None:
    with pytest.raises(ValueError, match=f"'distances' gates {gated} components but must gate 1, 2 or 3"):
        register_model(replace(MODELS[RobotsToo.model], number=2000, gated=gated))
