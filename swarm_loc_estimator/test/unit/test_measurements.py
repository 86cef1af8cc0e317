"""Columns of measurements, and the buffer that keeps them."""

import gc
import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from core_geometry import planar, pose_of
from core_messages import T0
from core_run import on_time, play, settled, ticks
from core_world import Plan, simulate
from hypothesis import given
from hypothesis import strategies as st
from ir_world import droplet, random_poses, readings_of
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]
from numba.core.runtime.nrt import rtsys

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import inlined_njit, norefcount_njit
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements, concatenate, select
from swarm_loc_estimator.filter.models import CARTESIAN, MODELS, POLAR, predict, write_innovation
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings
from swarm_loc_estimator.timeline.timeline import MeasurementBuffer

WHO = {"landmark": (0, NOBODY), "surveyed": (0, NOBODY), "robot": (0, 1), "fix": (NOBODY, 1)}
"""Observer and target; the place of the landmark "surveyed" is estimated."""


def measurement(
    who: str, model: int, sensor: FloatArray, marker: FloatArray, heading: int = 1
) -> Measurements:
    one = Measurements.empty(1)
    one.observer[:], one.target[:] = WHO[who]
    one.landmark[:] = 0 if who == "surveyed" else NOBODY
    one.model[:], one.has_heading[:], one.sensor[:], one.marker[:] = model, heading, sensor, marker
    return one


def chain(
    who: str, observer: FloatArray, target: FloatArray, sensor: FloatArray, marker: FloatArray
) -> FloatArray:
    """(X_observer S)^-1 (X_target M) by homogeneous matrices; eq. (3) for landmarks, (5) for robots."""
    camera = planar(sensor) if who == "fix" else planar(observer) @ planar(sensor)
    mark = planar(marker) if who == "landmark" else planar(target) @ planar(marker)
    return pose_of(np.linalg.inv(camera) @ mark)


@dataclass
class Scene:
    """Poses (3,) of two robots in map, of a sensor on the one and a marker on the other."""

    observer: FloatArray
    target: FloatArray
    sensor: FloatArray
    marker: FloatArray


def scene(seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(-3, 3, (4, 2)), rng.uniform(-np.pi, np.pi, 4)])
    return Scene(*poses)


def predicted(who: str, model: int, s: Scene, heading: int = 1) -> tuple[FloatArray, FloatArray]:
    value, jacobian = predict(
        measurement(who, model, s.sensor, s.marker, heading), s.observer[None], s.target[None]
    )
    return value[0], jacobian[0]


def wrapped(angle: float) -> float:
    return math.atan2(math.sin(angle), math.cos(angle))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("who", WHO)
def test_the_model_is_the_transform_chain(who: str, seed: int) -> None:
    s = scene(seed)
    expected = chain(who, s.observer, s.target, s.sensor if who != "fix" else np.zeros(3), s.marker)
    if who == "fix":
        s.sensor = np.zeros(3)
    value, _ = predicted(who, CARTESIAN, s)
    np.testing.assert_allclose(value[:2], expected[:2], atol=1e-12)
    assert wrapped(value[2] - expected[2]) == pytest.approx(0.0, abs=1e-12)
    value, _ = predicted(who, POLAR, s)
    assert value[0] == pytest.approx(math.hypot(*expected[:2]), abs=1e-12)
    assert wrapped(value[1] - math.atan2(expected[1], expected[0])) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("number", "who"),
    [
        (CARTESIAN, "surveyed"),
        (POLAR, "surveyed"),
        *((number, "robot") for number, model in MODELS.items() if model.predict is not None),
    ],
)
@pytest.mark.parametrize("heading", [0, 1])
@pytest.mark.parametrize("seed", range(3))
def test_jacobians_of_all_models_agree_with_finite_differences(
    number: int, who: str, heading: int, seed: int
) -> None:
    model, rng, step = MODELS[number], np.random.default_rng(seed), 1e-6
    sensor, marker = rng.normal(size=(2, 3))
    one = measurement(who, number, sensor, marker, heading)
    one.height[:], one.reference[:] = rng.normal(size=one.height.shape), rng.normal(size=one.reference.shape)
    poses, row = rng.normal(size=(2, 3)), one.row(0)
    predicted = model.predicted(row, *poses)
    assert 1 <= model.gated <= predicted.value.size <= 3
    for side, jacobian in enumerate((predicted.observer_jacobian, predicted.target_jacobian)):
        for j in range(3):
            moved = poses.copy()
            moved[side] = se2.compose(se2.exp(step * np.eye(3)[j]), moved[side])
            slope = model.innovation(model.predicted(row, *moved).value, predicted.value) / step
            slope[2:] *= heading
            np.testing.assert_allclose(jacobian[:, j], slope, atol=2e-5)


