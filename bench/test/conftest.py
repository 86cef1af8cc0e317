"""What the tests of the page share: a browser, a swarm that a test moves by hand, and its page."""

import os
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from bench.watch.browser import WatchedPage, chromium, running_browser
from bench.watch.watched_swarm import WatchedSwarm


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One for all tests of a file; asyncio cannot be used beside it."""
    executable = chromium()
    if executable is None:
        assert "CI" not in os.environ, "continuous integration has installed no Chromium: see .ci/run"
        pytest.skip("there is no Chromium here: apt-get install chromium")
    with running_browser(executable) as running:
        yield running


@pytest.fixture
def swarm() -> Iterator[WatchedSwarm]:
    served = WatchedSwarm()
    yield served
    served.server.close()


@pytest.fixture
def page(browser: Browser, swarm: WatchedSwarm) -> Iterator[WatchedPage]:
    """The page with the robots painted; it must end without errors and without having asked anyone else."""
    swarm.publish()
    opened = WatchedPage(browser, swarm.server.url)
    opened.until("watch.fitted && watch.painter.u && watch.metrics.frame.length > 0")
    yield opened
    opened.close()
    assert opened.errors == []
    assert opened.foreign == []
