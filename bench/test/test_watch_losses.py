"""The page says why a robot is lost, one test a reason: live what /diagnostics says, and in a recording."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
from lost_world import CAUSES, lose
from playwright.sync_api import Browser

from bench.watch.browser import WatchedPage
from bench.watch.watched_swarm import WatchedSwarm
from swarm_loc_estimator.filter.measurements import LossReason
from swarm_loc_estimator.offline.report.report import recorded
from swarm_loc_estimator.watch.page import page as page_of

WAITING = 2
MESSAGE = "document.getElementById('message').textContent"


@pytest.mark.parametrize("why", CAUSES, ids=lambda why: why.name.lower())
def test_the_page_says_why_a_robot_is_lost(
    page: WatchedPage, swarm: WatchedSwarm, why: LossReason, tmp_path: Path
) -> None:
    page.page.click("#counts button:has-text('waiting')")
    page.until(f"watch.selected === {WAITING}")
    end_s = time.monotonic() + 15.0
    while swarm.server.selected != {WAITING}:
        assert time.monotonic() < end_s, "the server does not know which robot is shown"
        page.evaluate("0")
    report = lose(why, tmp_path).report()
    note = {"kind": "report", "robot": WAITING, "stamp": 1.0, "message": report.message, "values": {}}
    swarm.server.send_text(note, WAITING)
    page.until(f"{MESSAGE}.startsWith('lost ') && {MESSAGE}.includes({json.dumps(f' s ago: {CAUSES[why]}')})")
    assert page.page.inner_text("#panel h2").startswith("gamma")
    assert page.page.is_visible("#message")


@pytest.mark.parametrize("why", CAUSES, ids=lambda why: why.name.lower())
def test_a_recording_says_why_a_robot_is_lost(browser: Browser, why: LossReason, tmp_path: Path) -> None:
    lost = lose(why, tmp_path)
    file = tmp_path / "run.html"
    file.write_text(page_of(recorded(lost.result)), encoding="utf-8")
    page = WatchedPage(browser, file.as_uri())
    page.until("watch.playing && watch.store.frames.poses")
    page.evaluate("watch.seek(1)")
    page.page.click("#counts button:has-text('waiting')")
    (loss,) = lost.result.losses
    said = loss.text(int(lost.result.stamp_ns[-1]))
    page.until(f"watch.selected === 0 && {MESSAGE} === {json.dumps(said)}")
    located = np.flatnonzero(lost.result.status[:, 0])
    if located.size:
        page.evaluate(f"watch.seek({located[-1] / (len(lost.result.stamp_ns) - 1)})")
        page.until(f"!{MESSAGE}.startsWith('lost')")
    page.close()
    assert page.errors == page.foreign == []
