"""The sensor of the example, added from outside the product: in every filter, in any order, its errors."""

import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_messages import SECOND, T0
from core_run import ALL, IN_ORDER, play_messages, settled, ticks
from core_world import Plan, World, simulate
from own_sensor import BEACONS, SIGMA_M, BeaconRows, BeaconSensor
from scipy.stats import chi2

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.streams import SerializedMessage
from swarm_loc_estimator.filter.measurements import Measurements, Verdict
from swarm_loc_estimator.filter.models import MODELS, Prediction
from swarm_loc_estimator.filter.models import register as register_model
from swarm_loc_estimator.sensors.inputs import SENSORS, Ingest, register
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.settings import Settings

del SENSORS[BeaconSensor.name], MODELS[BeaconSensor.model]  # known in these tests only


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    register(BeaconSensor)
    yield
    del SENSORS[BeaconSensor.name], MODELS[BeaconSensor.model]


def run(
    world: World,
    settings: Settings = IN_ORDER,
    late_s: float = 0.0,
    outliers: float = 0.0,
    *,
    blind: bool = False,
) -> tuple[Estimator, list[Estimate]]:
    """Robots that see two beacons five times a second, or nothing; all is late by up to so much."""
    rng, late = np.random.default_rng(9), np.random.default_rng(0)
    estimator, ingest, messages = Estimator(world.swarm, settings), Ingest(world.swarm), []
    for k in range(4, 0 if blind else world.stamp_ns.size, 4):
        for robot, one in enumerate(world.swarm.robots):
            for beacon in (1, 2):
                distance = np.hypot(*(BEACONS[beacon] - world.truth[k, robot, :2])) + rng.normal(0.0, SIGMA_M)
                distance += 1.0 if rng.uniform() < outliers else 0.0
                stamp_ns = int(world.stamp_ns[k])
                data, arrival_ns = struct.pack("<qqd", stamp_ns, beacon, distance), late.uniform(0.0, late_s)
                handle = ingest.handle_of[f"{one.name}/beacons"]
                messages.append(SerializedMessage(handle, data, stamp_ns + int(arrival_ns * SECOND)))
    events = [(e.stamp_ns + int(late.uniform(0.0, late_s) * SECOND), e) for e in world.events]
    ticks_ns = ticks(T0, int(world.stamp_ns[-1]) + 2 * SECOND, 0.25)
    return estimator, play_messages(estimator, ingest, messages, events, ticks_ns)


def world_of(seed: int, duration_s: float = 16.0) -> World:
    return simulate(Plan(4, duration_s, reach=0.0), seed)


def errors(world: World, estimates: list[Estimate]) -> tuple[FloatArray, FloatArray]:
    """Errors (T, N, 3) and covariances (T, N, 3, 3) at whole seconds of the world."""
    whole = [e for e in estimates if e.stamp_ns % SECOND == 0 and e.stamp_ns <= world.stamp_ns[-1]][4:]
    error = wrapped(np.array([e.poses - world.at(e.stamp_ns) for e in whole]))
    return error, np.array([e.covariances for e in whole])


@ALL
def test_errors_are_as_large_as_the_covariances_say(settings: Settings) -> None:
    worlds = [world_of(900 + seed) for seed in range(4)]
    squared = [nees(*errors(world, run(world, settings)[1])).mean(axis=0) for world in worlds]
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 3 * np.size(squared)) / np.size(squared)
    assert low < np.mean(squared) < high


@ALL
def test_late_and_shuffled_readings_give_the_same(settings: Settings) -> None:
    world = world_of(910)
    (*_, expected), (*_, found) = (run(world, settings, late_s)[1] for late_s in (0.0, 1.5))
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-9)
    np.testing.assert_allclose(found.covariances, expected.covariances, atol=1e-9)


@ALL
def test_outliers_are_gated_with_the_one_degree_of_freedom_of_the_model(settings: Settings) -> None:
    estimator, _ = run(world_of(920), replace(settings, horizon_s=60.0), outliers=0.1)
    rows, verdicts, nis = estimator.recent()
    gated = verdicts == Verdict.GATED
    assert gated.sum() == pytest.approx(0.1 * rows.size, rel=0.3)
    assert nis[gated].min() > chi2.ppf(BeaconSensor.gate_probability, 1) >= nis[~gated].max()


@ALL
def test_a_model_that_fails_is_gated_and_leaves_poses_finite(settings: Settings) -> None:
    def predict(one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
        found = BeaconSensor.predict(one, observer, target)
        return found if one.reading == 1 else found._replace(value=np.array([np.nan]))

    MODELS[BeaconSensor.model] = replace(MODELS[BeaconSensor.model], predict=predict)
    world = world_of(930)
    estimator, estimates = run(world, settings)
    assert min(settled(estimator)["GATED"], settled(estimator)["USED"]) > 250
    assert all(np.isfinite(part).all() for part in errors(world, estimates))


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
    world = world_of(960, 2.0)
    monkeypatch.setattr(BeaconSensor, method, broken)
    with pytest.warns(RuntimeWarning, match=f"'beacons' raised {error}"):
        estimator, estimates = run(world)
    assert estimator.drops == {f"beacons_{error.partition(':')[0]}": 80}
    np.testing.assert_array_equal(estimates[-1].poses, run(world, blind=True)[1][-1].poses)


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
    measure = BeaconSensor.measure

    def spoiled(self: BeaconSensor, rows: BeaconRows) -> Measurements:
        found = measure(self, rows)
        getattr(found, field)[:] = getattr(found, value) if isinstance(value, str) else value
        return found

    monkeypatch.setattr(BeaconSensor, "measure", spoiled)
    world = world_of(940, 2.0)
    estimator, estimates = run(world)
    assert estimator.drops == {"bad_measurement": 80}
    np.testing.assert_array_equal(estimates[-1].poses, run(world, blind=True)[1][-1].poses)


def test_a_name_stands_for_one_sensor_and_a_number_for_one_model() -> None:
    with pytest.raises(ValueError, match="there is a sensor 'beacons' already"):
        register(BeaconSensor)
    model = MODELS[BeaconSensor.model]
    with pytest.raises(
        ValueError, match=f"the number {model.number} of the measurement model 'beacons' is not"
    ):
        register_model(model)
    for gated in (0, 4):
        with pytest.raises(ValueError, match=f"'beacons' gates {gated} components but must gate 1, 2 or 3"):
            register_model(replace(model, number=2000, gated=gated))
