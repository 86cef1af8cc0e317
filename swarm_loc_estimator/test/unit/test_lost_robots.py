"""A robot that is lost is named with the reason in /diagnostics and in replay's report, one test a reason."""

from __future__ import annotations

import html
from pathlib import Path

import numpy as np
import pytest
from lost_world import CAUSES, lose

from swarm_loc_estimator.common.health import Level
from swarm_loc_estimator.filter.measurements import Loss
from swarm_loc_estimator.timeline.contradictions import LOSS_CAUSES
from swarm_loc_estimator.timeline.estimator import Estimator, Status


def test_every_reason_has_words_and_a_story() -> None:
    assert {*LOSS_CAUSES} == {*Loss}
    assert {*CAUSES} == {*Loss} - {Loss.FRAME}


@pytest.mark.parametrize("why", CAUSES, ids=lambda why: why.name.lower())
def test_a_lost_robot_is_named_with_the_reason(why: Loss, tmp_path: Path) -> None:
    lost = lose(why, tmp_path)
    estimator, cause = lost.estimator, CAUSES[why]
    loss = estimator.loss_of(0)
    assert loss is not None
    assert (loss.robot, loss.why, loss.cause) == (0, why, cause)
    assert 0 <= lost.now_ns - loss.stamp_ns < 1_000_000_000
    print(why.name, loss.text(lost.now_ns), lost.result.loss_remarks, estimator.counters)
