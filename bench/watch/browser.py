"""Drive a real Chromium without a screen: open the page, wait for what it paints, note what goes wrong."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Browser, Page, sync_playwright

FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
"""Nothing of Chromium's own goes out; without a sandbox since CI runs as root."""
PATIENCE_MS = 15_000
_WAIT = """([condition, patience]) => new Promise((resolve, reject) => {
    const holds = () => {
        try { return condition(); } catch (error) { if (!(error instanceof TypeError)) throw error; }
    };
    const end = performance.now() + patience;
    const look = () => holds() ? resolve() : performance.now() > end ? reject(new Error("waited in vain"))
        : requestAnimationFrame(look);
    look();
})"""


def chromium() -> Path | None:
    """Where Chromium, or what is built from it, is installed; None: nowhere."""
    found = filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome")))
    return next(map(Path, found), None)


@contextmanager
def running_browser(executable: Path) -> Iterator[Browser]:
    """A browser without a window."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=FLAGS)
        yield browser
        browser.close()


class WatchedPage:
    """A page, with all that it should not do.

    Args:
        browser: Opens it.
        url: Of the page.
        size: Width and height [px].

    Attributes:
        page: Playwright's.
        errors: Of scripts and on the console.
        foreign: Addresses of other hosts that it asked.
    """

    def __init__(self, browser: Browser, url: str, size: tuple[int, int] = (1200, 800)) -> None:
        context = browser.new_context(viewport={"width": size[0], "height": size[1]})
        self.page: Page = context.new_page()
        self.errors: list[str] = []
        self.foreign: list[str] = []
        own = urlsplit(url).netloc
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda one: self.errors.append(one.text) if one.type == "error" else None)
        self.page.on("request", lambda request: self._note(own, request.url))
        self.page.goto(url)

    def evaluate(self, expression: str) -> Any:
        """The value of an expression in the page."""
        return self.page.evaluate(f"() => {expression}")

    def until(self, condition: str, patience_ms: int = PATIENCE_MS) -> None:
        """Return once an expression is true in the page, which is asked at each refresh of the screen."""
        self.page.evaluate(f"() => ({_WAIT})([() => ({condition}), {patience_ms}])")

    def place_of(self, robot: int) -> tuple[float, float]:
        """Where a robot is painted [px]."""
        u, v = self.evaluate(f"[watch.painter.u[{robot}], watch.painter.v[{robot}]]")
        return u, v

    def colour_at(self, u: float, v: float) -> list[int]:
        """Red, green, blue and opacity of the upper canvas."""
        context = "document.getElementById('top').getContext('2d')"
        colour: list[int] = self.evaluate(f"[...{context}.getImageData({u}, {v}, 1, 1).data]")
        return colour

    def close(self) -> None:
        """Close it."""
        self.page.context.close()

    def _note(self, own: str, url: str) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("data", "blob") and parts.netloc != own:
            self.foreign.append(url)
