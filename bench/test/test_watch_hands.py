"""Hands on the page: fingers that move and pinch it, keys that drive a robot, and who is let in to do so."""

import socket
from collections.abc import Iterator, Mapping

import numpy as np
import pytest
from playwright.sync_api import Browser, CDPSession

from bench.watch.browser import WatchedPage
from bench.watch.watched_swarm import WatchedSwarm
from swarm_loc_estimator.watch.server import Access

Place = tuple[float, float]


class Fingers:
    """A touch screen: Chromium makes pointer events of what its own input takes in.

    Args:
        page: Under the screen.
    """

    def __init__(self, page: WatchedPage) -> None:
        self._session: CDPSession = page.page.context.new_cdp_session(page.page)
        self._down: dict[int, Place] = {}

    def put(self, **fingers: Place) -> None:
        """Put fingers down, beside those that are."""
        self._send("touchStart", fingers)

    def move(self, **fingers: Place) -> None:
        """Move fingers to other places [px]."""
        self._send("touchMove", fingers)

    def lift(self) -> None:
        """Lift all."""
        self._down.clear()
        self._send("touchEnd", {})

    def _send(self, kind: str, fingers: Mapping[str, Place]) -> None:
        self._down.update({int(name[1:]): place for name, place in fingers.items()})
        points = [{"id": number, "x": x, "y": y} for number, (x, y) in self._down.items()]
        self._session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


@pytest.fixture
def fingers(page: WatchedPage) -> Fingers:
    return Fingers(page)


def test_a_finger_moves_the_view(page: WatchedPage, fingers: Fingers) -> None:
    x, y, scale = page.evaluate("[watch.view.x, watch.view.y, watch.view.scale]")
    fingers.put(f0=(600, 400))
    fingers.move(f0=(610, 400))
    fingers.move(f0=(700, 340))
    fingers.lift()
    page.until(f"Math.abs(watch.view.x - ({x} - 100 / {scale})) < 1e-9")
    assert page.evaluate("watch.view.y") == pytest.approx(y - 60 / scale)
    assert page.evaluate("watch.view.scale") == scale
    assert page.evaluate("watch.selected") == -1


def test_two_fingers_zoom_and_what_lies_under_them_stays_there(page: WatchedPage, fingers: Fingers) -> None:
    scale = page.evaluate("watch.view.scale")
    left, right = (page.evaluate(f"watch.view.toWorld({u}, 400)") for u in (500, 600))
    fingers.put(f0=(500, 400))
    fingers.put(f1=(600, 400))
    for step in range(1, 11):
        fingers.move(f0=(500 - 10 * step, 400 + 5 * step), f1=(600 + 10 * step, 400 + 5 * step))
    page.until(f"Math.abs(watch.view.scale - 3 * {scale}) < 1e-6 * {scale}")
    for place, u in ((left, 400), (right, 700)):
        assert page.evaluate(f"watch.view.toWorld({u}, 450)") == pytest.approx(place, abs=1e-6)
    fingers.lift()
    assert page.evaluate("watch.view.pointers.size") == 0
    assert page.evaluate("watch.selected") == -1, "two fingers have chosen a robot"


def test_a_tap_shows_the_numbers_of_a_robot(page: WatchedPage, fingers: Fingers) -> None:
    fingers.put(f0=page.place_of(1))
    fingers.lift()
    page.until("watch.selected === 1 && !document.getElementById('panel').hidden")


def test_a_finger_sets_a_pose(page: WatchedPage, fingers: Fingers, swarm: WatchedSwarm) -> None:
    fingers.put(f0=page.place_of(1))
    fingers.lift()
    page.page.click("#setpose")
    u, v = page.evaluate("watch.view.toScreen(0.1, 0.2)")
    fingers.put(f0=(u, v))
    fingers.move(f0=(u - 60, v))
    fingers.lift()
    page.page.click("#yes")
    command = swarm.next_order()
    assert (command["do"], command["robot"]) == ("set_pose", 1)
    assert command["pose"] == pytest.approx([0.1, 0.2, np.pi], abs=0.01)


def test_a_robot_stands_once_no_key_is_held(page: WatchedPage, swarm: WatchedSwarm) -> None:
    page.page.mouse.click(*page.place_of(1))
    page.page.click("#drive")
    page.page.click("#yes")
    page.until("watch.actions.driven === 1")
    page.page.keyboard.down("w")
    page.page.keyboard.down("ArrowLeft")
    while swarm.next_order() != {"do": "drive", "robot": 1, "ahead": 1, "left": 1}:
        pass
    page.page.keyboard.up("w")
    while swarm.next_order() != {"do": "drive", "robot": 1, "ahead": 0, "left": 1}:
        pass
    page.page.keyboard.up("ArrowLeft")
    assert page.evaluate("watch.actions.keys.size") == 0
    page.page.keyboard.down("ArrowUp")
    swarm.next_order()
    page.page.keyboard.press("Escape")
    page.until("watch.actions.driven === -1")
    page.page.keyboard.up("ArrowUp")


def test_keys_drive_nobody_where_driving_is_not_allowed(browser: Browser) -> None:
    swarm = WatchedSwarm(teleop=False)
    swarm.publish()
    page = WatchedPage(browser, swarm.server.url)
    page.until("watch.fitted && watch.painter.u")
    page.page.mouse.click(*page.place_of(0))
    page.until("watch.selected === 0")
    assert not page.page.is_visible("#drive")
    page.page.keyboard.press("ArrowUp")
    page.close()
    swarm.server.close()
    assert page.errors == []
    assert swarm.commands.empty()


@pytest.fixture
def guarded() -> Iterator[WatchedSwarm]:
    """A swarm on every address of this machine."""
    served = WatchedSwarm(access=Access("0.0.0.0", "open sesame"))  # noqa: S104
    served.publish()
    yield served
    served.server.close()


@pytest.mark.parametrize("query", ["", "?token=", "?token=wrong"])
def test_who_lacks_the_token_is_let_in_by_no_address(
    browser: Browser, guarded: WatchedSwarm, query: str
) -> None:
    for host in hosts():
        page = WatchedPage(browser, f"http://{host}:{guarded.server.port}/{query}")
        assert "The token is missing or wrong" in page.page.inner_text("body")
        order = f"""new Promise((resolve) => {{
            const socket = new WebSocket('ws://{host}:{guarded.server.port}/socket{query}');
            socket.onopen = () => {{ socket.send('{{"do": "reset"}}'); resolve('open'); }};
            socket.onerror = () => resolve('refused');
        }})"""
        assert page.evaluate(order) == "refused"
        page.close()
    assert guarded.commands.empty()
    assert guarded.server.load().refused == 2 * len(hosts())


def test_who_has_the_token_is_let_in_by_every_address(browser: Browser, guarded: WatchedSwarm) -> None:
    for host in hosts():
        page = WatchedPage(browser, f"http://{host}:{guarded.server.port}/?token=open%20sesame")
        page.until("watch.fitted && watch.painter.u")
        page.page.click("#reset")
        page.page.click("#yes")
        assert guarded.next_order()["do"] == "reset"
        page.close()
        assert page.errors == page.foreign == []


def hosts() -> list[str]:
    """Addresses of this machine: its own, and one that others use where it has one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        try:
            one.connect(("192.0.2.1", 9))  # nothing is sent: that network is for documents only
        except OSError:
            return ["127.0.0.1"]
        other: str = one.getsockname()[0]
    return ["127.0.0.1", other]
