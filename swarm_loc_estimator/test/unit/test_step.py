"""`Estimator.step`: seconds of readings in one call give the poses of a replay; what is wrong is named."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swarm_loc_estimator import (
    Anchor,
    Batch,
    Estimator,
    Robot,
    Settings,
    Swarm,
    UwbDevice,
    load_swarm,
    replay,
)
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.measurements import Measurements
from swarm_loc_estimator.filter.models import MODELS, RANGE, Prediction
from swarm_loc_estimator.offline.recorded_bag import read_bag, unwatched
from swarm_loc_estimator.sensors.inputs import SENSORS

BAG = Path(__file__).parents[3] / "bags" / "eight_one_robot_slow"
SECOND = 10**9
T = np.arange(0.0, 5.0, 0.1)
DRIVEN: dict[str, Any] = {"robot": "r1", "stamp_s": T, "pose": np.column_stack([0.1 * T, 0.0 * T, 0.0 * T])}
SWARM = Swarm((Robot("r1", start=(0.0, 0.0, 0.0)),))
SEEN = {"robot": 0, "stamp_s": T, "id": 7}
RANGED = {"robot": 0, "stamp_s": T, "range": 1.0}
NO_WHOLE_NUMBERS = "ranges: device must be whole numbers that fit into"


def recorded(until_s: float) -> tuple[Swarm, list[Batch], int]:
    swarm, parts = load_swarm(BAG / "swarm.yaml"), list[Batch]()
    read_bag(BAG, swarm, parts.append, unwatched)
    end_ns = parts[0].begin_ns + round(until_s * SECOND)
    first = [next(part.until_each(np.array([end_ns + 1]))) for part in parts if part.begin_ns <= end_ns]
    return swarm, first, end_ns


@pytest.mark.parametrize("with_arrivals", [True, False])
@pytest.mark.parametrize("sensors", [("odometry",), ("odometry", "detections")])
def test_five_seconds_in_one_call_give_the_poses_of_ticks_and_of_a_replay(
    sensors: tuple[str, ...], with_arrivals: bool
) -> None:
    swarm, parts, end_ns = recorded(5.0)
    stepped, ticking = Estimator(swarm), Estimator(swarm)
    columns: dict[str, Any] = {}
    for name in sensors:
        given = [part[name]._asdict() for part in parts]
        columns[name] = {key: np.concatenate([one[key] for one in given]) for key in given[0]}
        if not with_arrivals:
            del columns[name]["arrival_ns"]
    estimate, dropped = stepped.step(now_ns=end_ns, **columns)
    for part in parts:
        instants = np.arange(part.begin_ns, part.end_ns, SECOND // 10)
        for one, now_ns in zip(part.until_each(instants), [*instants.tolist(), part.end_ns], strict=True):
            ticking.receive(Batch(one.begin_ns, one.end_ns, {name: one[name] for name in sensors}))
            ticking.tick(now_ns)
    expected = ticking.tick(end_ns)
    assert len(columns["odometry"]["robot"]) > 100
    assert dropped == ticking.drops
    np.testing.assert_allclose(estimate.poses, expected.poses, atol=1e-9)
    np.testing.assert_allclose(estimate.covariances, expected.covariances, atol=1e-9)
    if "detections" in sensors:
        assert stepped.used == ticking.used > 10
        replayed = replay(BAG, swarm, stamp_ns=np.array([end_ns]))
        np.testing.assert_allclose(estimate.poses, replayed.poses[0], atol=1e-9)
        np.testing.assert_allclose(estimate.covariances, replayed.covariances[0], atol=1e-9)


def test_several_calls_give_what_one_gives_and_long_pauses_cost_nothing() -> None:
    expected = Estimator(SWARM).step(1.7e9 + 5.0, odometry=DRIVEN | {"stamp_s": 1.7e9 + T}).estimate
    estimator = Estimator(SWARM)
    for k in range(10):
        part = {"stamp_s": 1.7e9 + T[5 * k : 5 * k + 5], "pose": DRIVEN["pose"][5 * k : 5 * k + 5]}
        found = estimator.step(1.7e9 + 0.5 * (k + 1), odometry=DRIVEN | part).estimate
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-9)
    np.testing.assert_allclose(found.poses, [[0.5, 0.0, 0.0]], atol=1e-6)
    assert Estimator(SWARM).step(1.7e9, odometry=DRIVEN).dropped == {}  # readings of 1970


def test_late_readings_count_up_to_the_horizon_and_what_was_dropped_is_returned() -> None:
    def fix(stamp_s: float) -> dict[str, Any]:
        return {"robot": 0, "stamp_s": stamp_s, "pose": [[0.1 * stamp_s, 0.1, 0.0]], "covariance": noise}

    noise = [np.diag([1e-6, 1e-6, 1e-6])]
    estimator, in_order = Estimator(SWARM), Estimator(SWARM)
    assert estimator.step(5.0, odometry=DRIVEN).dropped == {}
    late, dropped = estimator.step(5.1, fixes=fix(3.5))
    assert dropped == {}
    expected = in_order.step(5.1, odometry=DRIVEN, fixes=fix(3.5)).estimate
    np.testing.assert_allclose(late.poses, expected.poses, atol=1e-9)
    assert late.poses[0, 1] > 0.05  # the fix at y = 0.1 was used
    again, dropped = estimator.step(5.2, fixes=fix(1.0))
    assert dropped == {"too_old": 1}
    never = in_order.step(5.2).estimate
    np.testing.assert_allclose(again.poses, never.poses, atol=1e-9)
    assert estimator.step(5.3, odometry=DRIVEN | {"pose": np.full((50, 3), np.nan)}).dropped == {
        "odometry_non_finite": 50
    }
    assert estimator.step(5.4).dropped == {}


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"odometri": DRIVEN}, f"there is no sensor 'odometri', only {', '.join(SENSORS)}"),
        ({"odometry": DRIVEN | {"robot": "r2"}}, "odometry: there is no robot or camera 'r2'"),
        ({"odometry": DRIVEN | {"robot": 1}}, "odometry: there is no robot or camera 1"),
        ({"odometry": DRIVEN | {"robot": -1}}, "odometry: there is no robot or camera -1"),
        ({"odometry": DRIVEN | {"robot": ["r1"] * 3}}, "odometry: robot has 3 values, not 50"),
        ({"odometry": {"stamp_s": T}}, "odometry: the column 'robot' is missing"),
        (
            {"odometry": {"robot": 0, "stamp_s": T}},
            "odometry: the column 'pose' is missing; columns are robot",
        ),
        ({"odometry": {"robot": 0}}, "odometry needs either the column 'stamp_s' or 'stamp_ns'"),
        ({"odometry": DRIVEN | {"stamp_ns": T}}, "odometry needs either the column 'stamp_s' or 'stamp_ns'"),
        ({"odometry": DRIVEN | {"stamp_s": T * np.nan}}, "odometry: stamp_s must be finite numbers"),
        ({"odometry": DRIVEN | {"pose": T}}, r"odometry: pose has shape \(50,\), not \(50, 3\)"),
        ({"odometry": DRIVEN | {"pose": "x"}}, "odometry: pose has wrong values: could not convert"),
        (
            {"odometry": DRIVEN | {"speed": T}},
            "odometry: no column 'speed'; columns are robot, stamp_ns, pose",
        ),
        ({"odometry": T}, "odometry must be columns by name, not"),
        ({"detections": SEEN}, "detections: the column 'position' is missing"),
        (
            {"detections": SEEN | {"position": np.zeros((50, 2))}},
            r"detections: position has shape \(50, 2\), not \(50, 3\)",
        ),
        ({"ranges": RANGED | {"device": 7.6}}, NO_WHOLE_NUMBERS),
        ({"ranges": RANGED | {"device": np.full(50, -7)}}, NO_WHOLE_NUMBERS),
        (
            {"ranges": RANGED | {"device": np.nan}},
            "ranges: device has wrong values: cannot convert float NaN",
        ),
        ({"ranges": RANGED | {"device": -1}}, "ranges: device has wrong values: Python integer"),
        ({"now_ns": 5 * SECOND}, "step needs either now_s or now_ns"),
        ({"now_s": np.nan}, "now_s must be finite, not nan"),
        ({"now_s": None}, "step needs either now_s or now_ns"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_is_taken(given: dict[str, Any], sentence: str) -> None:
    estimator = Estimator(SWARM)
    with pytest.raises(TypeError, match=f"^{sentence}"):
        estimator.step(**dict[str, Any]({"now_s": 5.0, "odometry": DRIVEN} | given))
    assert estimator.drops == {}
    assert estimator.step(5.0, odometry=DRIVEN).dropped == {}


def test_readings_after_a_jump_of_the_clock_are_used_as_at_first() -> None:
    estimator, expected = Estimator(SWARM), Estimator(SWARM).step(5.0, odometry=DRIVEN).estimate
    estimator.step(1005.0, odometry=DRIVEN | {"stamp_s": 1000.0 + T})
    found, dropped = estimator.step(5.0, odometry=DRIVEN)
    assert (dropped, estimator.time_jumps) == ({}, 1)
    np.testing.assert_array_equal(found.poses, expected.poses)


@pytest.mark.parametrize("stamp", [{"stamp_s": 1e12}, {"stamp_ns": np.array([2**63 + 5], np.uint64)}])
def test_a_stamp_beyond_all_clocks_is_in_the_future(stamp: dict[str, Any]) -> None:
    given = DRIVEN | {"pose": [[0.0, 0.0, 0.0]]} | stamp
    given = {name: given[name] for name in ("robot", "pose", *stamp)}
    assert Estimator(SWARM).step(5.0, odometry=given).dropped == {"future_stamp": 1}


def test_an_arrival_before_the_last_step_does_not_reset() -> None:
    estimator = Estimator(SWARM)
    estimator.step(5.0, odometry=DRIVEN)
    driven = {"robot": 0, "stamp_s": 5.1, "pose": [[0.5, 0.0, 0.0]], "arrival_ns": SECOND}
    assert estimator.step(5.2, odometry=driven).estimate.poses[0, 0] == pytest.approx(0.5, abs=0.01)
    assert estimator.time_jumps == 0


def test_scans_of_a_wrong_type_cost_only_themselves() -> None:
    estimator = Estimator(SWARM)
    with pytest.warns(RuntimeWarning, match="the code of the sensor 'scans' raised AttributeError"):
        found = estimator.step(5.0, odometry=DRIVEN, scans={"robot": 0, "stamp_s": 1.0, "scan": [5]})
    assert found.dropped == {"scans_AttributeError": 1}
    assert found.estimate.poses[0, 0] == pytest.approx(0.49, abs=0.02)


def test_what_was_dropped_before_is_counted_once_however_many_parts_there_are() -> None:
    estimator = Estimator(SWARM)
    estimator.receive_in_parts(Batch(0, 60 * SECOND, {}, dropped={"bad_message": 3}))
    assert estimator.drops == {"bad_message": 3}


def test_an_error_of_a_model_leaves_nothing_fused_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, model = 0, MODELS[RANGE]

    def predict(one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
        nonlocal calls
        calls += 1
        if calls == 20:
            raise ZeroDivisionError("once")
        assert model.predict is not None
        return model.predict(one, observer, target)

    robot = Robot("r1", start=(0.0, 0.0, 0.0), uwb=UwbDevice(1, range_sigma=0.05))
    swarm, settings = Swarm((robot,), anchors=(Anchor(10, 5.0, 0.0),)), Settings(horizon_s=60.0)
    ranges = {"robot": 0, "stamp_s": T, "device": 10, "range": 5.0 - DRIVEN["pose"][:, 0]}
    expected = Estimator(swarm, settings).step(5.0, odometry=DRIVEN, ranges=ranges).estimate
    estimator = Estimator(swarm, settings)
    monkeypatch.setitem(MODELS, RANGE, replace(model, predict=predict))
    with pytest.raises(ZeroDivisionError):
        estimator.step(5.0, odometry=DRIVEN, ranges=ranges)
    np.testing.assert_array_equal(estimator.step(5.0).estimate.covariances, expected.covariances)


def test_a_command_comes_after_the_measurements_of_its_instant_and_waiting_ones_are_counted() -> None:
    estimator = Estimator(SWARM)
    fix = {"robot": 0, "stamp_s": 4.55, "pose": [[0.45, 0.0, 0.0]], "covariance": [np.eye(3) * 1e-4]}
    estimator.step(4.9, odometry=DRIVEN, fixes=fix)
    estimator.set_pose(0, round(4.55 * SECOND), (2.0, 0.0, 0.0), np.eye(3) * 1e-2)
    assert estimator.step(4.9).estimate.poses[0, 0] > 1.9
    estimator.forget(0, 4 * SECOND)
    estimator.reset()
    assert estimator.drops["reset"] == 1


def test_a_replay_with_rare_outputs_uses_all_data() -> None:
    often, rarely = replay(BAG), replay(BAG, tick_s=5.0)
    same = np.isin(rarely.stamp_ns, often.stamp_ns)
    assert same.sum() > 3
    expected = often.poses[np.isin(often.stamp_ns, rarely.stamp_ns)]
    np.testing.assert_allclose(rarely.poses[same], expected, atol=1e-9)
    assert "too_old" not in rarely.counters
