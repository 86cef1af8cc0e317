"""Law: measurements lie in one order, each once, however they came in."""

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.filter.measurements import Measurements
from swarm_loc_estimator.timeline.timeline import MeasurementBuffer

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