@pytest.mark.parametrize("heading", [0, 1])
@pytest.mark.parametrize("model", [CARTESIAN, POLAR])
@pytest.mark.parametrize("who", ["landmark", "surveyed", "robot"])
@pytest.mark.parametrize("seed", range(4))
def test_the_camera_may_be_turned_and_stretch_or_lengthen_distances(
    who: str, model: int, heading: int, seed: int
) -> None:
    s, camera, step = scene(seed), np.array([0.2, 0.1, 0.05]), 1e-6
    one = select(measurement(who, model, s.sensor, s.marker, heading), np.zeros(7, dtype=np.int64))
    errors = camera + step * np.vstack([np.kron(np.eye(3), [[1], [-1]]), np.zeros((1, 3))])
    value, jacobian = predict(one, s.observer[None].repeat(7, 0), s.target[None].repeat(7, 0), errors)
    for column in range(3):
        slope = value[2 * column] - value[2 * column + 1]
        slope[1:] = [wrapped(slope[1]) if model == POLAR else slope[1], wrapped(slope[2]) * heading]
        np.testing.assert_allclose(slope / (2 * step), jacobian[6, :, 3 + column], atol=2e-8, rtol=1e-6)
    s.sensor[2] += camera[0]
    expected, _ = predicted(who, model, s, heading)
    expected[: 2 if model == CARTESIAN else 1] *= 1.0 + camera[1]
    expected[0] += camera[2] if model == POLAR else 0.0
    np.testing.assert_allclose(value[6], expected, atol=1e-12)


def test_a_marker_at_the_sensor_itself_has_finite_numbers() -> None:
    value, jacobian = predict(
        measurement("landmark", POLAR, np.zeros(3), np.array([1.0, 2.0, 0.0])),
        np.array([[1.0, 2.0, 0.5]]),
        np.zeros((1, 3)),
    )
    assert np.isfinite(value).all()
    assert np.isfinite(jacobian).all()


def equation_6(o: FloatArray, s: FloatArray, x_c: float, m: FloatArray, sign: float) -> FloatArray:
    """Eq. (6) of a marker m on robot s seen by robot o: as printed with signs of -1, right with 1."""
    cos, sin = np.cos(o[2]), np.sin(o[2])
    x_so, y_so, th_so = s[0] - o[0], s[1] - o[1], s[2] - o[2]
    cos_so, sin_so = np.cos(th_so), np.sin(th_so)
    z = x_so * cos + sign * y_so * sin - x_c + m[0] * cos_so - sign * m[1] * sin_so
    x = y_so * cos - x_so * sin + m[1] * cos_so + sign * m[0] * sin_so
    return np.array([z, x])


@pytest.mark.parametrize("seed", range(5))
def test_the_printed_eq_6_is_wrong_and_its_corrected_signs_are_right(seed: int) -> None:
    s = scene(seed)
    s.sensor, s.marker = np.array([0.04, 0.0, 0.0]), np.array([0.03, 0.02, 1.0])
    value, _ = predicted("robot", CARTESIAN, s)
    printed, right = (equation_6(s.observer, s.target, 0.04, s.marker, sign) for sign in (-1.0, 1.0))
    np.testing.assert_allclose(value[:2], right, atol=1e-12)
    assert np.abs(value[:2] - printed).max() > 1e-3


