"""Drivers of all protocols under corrupted bytes: no thread ends, no error is hidden, no nonsense is life."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.integrity.fault import CLEAN, settings_of
from bench.integrity.faults import simulate
from bench.robustness.protocols import Stream
from bench.robustness.robots import PROTOCOLS
from bench.robustness.stamps import CHANGES, misleading_share, with_stamps
from bench.robustness.wire import NONSENSE, PARTIAL

SEEDS = st.integers(0, 2**31)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@settings(max_examples=25)
@given(seed=SEEDS, kind=st.sampled_from(PARTIAL))
def test_hurt_bytes_end_no_driver_and_odometry_comes_again(protocol: str, seed: int, kind: str) -> None:
    outcome = Stream(protocol, seed, kind).run()
    assert not outcome.traceback
    assert not outcome.is_dead
    assert not outcome.still_moves


@pytest.mark.parametrize("protocol", PROTOCOLS)
@settings(max_examples=25)
@given(seed=SEEDS, kind=st.sampled_from(NONSENSE))
def test_nonsense_is_no_connection_for_longer_than_three_seconds(protocol: str, seed: int, kind: str) -> None:
    outcome = Stream(protocol, seed, kind).run()
    assert not outcome.traceback
    assert 0.0 < outcome.false_connected_s <= 3.0
    assert not outcome.is_dead
    assert not outcome.still_moves


def test_a_defect_of_a_driver_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The streams can fail: one whose driver cannot cope with its odometry shows a traceback."""
    stream = Stream("pushbot", 1, "lost")
    broken = iter([None, None])

    def update(*_: object) -> None:
        next(broken)

    monkeypatch.setattr(
        stream._run.driver, "_odometry", type("Broken", (), {"update": update, "restart": print})()
    )
    outcome = stream.run()
    assert "StopIteration" in outcome.traceback
    assert outcome.is_dead


@pytest.mark.parametrize("name", ["jitter_90", "early", "late", "twice"])
def test_wrong_stamps_of_odometry_make_no_pose_misleading(name: str) -> None:
    run = simulate(settings_of(3, CLEAN, 6.0))
    share, worst_m = misleading_share(with_stamps(run, CHANGES[name], np.random.default_rng(3)))
    assert share <= 0.001
    assert worst_m < 0.02
