"""The page in a real Chromium: what it shows, what it orders, and what it must not do."""

import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser

from bench.watch.browser import WatchedPage
from bench.watch.watched_swarm import PLACES, SWARM, WatchedSwarm
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.report.report import recorded
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.watch.page import page as page_of

BLUE = (0x00, 0x72, 0xB2)


def test_robots_are_painted_where_they_are_in_the_colour_of_their_status(page: WatchedPage) -> None:
    u, v = page.place_of(0)
    view = page.evaluate(
        "[watch.view.x, watch.view.y, watch.view.scale, watch.view.width, watch.view.height]"
    )
    x, y, scale, width, height = view
    assert u == pytest.approx((PLACES[0, 0] - x) * scale + width / 2, abs=0.01)
    assert v == pytest.approx((y - PLACES[0, 1]) * scale + height / 2, abs=0.01)
    # beside the middle, where the line of the heading begins; away from it
    theta = PLACES[0, 2]
    colour = page.colour_at(u - 3 * np.cos(theta), v + 3 * np.sin(theta))
    assert colour[:3] == pytest.approx(BLUE, abs=3)
    assert page.page.inner_text("#counts").split() == ["1", "waiting", "2", "tracked"]


def test_a_click_shows_the_numbers_of_a_robot(page: WatchedPage, swarm: WatchedSwarm) -> None:
    page.page.mouse.click(*page.place_of(0))
    page.until("document.getElementById('numbers').innerText.includes('0.500 m')")
    text = page.page.inner_text("#panel")
    for shown in ("alpha", "tracked", "0.250 m", "57.3°", "10.0, 20.0 mm", "0.1 s"):
        assert shown in text, text
    assert "sightings used" in text
    assert "sightings gated" in text
    wait_for(lambda: swarm.server.selected == {0}, page)
    swarm.server.send_text(
        {"kind": "report", "robot": 0, "stamp": 1.0, "message": "well", "values": {"a": "b"}}, 0
    )
    page.until("document.getElementById('message').textContent == 'well'")


def test_dragging_sets_a_pose_once_it_is_confirmed(page: WatchedPage, swarm: WatchedSwarm) -> None:
    page.page.mouse.click(*page.place_of(1))
    for answer in ("Cancel", "Set pose"):
        page.page.click("#setpose")
        u, v = page.evaluate("watch.view.toScreen(0.1, 0.2)")
        page.page.mouse.move(u, v)
        page.page.mouse.down()
        page.page.mouse.move(u, v - 60)
        page.page.mouse.up()
        page.page.click(f"#ask button:has-text('{answer}')")
        page.until("!document.getElementById('ask').open")
    command = swarm.next_order()
    assert (command["do"], command["robot"]) == ("set_pose", 1)
    assert command["pose"] == pytest.approx([0.1, 0.2, np.pi / 2], abs=0.01)
    page.until("document.getElementById('said').textContent == 'done: set_pose'")
    assert swarm.commands.empty(), "a pose that was not confirmed has been set"


def test_a_reset_is_ordered_once_it_is_confirmed(page: WatchedPage, swarm: WatchedSwarm) -> None:
    page.page.click("#reset")
    page.page.click("#yes")
    assert swarm.next_order()["do"] == "reset"


def test_a_robot_is_driven_while_a_key_is_held(page: WatchedPage, swarm: WatchedSwarm) -> None:
    page.page.mouse.click(*page.place_of(0))
    page.page.click("#drive")
    page.page.click("#yes")
    page.until("watch.actions.driven === 0")
    page.page.keyboard.down("ArrowUp")
    command = swarm.next_order()
    page.page.keyboard.up("ArrowUp")
    assert command == {"do": "drive", "robot": 0, "ahead": 1, "left": 0}


def test_the_slider_goes_back_in_time(page: WatchedPage, swarm: WatchedSwarm) -> None:
    for k in range(1, 21):
        swarm.publish(PLACES + np.array([0.01 * k, 0.0, 0.0]), later_ns=250_000_000)
        page.until(f"watch.store.range[1] - watch.store.range[0] > {250 * k - 10}")
    slide = "const s = document.getElementById('slider'); s.value = {}; s.dispatchEvent(new Event('input'))"
    painted = "watch.store.at('poses', watch.shownTime).columns.x[0]"
    page.evaluate(f"{{ {slide.format(0.5)} }}")
    page.until("watch.paused")
    assert page.evaluate(painted) == pytest.approx(0.6, abs=0.011)
    swarm.publish(PLACES + np.array([0.3, 0.0, 0.0]))
    page.until("watch.store.range[1] - watch.store.range[0] > 5090")
    assert page.evaluate(painted) == pytest.approx(0.6, abs=0.011), "what is shown moves though it is paused"
    page.page.click("#pause")
    page.until(f"{painted} > 0.79")


def test_a_page_that_is_opened_later_knows_the_past(browser: Browser, swarm: WatchedSwarm) -> None:
    for _ in range(10):
        swarm.publish(later_ns=500_000_000)
    late = WatchedPage(browser, swarm.server.url)
    late.until("watch.store.range[1] - watch.store.range[0] >= 4400")
    late.close()