@pytest.mark.parametrize(
    ("model", "has_heading", "measured", "predicted_value", "expected"),
    [
        (CARTESIAN, 1, (1.0, 4.0, 3.1), (0.5, -4.0, -3.1), (0.5, 8.0, 6.2 - 2 * math.pi)),
        (CARTESIAN, 0, (1.0, 4.0, 3.1), (0.5, -4.0, -3.1), (0.5, 8.0, 0.0)),
        (POLAR, 1, (1.0, -3.1, -3.0), (0.5, 3.1, 3.0), (0.5, 2 * math.pi - 6.2, 2 * math.pi - 6.0)),
        (POLAR, 0, (1.0, 7.0, 0.0), (9.0, 0.5, 3.0), (-8.0, 6.5 - 2 * math.pi, 0.0)),
    ],
)
def test_innovations_wrap_angles_and_leave_out_headings_not_measured(
    model: int,
    has_heading: int,
    measured: tuple[float, ...],
    predicted_value: tuple[float, ...],
    expected: tuple[float, ...],
) -> None:
    one = measurement("landmark", model, np.zeros(3), np.zeros(3), has_heading)
    out = np.empty(3)
    write_innovation(one, 0, np.array(measured), np.array(predicted_value), out)
    np.testing.assert_allclose(out, expected, atol=1e-12)


def test_columns_of_many_measurements_are_contiguous_as_those_of_one_are() -> None:
    many = Measurements.empty(3)
    parts = [select(many, some) for some in (slice(1, 3), many.stamp_ns == 0, np.array([2, 0]))]
    for columns in (many, *parts, many.row(1).columns(), concatenate(parts)):
        assert all(column.flags.c_contiguous for column in columns)  # else all is compiled again for one


Row = tuple[int, int, int, float]
ROW = st.tuples(
    st.integers(-20, 20), st.integers(-1, 2), st.integers(0, 2), st.sampled_from([-1.0, 0.0, 1.5])
)


def measurements(rows: list[Row]) -> Measurements:
    many = Measurements.empty(len(rows))
    for k, (stamp_ns, observer, reading, value) in enumerate(rows):
        many.stamp_ns[k], many.observer[k], many.reading[k] = stamp_ns, observer, reading
        many.value[k, 1] = value
    return many


def in_bytes(measurements: Measurements) -> bytes:
    return b"".join(column.tobytes() for column in measurements)


@given(st.lists(st.lists(ROW, max_size=8), max_size=8), st.randoms())
def test_any_order_gives_the_same_each_once(parts: list[list[Row]], order: random.Random) -> None:
    rows = [row for part in parts for row in part]
    buffer, other = MeasurementBuffer(), MeasurementBuffer()
    known: set[Row] = set()
    for part in parts:
        count, first_ns = buffer.merge(measurements(part))
        new = set(part) - known
        assert count == len(new)
        assert first_ns == min((row[0] for row in new), default=None)
        known |= new
    order.shuffle(rows)
    for row in rows:
        other.merge(measurements([row]))
    assert in_bytes(buffer.part(0, len(buffer))) == in_bytes(other.part(0, len(other)))
    assert len(buffer) == len(known)
    assert buffer.stamp_ns.tolist() == sorted(row[0] for row in known)
    np.testing.assert_array_equal(buffer.part(0, len(buffer)).stamp_ns, buffer.stamp_ns)


@given(st.lists(st.lists(ROW, max_size=8), max_size=8))
def test_what_was_computed_goes_with_its_measurement(parts: list[list[Row]]) -> None:
    """It is read while what has come since is fused, which takes a while."""
    buffer = MeasurementBuffer()
    computed: dict[bytes, tuple[int, float]] = {}
    for part in parts:
        buffer.merge(measurements(part))
        for k in range(len(buffer)):
            row = in_bytes(buffer.part(k, k + 1).row(0))
            verdict, nis = computed.setdefault(row, (0, np.nan))
            assert buffer.verdicts[k] == verdict
            np.testing.assert_equal(buffer.nis[k], nis)
            buffer.verdicts[k], buffer.nis[k] = 1 + len(computed) % 3, float(len(computed))
            computed[row] = int(buffer.verdicts[k]), float(buffer.nis[k])


