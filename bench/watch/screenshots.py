"""Photograph the page for the documentation: ./run -- python -m bench.watch.screenshots [--only NAME].

Five e-pucks and twenty Droplets as the bags of this repository hold them, three hundred simulated robots,
each replayed by the estimator; shown in Chromium as by `report.html`.
"""

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from playwright.sync_api import Browser

from bench.scenarios.bags import write_bag
from bench.shared.common import OUT, options_of
from bench.shared.grid import GridSettings, simulate_grid
from bench.watch.browser import WatchedPage, chromium, running_browser
from swarm_loc_estimator.common.command_line import swarm_beside
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.report.report import recorded
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.watch.page import page

ROOT = OUT.parent
FOLDER = ROOT / "swarm_loc_estimator" / "doc" / "watch"
SIZE = (1200, 760)
ROBOTS = 300
_GRID_S = 8.0


class Picture(NamedTuple):
    """What to photograph."""

    name: str  # Of the file
    bag: Path  # What was recorded
    share: float  # At which part of the run
    theme: str  # light or dark
    selected: int  # The robot whose numbers are shown, -1 for none


def photograph(browser: Browser, picture: Picture, work: Path, out: Path) -> Path:
    """Replay a bag and take its picture; returns the file."""
    file = work / f"{picture.name}.html"
    result = replay(picture.bag, load_swarm(swarm_beside(picture.bag)), keep_sightings=True)
    file.write_text(page(recorded(result)), encoding="utf-8")
    shown = WatchedPage(browser, file.as_uri(), SIZE)
    shown.until("watch.playing && watch.fitted")
    shown.evaluate(f"{{ watch.setTheme('{picture.theme}'); watch.panel.select({picture.selected}) }}")
    shown.evaluate(f"{{ watch.seek({picture.share}); watch.fit() }}")
    shown.until("watch.settled")
    path = out / f"{picture.name}.png"
    shown.page.screenshot(path=path)
    shown.close()
    if shown.errors or shown.foreign:
        raise RuntimeError(f"{picture.name}: {shown.errors} {shown.foreign}")
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Take all pictures; the exit status."""
    options = options_of(
        __doc__, arguments, out=(FOLDER, "folder for the pictures"), only=("", "the one picture to take")
    )
    executable = chromium()
    if executable is None:
        print("There is no Chromium here: apt-get install chromium.", file=sys.stderr)
        return 1
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, running_browser(executable) as browser:
        grid = Path(folder) / "grid"
        if options.only in ("", "robots300"):
            write_bag(
                simulate_grid(GridSettings(robots=ROBOTS, duration_s=_GRID_S)), grid, f"{ROBOTS} robots."
            )
        for picture in (
            Picture("epucks", ROOT / "bags" / "eight_five_robots", 0.6, "light", 1),
            Picture("droplets", ROOT / "bags" / "droplets_twenty", 0.7, "dark", -1),
            Picture("robots300", grid, 0.9, "light", -1),
        ):
            if options.only not in ("", picture.name):
                continue
            print(photograph(browser, picture, Path(folder), options.out), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
