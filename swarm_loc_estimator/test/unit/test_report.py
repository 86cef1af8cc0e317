"""Reports of replays: right figures, a page that needs nothing else, pictures of odd results too."""

import re
import shutil
import struct
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.report.plots import plot_overview
from swarm_loc_estimator.offline.report.report import text_report, write_report
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Landmark, Robot, Swarm

SECOND = 1_000_000_000


def result_of(robots: int, ticks: int = 200, truths: int | None = None, title: str = "a bag") -> ReplayResult:
    """Robots that stand on a line, each estimated 0.3 m to the left of the truth with sigma 0.1."""
    swarm = Swarm(
        tuple(Robot(f"r{k}") for k in range(robots)), (Landmark(900, 1.0, 2.0), Landmark(901, 3.0, 0.0))
    )
    stamp_ns = np.arange(ticks, dtype=np.int64) * SECOND // 20
    true = np.zeros((ticks, robots, 3))
    true[:, :, 0] = np.arange(robots)
    covariance = np.tile(0.01 * np.eye(3), (ticks, robots, 1, 1))
    pose = true + np.array([0.0, 0.3, 0.0])
    truth = {f"r{k}": Trajectory(stamp_ns, true[:, k]) for k in range(robots if truths is None else truths)}
    return ReplayResult(
        title,
        swarm,
        stamp_ns,
        pose,
        covariance,
        np.ones((ticks, robots), dtype=np.uint8),
        truth,
        {"gated": 3, "too_old": 14},
        ("A remark.",),
        10.0,
        0.25,
        heading_known=np.ones((ticks, robots), dtype=bool),
    )


class Page(HTMLParser):
    """What a page refers to, and whether its elements close."""

    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:  # noqa: D102
        self.sources += [value or "" for name, value in attrs if name in {"src", "href"}]
        if tag not in {"meta", "img"}:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:  # noqa: D102
        assert self.open.pop() == tag


def png_size(path: Path) -> tuple[int, int]:
    data = path.read_bytes()
    assert data.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", data[16:24])
    return width, height


@pytest.fixture(scope="module")
def report_of_two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a report of two robots, with truth."""
    folder = tmp_path_factory.mktemp("reports") / "new" / "folder"
    write_report(result_of(2, title="<b>bag & more"), folder)
    return folder


@pytest.fixture
def old_report(report_of_two: Path, tmp_path: Path) -> Path:
    """A folder with a report that another one is to replace."""
    shutil.copytree(report_of_two, tmp_path / "report")
    assert {"paths.png", "errors.png"} <= {file.name for file in (tmp_path / "report").iterdir()}
    return tmp_path / "report"


def test_table_has_the_figures() -> None:
    text = text_report(result_of(2))
    rows = {line.split()[0]: line.split()[1:] for line in text.splitlines() if re.match(r"(r\d|all) ", line)}
    assert rows["r0"] == ["200", *["0.3000"] * 5, *["0.00"] * 5, "9.00"]
    assert rows["all"] == ["400", *["0.3000"] * 5, *["0.00"] * 5, "9.00"]
    assert "0.25 s, 40 x real time" in text
    assert re.search(r"too_old +14", text)
    assert "A remark." in text


def test_robots_that_wait_and_robots_without_truth(tmp_path: Path) -> None:
    result = result_of(3, truths=2)
    result.poses[:150, 0] = np.nan
    result.poses[:, 1] = np.nan
    text = text_report(result)
    assert re.search(r"^r0 +50 ", text, re.MULTILINE)
    assert re.search(r"^r1 +0 +-", text, re.MULTILINE)
    assert "r2" not in text
    write_report(result, tmp_path)


@pytest.mark.parametrize("unknown", [slice(40, 90), slice(None)])
def test_robots_whose_heading_is_unknown_for_a_while_or_always(tmp_path: Path, unknown: slice) -> None:
    result = result_of(2)
    result.heading_known[unknown] = False
    files = write_report(result, tmp_path)
    assert files.errors is not None
    assert re.search(r"^r0 +200 +0\.3000 ", files.text.read_text(), re.MULTILINE)


def test_page_is_whole_and_needs_nothing_else(report_of_two: Path) -> None:
    page = Page()
    html = (report_of_two / "report.html").read_text(encoding="utf-8")
    page.feed(html)
    assert page.open == []
    assert len(page.sources) == 3
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    notices = r"/\*!.*?\*/"  # of who wrote a library
    assert "http" not in re.sub(rf"base64,[^\"]*|{notices}", "", html)
    assert "&lt;b&gt;bag &amp; more" in html
    assert "<b>" not in html
    for figure in ("0.3000 m", "9.00", "too_old", "A remark."):
        assert figure in html


def test_equal_results_give_equal_files(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        write_report(result_of(1, ticks=20), tmp_path / folder)
    for name in ("report.txt", "report.html", "overview.png", "errors.png"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_the_overview_ends_with_the_truth(tmp_path: Path) -> None:
    whole, longer = result_of(2, ticks=100), result_of(2, ticks=140)
    longer.covariances[100:] *= 100.0
    for name, result in (("whole", whole), ("longer", replace(longer, truth=whole.truth))):
        plot_overview(result, tmp_path / name)
    assert (tmp_path / "whole").read_bytes() == (tmp_path / "longer").read_bytes()


@pytest.mark.parametrize("robots", [1, 4, 12])
def test_pictures_of_few_and_many_robots(old_report: Path, robots: int) -> None:
    files = write_report(result_of(robots, ticks=20), old_report)
    assert (files.paths is not None) == (old_report / "paths.png").exists() == (robots == 4)
    assert files.errors is not None
    for picture in filter(None, (files.overview, files.paths, files.errors)):
        width, height = png_size(picture)
        assert 300 < height < 4000
        assert 300 < width < 4000


def test_without_truth_there_is_no_error_picture_and_that_is_said(old_report: Path) -> None:
    files = write_report(result_of(2, truths=0), old_report)
    assert files.errors is None
    assert not (old_report / "errors.png").exists()
    assert "No ground truth to compare with" in files.text.read_text()
    assert "No ground truth to compare with" in files.page.read_text()


def test_nothing_at_all_is_still_a_report(tmp_path: Path) -> None:
    empty = ReplayResult(
        "empty",
        Swarm((Robot("a"),)),
        np.empty(0, np.int64),
        np.empty((0, 1, 3)),
        np.empty((0, 1, 3, 3)),
        np.empty((0, 1), np.uint8),
        heading_known=np.empty((0, 1), bool),
    )
    files = write_report(empty, tmp_path)
    assert "No ground truth" in files.text.read_text()