@pytest.mark.parametrize("name", Measurements._fields)
def test_each_column_moves_with_its_measurement_and_tells_two_apart_but_the_arrival(name: str) -> None:
    pair, earlier, buffer = Measurements.empty(2), Measurements.empty(1), MeasurementBuffer()
    getattr(pair, name)[1] = 1 - getattr(pair, name)[1].astype(int)
    count, _ = buffer.merge(pair)
    assert count == (1 if name == "arrival_ns" else 2)
    before = in_bytes(buffer.part(0, count))
    earlier.stamp_ns[:] = -1
    buffer.merge(earlier)
    assert in_bytes(buffer.part(1, count + 1)) == before
    assert in_bytes(buffer.part(0, 1)) == in_bytes(earlier)


def test_what_was_computed_stays_with_what_lies_before_and_space_is_used_again() -> None:
    buffer = MeasurementBuffer()
    for lap in range(200):
        buffer.merge(measurements([(100 * lap + k, 0, 0, 0.0) for k in range(100)]))
        buffer.nis[-100:] = lap
        buffer.verdicts[-100:] = lap % 3
        if lap >= 5:
            buffer.drop_first(100)
            assert buffer.nis.tolist() == [float(k) for k in range(lap - 4, lap + 1) for _ in range(100)]
            assert buffer.verdicts.tolist() == [k % 3 for k in range(lap - 4, lap + 1) for _ in range(100)]
    assert buffer.stamp_ns.tolist() == [*range(19500, 20000)]
    assert buffer._columns.size < 5000


@pytest.fixture
def counted() -> Iterator[None]:
    """Numba counts what it allocates and frees."""
    _nrt_python.memsys_enable_stats()
    yield
    _nrt_python.memsys_disable_stats()


def held() -> int:
    """How many arrays compiled code holds, beyond those of before it counted."""
    gc.collect()
    stats = rtsys.get_allocation_stats()  # type: ignore[no-untyped-call]
    return int(stats.mi_alloc - stats.mi_free)


@pytest.mark.usefixtures("counted")
@pytest.mark.parametrize("many", [3, 1000])
def test_a_run_leaves_no_array_behind(many: int) -> None:
    """Of measurements used together, and one by one."""
    world = simulate(Plan(3, 4.0), 1)
    counts = []
    for _ in range(3):
        estimator = Estimator(world.swarm, Settings(policy=Policy(large_from=1, batch_from=many)))
        play(estimator, on_time(world), ticks(T0, int(world.stamp_ns[-1])))
        assert settled(estimator)["USED"] > 20
        del estimator
        counts.append(held())
    assert counts[0] == counts[1] == counts[2]


@pytest.mark.usefixtures("counted")
@pytest.mark.parametrize("element_sigma", [0.0, 0.1])
def test_solving_pairs_leaves_no_array_behind(element_sigma: float) -> None:
    """Neither of calls nor of pairs."""
    estimator = MaximumLikelihood(droplet(element_sigma))
    readings = readings_of(droplet(), random_poses(20, 1), 1)
    counts = []
    for pairs in (1, 20, 20):
        estimator.solve(readings[:pairs])
        counts.append(held())
    assert counts[0] == counts[1] == counts[2]


@pytest.mark.parametrize("borrow", [norefcount_njit, inlined_njit])
def test_what_borrows_arrays_returns_none(borrow: Callable[[Callable[..., object]], object]) -> None:
    def view(array: FloatArray) -> FloatArray:
        return array[:1]

    with pytest.raises(TypeError, match="numbers only"):
        borrow(view)