def test_robots_that_are_located_later_come_into_view(browser: Browser, swarm: WatchedSwarm) -> None:
    places = PLACES.copy()
    places[1:] = np.nan
    swarm.publish(places, status=(1, 0, 0))
    opened = WatchedPage(browser, swarm.server.url)
    opened.until("watch.fitted === 1")
    far = PLACES + np.array([[0.0, 0.0, 0.0], [-9.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    swarm.publish(far)
    opened.until("watch.fitted === 2 && watch.settled")
    u, v = opened.place_of(1)
    assert 0 < u < 1200
    assert 40 < v < 760
    opened.page.mouse.move(600, 400)
    opened.page.mouse.wheel(0, -400)
    opened.until("watch.view.touched")
    scale = opened.evaluate("watch.view.scale")
    swarm.publish(20.0 * far, status=(1, 1, 1))
    opened.until("watch.store.at('poses', Infinity).columns.status[2] === 1")
    assert opened.evaluate("watch.view.scale") == scale, "a view that was chosen by hand has moved"
    opened.close()


def test_view_follows_zooms_and_changes_its_colours(page: WatchedPage, swarm: WatchedSwarm) -> None:
    before = page.evaluate("watch.view.scale")
    page.page.mouse.move(600, 400)
    page.page.mouse.wheel(0, -400)
    page.until(f"watch.view.scale > {before} * 1.5")
    page.page.mouse.click(*page.place_of(0))
    page.page.click("#follow")
    swarm.publish(PLACES + np.array([0.2, 0.1, 0.0]))
    page.until("Math.abs(watch.view.x - 0.7) < 1e-9 && Math.abs(watch.view.y - 0.35) < 1e-9")
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.page.click("#theme")
    page.until(f"getComputedStyle(document.body).backgroundColor !== '{paper}'")


def test_a_dropped_connection_comes_back(page: WatchedPage, swarm: WatchedSwarm) -> None:
    port = swarm.server.port
    swarm.server.close()
    page.until("document.getElementById('link').dataset.state === 'lost'")
    again = WatchedSwarm(port)
    again.publish(PLACES + np.array([0.4, 0.0, 0.0]))
    page.until("document.getElementById('link').dataset.state === 'live'")
    page.until("Math.abs(watch.store.at('poses', Infinity).columns.x[0] - 0.9) < 1e-9")
    again.server.close()
    # that the server was away is told on the console
    assert all("ERR_CONNECTION_REFUSED" in error for error in page.errors), page.errors
    page.errors.clear()


def test_a_report_plays_its_run_without_a_server(browser: Browser, tmp_path: Path) -> None:
    stamp_ns = np.arange(1, 41) * 100_000_000
    pose = np.tile(PLACES, (40, 1, 1))
    pose[:, 0, 0] += np.arange(40) * 0.01
    covariance = np.tile(np.diag([1e-4, 1e-4, 1e-3]), (40, 3, 1, 1))
    truth = {"alpha": Trajectory(stamp_ns, pose[:, 0] + [0.003, 0.004, 0.0])}
    result = ReplayResult(
        "a run",
        SWARM,
        stamp_ns,
        pose,
        covariance,
        np.isfinite(pose[..., 0]).view(np.uint8),
        truth,
        heading_known=np.isfinite(pose[..., 0]),
    )
    file = tmp_path / "run.html"
    file.write_text(page_of(recorded(result)), encoding="utf-8")
    opened = WatchedPage(browser, file.as_uri())
    opened.until("watch.playing && watch.painter.u")
    opened.page.click("#pause")
    opened.until("watch.time === watch.store.range[1] && watch.paused")
    assert opened.evaluate("watch.store.at('poses', watch.time).columns.x[0]") == pytest.approx(0.89)
    opened.page.mouse.click(*opened.place_of(0))
    opened.until("document.getElementById('numbers').innerText.includes('5.0 mm')")
    # the numbers are those of the time that is shown, also when it changes right after they were painted
    opened.evaluate("{ watch.panel.painted = watch.panel.drawn = performance.now(); watch.seek(0) }")
    opened.until("document.getElementById('numbers').innerText.includes('0.500 m')")
    assert not opened.page.is_visible("#reset")
    opened.close()
    assert opened.errors == opened.foreign == []


def test_a_command_of_a_foreign_page_is_refused(browser: Browser, swarm: WatchedSwarm) -> None:
    with_server = ThreadingHTTPServer(("127.0.0.1", 0), ForeignPage)
    threading.Thread(target=with_server.serve_forever, daemon=True).start()
    try:
        foreign = WatchedPage(browser, f"http://127.0.0.1:{with_server.server_port}/")
        order = """new Promise((resolve) => {
            const socket = new WebSocket('ws://127.0.0.1:PORT/socket');
            socket.onopen = () => { socket.send('{"do": "reset"}'); resolve('open'); };
            socket.onerror = () => resolve('refused');
        })"""
        assert foreign.evaluate(order.replace("PORT", str(swarm.server.port))) == "refused"
        assert any("403" in error for error in foreign.errors)
        foreign.close()
    finally:
        with_server.shutdown()
        with_server.server_close()
    assert not swarm.server.has_viewers
    assert swarm.commands.empty()


class ForeignPage(BaseHTTPRequestHandler):
    """A page of somebody else."""

    def do_GET(self) -> None:
        """Any address."""
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><link rel=icon href='data:,'><title>elsewhere</title>")

    def log_message(self, *_: object) -> None:
        """Say nothing."""


def wait_for(condition: Callable[[], bool], page: WatchedPage) -> None:
    """Look at each refresh of the page's screen until something is so."""
    for _ in range(600):
        if condition():
            return
        page.evaluate("new Promise((resolve) => requestAnimationFrame(resolve))")
    pytest.fail("waited in vain")
