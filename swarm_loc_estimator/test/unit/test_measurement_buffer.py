"""Law: measurements lie in one order, each once, however they came in."""

from __future__ import annotations

import random

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from swarm_loc_estimator.filter.measurement_model import MEASUREMENT_DTYPE
from swarm_loc_estimator.timeline.timeline import MeasurementBuffer

Row = tuple[int, int, int, float]
ROW = st.tuples(
    st.integers(-20, 20), st.integers(-1, 2), st.integers(0, 2), st.sampled_from([-1.0, 0.0, 1.5])
)


def measurements(rows: list[Row]) -> NDArray[np.void]:
    many = np.zeros(len(rows), dtype=MEASUREMENT_DTYPE)
    for one, (stamp_ns, observer, marker_id, value) in zip(many, rows, strict=True):
        one["stamp_ns"], one["observer"], one["marker_id"], one["value"][1] = (
            stamp_ns,
            observer,
            marker_id,
            value,
        )
    return many


@given(st.lists(st.lists(ROW, max_size=8), max_size=8), st.randoms())
def test_any_order_gives_the_same_each_once(parts: list[list[Row]], order: random.Random) -> None:
    rows = [row for part in parts for row in part]
    buffer, other = MeasurementBuffer(), MeasurementBuffer()
    known: set[Row] = set()
    for part in parts:
        merged = buffer.merge(measurements(part))
        new = set(part) - known
        assert merged.duplicates == len(part) - len(new)
        assert merged.first_ns == min((row[0] for row in new), default=None)
        known |= new
    order.shuffle(rows)
    for row in rows:
        other.merge(measurements([row]))
    assert buffer.measurements.tobytes() == other.measurements.tobytes()
    assert len(buffer) == len(known)
    assert buffer.stamp_ns.tolist() == sorted(row[0] for row in known)
    np.testing.assert_array_equal(buffer.measurements["stamp_ns"], buffer.stamp_ns)


@given(st.lists(st.lists(ROW, max_size=8), max_size=8))
def test_what_was_computed_goes_with_its_measurement(parts: list[list[Row]]) -> None:
    """It is read while what has come since is fused, which takes a while."""
    buffer = MeasurementBuffer()
    computed: dict[bytes, tuple[int, float]] = {}
    for part in parts:
        buffer.merge(measurements(part))
        for k, row in enumerate(buffer.measurements):
            verdict, nis = computed.setdefault(row.tobytes(), (0, np.nan))
            assert buffer.verdicts[k] == verdict
            np.testing.assert_equal(buffer.nis[k], nis)
            buffer.verdicts[k], buffer.nis[k] = 1 + len(computed) % 3, float(len(computed))
            computed[row.tobytes()] = int(buffer.verdicts[k]), float(buffer.nis[k])


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
    assert buffer._stamp_ns.size < 5000
