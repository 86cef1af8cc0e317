"""Measurement models against explicit transform chains, and against the equations as they were printed."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from core_geometry import planar, pose_of

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements, concatenate, select
from swarm_loc_estimator.filter.models import CARTESIAN, POLAR, predict, write_innovation

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


@pytest.mark.parametrize("heading", [0, 1])
@pytest.mark.parametrize("model", [CARTESIAN, POLAR])
@pytest.mark.parametrize("who", WHO)
@pytest.mark.parametrize("seed", range(4))
def test_jacobians_agree_with_finite_differences(who: str, model: int, heading: int, seed: int) -> None:
    s = scene(seed)
    _, jacobian = predicted(who, model, s, heading)
    step = 1e-6
    for side, sign in (("observer", -1.0), ("target", 1.0)):
        if WHO[who][side == "target"] == NOBODY and (who, side) != ("surveyed", "target"):
            continue
        for j in range(3):
            values = []
            for way in (1.0, -1.0):
                moved = scene(seed)
                pose = getattr(moved, side)
                setattr(moved, side, se2.compose(se2.exp(way * step * np.eye(3)[j]), pose))
                values.append(predicted(who, model, moved, heading)[0])
            slope = values[0] - values[1]
            slope[1:] = [wrapped(slope[1]) if model == POLAR else slope[1], wrapped(slope[2]) * heading]
            np.testing.assert_allclose(slope / (2 * step), sign * jacobian[:, j], atol=2e-8, rtol=1e-6)


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


def printed_4(o: FloatArray, x_c: float, m: FloatArray) -> FloatArray:
    """Eq. (4) as printed: z ahead, x to the left, of a landmark m seen by a camera at (x_c, 0)."""
    cos, sin = np.cos(o[2]), np.sin(o[2])
    dx, dy = m[0] - o[0], m[1] - o[1]
    return np.array([dx * cos + dy * sin - x_c, dy * cos - dx * sin, m[2] - o[2]])


def printed_6(o: FloatArray, s: FloatArray, x_c: float, m: FloatArray) -> FloatArray:
    """Eq. (6) as printed, of a marker m on robot s seen by robot o."""
    cos, sin = np.cos(o[2]), np.sin(o[2])
    x_so, y_so, th_so = s[0] - o[0], s[1] - o[1], s[2] - o[2]
    cos_so, sin_so = np.cos(th_so), np.sin(th_so)
    z = x_so * cos - y_so * sin - x_c + m[0] * cos_so + m[1] * sin_so
    x = y_so * cos - x_so * sin + m[1] * cos_so - m[0] * sin_so
    return np.array([z, x, s[2] + m[2] - o[2]])


def corrected_6(o: FloatArray, s: FloatArray, x_c: float, m: FloatArray) -> FloatArray:
    """Eq. (6) with its three signs put right."""
    cos, sin = np.cos(o[2]), np.sin(o[2])
    x_so, y_so, th_so = s[0] - o[0], s[1] - o[1], s[2] - o[2]
    cos_so, sin_so = np.cos(th_so), np.sin(th_so)
    z = x_so * cos + y_so * sin - x_c + m[0] * cos_so - m[1] * sin_so
    x = y_so * cos - x_so * sin + m[1] * cos_so + m[0] * sin_so
    return np.array([z, x, s[2] + m[2] - o[2]])


@pytest.mark.parametrize("seed", range(5))
def test_the_printed_eq_4_holds_for_a_camera_straight_ahead(seed: int) -> None:
    s = scene(seed)
    s.sensor = np.array([0.04, 0.0, 0.0])
    value, _ = predicted("landmark", CARTESIAN, s)
    expected = printed_4(s.observer, 0.04, s.marker)
    np.testing.assert_allclose(value[:2], expected[:2], atol=1e-12)
    assert wrapped(value[2] - expected[2]) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_the_printed_eq_6_is_wrong_and_its_corrected_signs_are_right(seed: int) -> None:
    s = scene(seed)
    s.sensor, s.marker = np.array([0.04, 0.0, 0.0]), np.array([0.03, 0.02, 1.0])
    value, _ = predicted("robot", CARTESIAN, s)
    np.testing.assert_allclose(value[:2], corrected_6(s.observer, s.target, 0.04, s.marker)[:2], atol=1e-12)
    assert np.abs(value[:2] - printed_6(s.observer, s.target, 0.04, s.marker)[:2]).max() > 1e-3


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
