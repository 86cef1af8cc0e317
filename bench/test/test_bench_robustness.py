"""Drivers of all protocols under corrupted bytes: no thread ends, no error is hidden, no nonsense is life."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.integrity.faults import CLEAN, settings_of
from bench.robustness.protocols import Stream
from bench.robustness.robots import PROTOCOLS, Run
from bench.robustness.stamps import CHANGES, misleading_share, with_stamps
from bench.robustness.wire import NONSENSE, PARTIAL
from bench.scenarios.eight_run import simulate_eight
from swarm_loc_drivers.common.odometry import OdometryState

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
    run = simulate_eight(settings_of(3, CLEAN, 6.0))
    share, worst_m = misleading_share(with_stamps(run, CHANGES[name], np.random.default_rng(3)))
    assert share <= 0.001
    assert worst_m < 0.02


class Stopped(Run):
    """A driver that is stopped for some seconds while its robot drives on."""

    def __init__(self, protocol: str, delay_s: float, stopped_s: float) -> None:
        self._delay_s, self._left_s = delay_s, stopped_s
        self._begin_s = self._end_s = 0.0
        self.track: list[tuple[int, float]] = []  # Stamp [ns] and mean path of the wheels
        self.states: list[OdometryState] = []
        super().__init__(protocol, self._watch)

    def note(self, *received: Any) -> None:
        """Keep a state of odometry."""
        super().note()
        self.states.append(received[-1])

    def _watch(self) -> None:
        self.track.append((self.body.now_ns, float(np.mean(self.body._steps))))
        if self._left_s and not (self._begin_s and self.now_s >= self._begin_s):
            self.drive((0.02, 0.0, 0.0))
            if not self._begin_s and self.received > 30:
                self._begin_s = self.now_s + self._delay_s
        elif self._left_s:
            stopped_s, self._left_s = self._left_s, 0.0
            self._end_s = self.now_s + stopped_s
            self.advance(stopped_s)
        elif self._end_s and self.now_s > self._end_s + 1.0:
            self.stop()


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("stopped_s", [0.4, 2.0])
def test_odometry_after_a_stop_of_the_driver_is_that_of_its_stamps(protocol: str, stopped_s: float) -> None:
    for delay_s in np.arange(0.0, 0.06, 0.005).tolist():
        run = Stopped(protocol, delay_s, stopped_s)
        run.go()
        stamps, paths = np.array(run.track).T
        at = np.array([one.stamp_ns for one in run.states])
        driven = np.array([one.pose[0] for one in run.states])
        true = np.interp(at, stamps, paths)
        before = at < 1e9 * run._begin_s
        scale, start = np.polyfit(true[before], driven[before], 1)
        assert at[-1] > 1e9 * run._end_s
        np.testing.assert_allclose(driven, scale * true + start, atol=0.02 * 0.1)  # that of .1 s
