"""Live graphs whose clock jumps or stops: nothing is lost unsaid, nothing misleads, poses come back."""

from bench.robustness.clocks import ON_CLOCK, ON_WALL, measure_breaks
from bench.robustness.load import accounted, started
from bench.robustness.source import SourceSettings


def _say(_: str) -> None:
    """Nobody looks."""


def test_poses_come_back_after_a_jump_of_the_clock_and_never_mislead() -> None:
    figures = measure_breaks({"back": ON_CLOCK["clock_-3600_s"]}, _say, is_clock=True)
    assert figures["time.back.recovery_s"] < 60.0  # the patience
    assert figures["time.back.misleading_share"] == 0.0


def test_poses_come_back_after_a_pause_of_the_estimator_and_never_mislead() -> None:
    figures = measure_breaks({"stopped": ON_WALL["estimator_stopped_1_s"]}, _say, is_clock=False)
    assert figures["time.stopped.recovery_s"] < 60.0
    assert figures["time.stopped.misleading_share"] == 0.0


def test_all_that_is_sent_is_used_or_said_to_be_dropped() -> None:
    with started(SourceSettings(5, 10.0), "accounts") as run:
        run.graph.wait_for(lambda: run.heard.counts[0] > 100, "track robots", 60.0)
        sent = run.end()
        assert run.heard.counts[1] == 0
        assert accounted(run) == sent.detections
        assert run.graph.recorder.inputs == sent.odometry + sent.images
