"""Each layer of the page is painted, goes with its switch, and comes back, by the pixels of the screen."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser

from bench.watch.browser import WatchedPage
from bench.watch.watched_swarm import MAP_CORNER, SWARM, WatchedSwarm, surroundings, swarm_frames
from swarm_loc_estimator.mapping.messages import GridMessage
from swarm_loc_estimator.watch.page import about, map_frame, recording
from swarm_loc_estimator.watch.page import page as page_of

LEAST_PIXELS = {
    "names": 100,
    "ellipses": 40,
    "trails": 20,
    "sightings": 200,
    "truth": 60,
    "landmarks": 20,
    "map": 5000,
    "goals": 40,
    "aerial": 150,
    "grid": 2000,
}
"""Layer -> pixels that change at least when it goes."""
_CANVASES_ONLY = "header, footer, .card { visibility: hidden !important }"
Picture = NDArray[np.uint8]


@pytest.fixture
def live(browser: Browser) -> Iterator[WatchedPage]:
    """A swarm with all that there is to see around it."""
    swarm = WatchedSwarm(infrared=True)
    for k in range(8):  # paths of the last seconds
        swarm.publish(later_ns=200_000_000, poses=_walked(k))
        swarm.publish_surroundings()
    opened = WatchedPage(browser, swarm.server.url)
    opened.until("watch.fitted && watch.store.frames.map && watch.store.frames.goals")
    opened.until("watch.store.frames.poses.length > 3 && watch.store.frames.aerial")
    yield opened
    opened.close()
    swarm.server.close()
    assert opened.errors == opened.foreign == []


@pytest.fixture
def played(browser: Browser, tmp_path: Path) -> Iterator[WatchedPage]:
    """The same as a recording inside the page, at its end."""
    told = {**about(SWARM, "recorded", commands=False), "infrared": [0, 1, 0]}
    frames = []
    for k in range(8):
        stamp_ns = (10 + k) * 200_000_000
        frames += [*swarm_frames(stamp_ns, _walked(k)), *surroundings(stamp_ns)]
    file = tmp_path / "run.html"
    file.write_text(page_of(recording(told, frames)), encoding="utf-8")
    opened = WatchedPage(browser, file.as_uri())
    opened.until("watch.playing && watch.fitted")
    opened.evaluate("watch.seek(1)")
    yield opened
    opened.close()
    assert opened.errors == opened.foreign == []


def _walked(k: int) -> NDArray[np.float64]:
    return np.array([[0.5, 0.25 - 0.1 * (7 - k), 1.0], [-0.5, 0.5, -2.0], [0.0, -0.5, 0.0]])


@pytest.mark.parametrize("source", ["live", "played"])
def test_each_layer_is_painted_and_has_a_switch(source: str, request: pytest.FixtureRequest) -> None:
    page: WatchedPage = request.getfixturevalue(source)
    page.page.click("#layers")
    with_all = screen(page)
    names = page.evaluate(
        "[...document.querySelectorAll('#layerlist label')].map((one) => one.innerText.trim())"
    )
    assert set(names) == set(LEAST_PIXELS)
    for name, least in LEAST_PIXELS.items():
        box = page.page.locator("#layerlist label", has_text=name).locator("input")
        box.uncheck()
        without = screen(page)
        changed = np.any(without != with_all, axis=2)
        assert changed.sum() >= least, f"{name}: its switch changes {changed.sum()} pixels"
        box.check()
        assert np.array_equal(screen(page), with_all), f"{name} does not come back as it was"


@pytest.mark.parametrize("source", ["live", "played"])
def test_walls_goals_and_names_from_above_are_where_they_belong(
    source: str, request: pytest.FixtureRequest
) -> None:
    page: WatchedPage = request.getfixturevalue(source)
    show_only(page, "map")
    x, y, yaw = MAP_CORNER
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    picture = screen(page)

    def grey(column: float, row: float) -> float:
        """Of a cell's middle on the screen."""
        at = turn @ (0.05 * np.array([column + 0.5, row + 0.5])) + (x, y)
        u, v = page.evaluate(f"watch.view.toScreen({at[0]}, {at[1]})")
        return float(picture[round(v), round(u)].mean())

    wall, free, unknown = grey(30, 10), grey(12, 12), grey(3, 3)
    assert wall < unknown < free
    assert free - wall > 100
    show_only(page, "goals", "aerial")
    u, v = page.evaluate("watch.view.toScreen(-1, 0)")
    assert near(page, u + 3, v + 3, "goal"), "the cross of a goal"
    u, v = page.evaluate("watch.view.toScreen(0.9, -0.7)")
    assert near(page, u - 7, v, "aerial"), "the square of a detection"


