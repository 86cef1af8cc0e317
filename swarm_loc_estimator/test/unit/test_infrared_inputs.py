"""From brightness matrices to relative measurements: which pose, whose, and why not."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from ir_swarm import DROPLET, T0, Light, brightness_rows, calibrated, exchange

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.measurements import Measurements
from swarm_loc_estimator.filter.models import POLAR
from swarm_loc_estimator.infrared.search import IrOutcome, IrSolutions, no_solutions
from swarm_loc_estimator.sensors import infrared as brightness_sightings
from swarm_loc_estimator.sensors.infrared import BrightnessConverter, BrightnessRows
from swarm_loc_estimator.swarm.ir_board import IrPlatform, PairGains, RobotIr
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

POSES = np.array([[0.0, 0.0, 0.3], [0.14, 0.08, -1.2], [-0.05, 0.1, 2.0]])
CLOSE = POSES * [0.55, 0.55, 1.0]  # Near enough for the reduced power
OTHER_BOARD = replace(DROPLET, radius=0.03)
ONE_POWER = replace(DROPLET, amplitudes=DROPLET.amplitudes[:1])


def swarm_of(platform: IrPlatform = DROPLET) -> Swarm:
    board = RobotIr(1, platform, "droplet", calibrated(platform))
    robots = [Robot(f"d{k}", ir=replace(board, id=k + 1)) for k in range(3)]
    return Swarm((*robots, Robot("blind"), Robot("other", ir=replace(board, id=9, platform=OTHER_BOARD))))


def heard(platform: IrPlatform = DROPLET, noise: float = 1.0, poses: FloatArray = POSES) -> list[Light]:
    """What robots 0 and 2 read of robot 1: far and near of one, then of the other."""
    return exchange(np.random.default_rng(4), poses, 1, T0, platform, noise)


def rows_of(*events: Light) -> BrightnessRows:
    return brightness_rows([(event, T0) for event in events])


def relative(observer: int, target: int) -> FloatArray:
    x, y, heading = se2.between(POSES[observer], POSES[target])
    return np.array([np.hypot(x, y), np.arctan2(y, x), heading])


def in_bytes(measured: Measurements) -> list[bytes]:
    rows = (measured.row(k) for k in range(measured.size))
    return [b"".join(part.tobytes() for part in row[:-1]) for row in rows]


def test_the_transmitter_lies_where_it_is_seen_from_the_receiver() -> None:
    converter = BrightnessConverter(swarm_of())
    change = converter.take(rows_of(*heard(noise=0.0)))
    measured = change.added
    assert measured.observer.tolist() == measured.received_from.tolist() == [0, 2]
    assert measured.target.tolist() == [1, 1]
    assert set(measured.model.tolist()) == {POLAR}
    assert measured.has_heading.all()
    assert not measured.sensor.any()
    assert not measured.marker.any()
    limit = [1e-3, 0.01, 0.02]
    for observer, value, covariance in zip(
        measured.observer.tolist(), measured.value, measured.covariance, strict=True
    ):
        error = value - relative(observer, 1)
        assert (np.abs([error[0], *se2.wrap_angle(error[1:])]) < limit).all()
        assert (np.linalg.eigvalsh(covariance) > 0.0).all()
    assert not converter.drops


def test_the_two_powers_of_an_exchange_make_one_measurement_in_any_order() -> None:
    """Each alone is used at once, and replaced by both."""
    far, near = heard(noise=0.0, poses=CLOSE)[:2]
    both = BrightnessConverter(swarm_of()).take(rows_of(far, near)).added
    assert both.size == 1
    for one, other in ((far, near), (near, far)):
        converter = BrightnessConverter(swarm_of())
        first = converter.take(rows_of(one))
        second = converter.take(rows_of(other))
        assert (first.added.size, first.withdrawn.size) == (1, 0)
        assert in_bytes(second.withdrawn) == in_bytes(first.added)
        assert in_bytes(second.added) == in_bytes(both)
        assert in_bytes(first.added) != in_bytes(both)
        assert both.covariance[0, 0, 0] < first.added.covariance[0, 0, 0]


def test_a_repeated_matrix_counts_once_and_of_two_that_differ_the_same_one_in_any_order() -> None:
    far, near = heard()[:2]
    spoiled = replace(far, readings=far.readings + 1.0)
    results = []
    for order in ((far, near, spoiled), (spoiled, far, near), (near, spoiled, far)):
        converter, measured = BrightnessConverter(swarm_of()), list[bytes]()
        for event in order:
            change = converter.take(rows_of(event))
            measured = [row for row in measured if row not in in_bytes(change.withdrawn)]
            measured += in_bytes(change.added)
        assert converter.drops == {"duplicate": 1}
        results.append(measured)
    assert len(results[0]) == 1
    assert results[0] == results[1] == results[2]
    converter = BrightnessConverter(swarm_of())
    converter.take(rows_of(far, near))
    again = converter.take(rows_of(near, far))
    assert (again.added.size, again.withdrawn.size) == (0, 0)
    assert converter.drops == {"duplicate": 2}


def test_a_board_with_one_power_needs_no_other() -> None:
    measured = BrightnessConverter(swarm_of(ONE_POWER)).take(rows_of(*heard(ONE_POWER))).added
    assert measured.size == 2


def with_column(**columns: object) -> Callable[[BrightnessRows], BrightnessRows]:
    return lambda rows: rows._replace(**{n: np.full(rows.robot.size, v) for n, v in columns.items()})


def with_both(
    one: Callable[[BrightnessRows], BrightnessRows], other: Callable[[BrightnessRows], BrightnessRows]
) -> Callable[[BrightnessRows], BrightnessRows]:
    return lambda rows: other(one(rows))


def with_readings(readings: FloatArray) -> Callable[[BrightnessRows], BrightnessRows]:
    def change(rows: BrightnessRows) -> BrightnessRows:
        column = np.empty(rows.robot.size, dtype=object)
        column[:] = [np.asarray(readings, dtype=np.int32)] * rows.robot.size
        return rows._replace(readings=column)

    return change


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (with_column(robot=3), "no_ir"),
        (with_column(transmitter=77), "ir_unknown_id"),
        (with_column(receiver=77), "ir_unknown_id"),
        (with_column(receiver=3), "ir_wrong_receiver"),
        (with_column(transmitter=1), "ir_hears_itself"),
        (with_column(transmitter=9), "ir_other_board"),
        (with_column(n=5), "ir_wrong_size"),
        (with_readings(np.ones(35)), "ir_wrong_size"),
        (with_readings(np.ones(0)), "ir_wrong_size"),
        (with_column(power=2), "ir_unknown_power"),
        (with_readings(np.zeros(36)), "ir_too_weak"),
        (with_readings(np.random.default_rng(0).normal(0.0, 1.0, 36).round()), "ir_too_weak"),
        (with_readings(np.full(36, 255)), "ir_saturated"),
        (with_both(with_readings(np.full(36, 240)), with_column(saturation=240)), "ir_saturated"),
        (with_both(with_readings(np.full(36, 255)), with_column(saturation=4095)), "ir_saturated"),
        (with_both(with_readings(np.full(36, 255)), with_column(saturation=-1)), "ir_saturated"),
        (with_readings(np.full(36, -200)), "ir_too_few"),
        (with_readings(np.where(np.arange(36) % 7 == 3, 200, 0)), "ir_misfit"),
        (with_readings(np.full(36, -(2**31))), "ir_too_few"),
        (with_readings(np.full(36, 2**31 - 1)), "ir_saturated"),
    ],
)
def test_what_cannot_be_used_has_a_reason(
    change: Callable[[BrightnessRows], BrightnessRows], reason: str
) -> None:
    converter = BrightnessConverter(swarm_of())
    rows = rows_of(heard()[0])
    assert converter.take(change(rows)).added.size == 0
    assert converter.drops == {reason: 1}
    converter.forget_before(T0 + 1)
    assert converter.drops == {reason: 1}
    if not reason.startswith(("no_", "ir_unknown", "ir_wrong", "ir_hears", "ir_other")):
        return
    assert converter.take(rows).added.size == 1


def test_readings_below_zero_are_noise_around_it() -> None:
    events = heard()[:2]
    assert min(float(event.readings.min()) for event in events) < 0.0
    assert BrightnessConverter(swarm_of()).take(rows_of(*events)).added.size == 1


def test_a_matrix_that_is_useless_alone_is_counted_until_its_partner_makes_it_useful() -> None:
    far, near = heard()[2:]
    dark = replace(near, readings=np.zeros((6, 6)))
    converter = BrightnessConverter(swarm_of())
    converter.take(rows_of(dark))
    assert converter.drops == {"ir_too_weak": 1}
    assert converter.take(rows_of(far)).added.size == 1
    assert not converter.drops
    converter.restart()
    assert not converter.drops


def test_what_is_read_in_the_dark_is_no_light() -> None:
    """Readings and the saturation of their matrix are both higher by it."""
    limit = 150
    for poses in (POSES, CLOSE):
        events, results = heard(poses=poses), []
        for dark in (0.0, 7.0):
            board = replace(DROPLET, dark_level=dark)
            lifted = [replace(one, readings=np.minimum(one.readings + dark, limit + dark)) for one in events]
            told = with_column(saturation=limit + dark)(rows_of(*lifted))
            results.append(BrightnessConverter(swarm_of(board)).take(told).added)
        assert results[0].size
        assert in_bytes(results[0]) == in_bytes(results[1])


def test_measured_exchanges_are_those_since_the_last_restart() -> None:
    converter = BrightnessConverter(swarm_of())
    converter.take(rows_of(*heard()))
    converter.forget_before(T0 + 1)
    assert converter.counters["infrared exchanges measured"] == 2
    converter.restart()
    assert converter.counters["infrared exchanges measured"] == 0
    converter.take(rows_of(*heard()))
    assert converter.counters["infrared exchanges measured"] == 2


def test_where_readings_end_is_each_matrixs_own_and_in_any_order_the_same() -> None:
    far, near = heard(poses=CLOSE)[:2]
    limits = {one.power: int(0.7 * one.readings.max()) for one in (far, near)}
    events = [replace(one, readings=np.minimum(one.readings, limits[one.power])) for one in (far, near)]
    assert all((one.readings == limits[one.power]).any() for one in events)
    repeated = [(one, limit) for one in events for limit in (limits[one.power], 4095)]
    results = set()
    for order in (repeated, repeated[::-1], repeated[1:] + repeated[:1]):
        converter, last = BrightnessConverter(swarm_of()), list[bytes]()
        for event, limit in order:
            added = converter.take(with_column(saturation=limit)(rows_of(event))).added
            last = in_bytes(added) or last
        assert converter.drops == {"duplicate": 2}
        results.add(b"".join(last))
    assert len(results) == 1
    told = [with_column(saturation=limits[one.power])(rows_of(one)) for one in events]
    converter = BrightnessConverter(swarm_of())
    converter.take(told[0])
    measured = converter.take(told[1]).added
    error = measured.value[0] - [np.hypot(*CLOSE[1, :2]), *relative(0, 1)[1:]]
    assert np.sum(error * np.linalg.solve(measured.covariance[0], error)) < 16.3  # one in a thousand


class Ambiguous:
    """An estimator that finds two poses, and poses that are no good."""

    def __init__(self, _platform: IrPlatform) -> None:
        pass

    def solve(
        self, readings: FloatArray, gains: PairGains | None = None, saturation: FloatArray | None = None
    ) -> IrSolutions:
        """Always the same, but for the robots whose brightest reading is odd."""
        assert gains is not None
        assert saturation is not None
        k = len(readings)
        solutions = no_solutions(k)
        solutions.outcomes[:] = IrOutcome.FOUND
        solutions.poses[:] = [0.1, 0.2, 0.3]
        solutions.covariances[:] = np.eye(3)
        solutions.alternatives[0] = [0.11, 2.0, -1.0]
        solutions.covariances[1:] = -np.eye(3)
        return solutions


def test_a_second_pose_becomes_the_alternative_and_no_covariance_is_no_measurement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(brightness_sightings, "MaximumLikelihood", Ambiguous)
    brightness_sightings._estimator.cache_clear()
    converter = BrightnessConverter(swarm_of())
    measured = converter.take(rows_of(*heard())).added
    brightness_sightings._estimator.cache_clear()
    assert (measured.size, measured.has_second.tolist()) == (1, [True])
    np.testing.assert_allclose(measured.second[0], [0.11, 2.0, -1.0])
    assert converter.drops == {"bad_covariance": 2}