def test_all_of_the_known_map_is_in_view(browser: Browser) -> None:
    swarm = WatchedSwarm()
    swarm.publish()
    page = WatchedPage(browser, swarm.server.url)
    page.until("watch.fitted")
    cells = np.full((100, 300), -1, dtype=np.int8)
    cells[20:30, 150:280] = 0
    swarm.server.publish(
        map_frame(swarm.now_ns, GridMessage(swarm.now_ns, "map", 0.1, (0.0, 0.0, 0.0), cells))
    )
    page.until("watch.store.frames.map && watch.settled")
    for x, y in ((15.0, 2.0), (28.0, 3.0)):
        u, v = page.evaluate(f"watch.view.toScreen({x}, {y})")
        assert 0 < u < 1200
        assert 40 < v < 760
    assert page.evaluate("watch.view.toScreen(30, 10)")[0] > 1200 * 0.95, "what is unknown takes room"
    page.close()
    swarm.server.close()
    assert page.errors == []


def test_links_by_infrared_are_dashed(live: WatchedPage) -> None:
    """Beta measures a landmark by infrared, alpha sees beta by its camera; both lines are that colour."""
    show_only(live, "sightings")
    screen(live)

    def share(begin: str, end: str) -> float:
        """Of the line between two places that is painted."""
        a, b = (np.array(live.evaluate(f"watch.view.toScreen({place})")) for place in (begin, end))
        points = a + (b - a) * np.linspace(0.25, 0.75, 101)[:, None]
        picture = screen(live)
        used = np.array([live.evaluate("watch.colour('used')")[k : k + 2] for k in (5, 3, 1)])
        colour = np.array([int(one, 16) for one in used], dtype=float)
        paper = picture[2 * picture.shape[0] // 3, 5].astype(float)
        painted = [
            min(
                np.abs(picture[round(v) + dv, round(u) + du] - paper).sum()
                < np.abs(picture[round(v) + dv, round(u) + du] - colour).sum()
                for du in (-1, 0, 1)
                for dv in (-1, 0, 1)
            )
            for u, v in points
        ]
        return 1.0 - float(np.mean(painted))

    assert share("0.5, 0.25", "-0.5, 0.5") > 0.95
    assert 0.3 < share("-0.5, 0.5", "1, 1") < 0.9


def show_only(page: WatchedPage, *names: str) -> None:
    """Some of the layers."""
    page.evaluate(
        f"{{ for (const name of Object.keys(watch.shows)) watch.shows[name] = {[*names]}.includes(name);"
        " watch.touch() }"
    )


def near(page: WatchedPage, u: float, v: float, name: str) -> bool:
    """Whether a colour of the page's is painted within a pixel of a place."""
    picture = screen(page)
    text = page.evaluate(f"watch.colour('{name}')")
    colour = np.array([int(text[k : k + 2], 16) for k in (5, 3, 1)], dtype=float)
    around = picture[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2].reshape(-1, 3).astype(float)
    return bool(np.abs(around - colour).max(axis=1).min() < 60)


def screen(page: WatchedPage) -> Picture:
    """What is painted (height, width, 3) in blue, green and red, once the page has nothing more to paint."""
    page.until("watch.settled")
    data = np.frombuffer(page.page.screenshot(style=_CANVASES_ONLY), dtype=np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert picture is not None
    return picture.astype(np.uint8)
