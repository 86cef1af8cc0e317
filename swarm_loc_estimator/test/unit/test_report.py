"""Reports and figures of replays, also of those in the pages."""

import math
import re
import shutil
import struct
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.shared.bags import copy_part
from swarm_loc_estimator.cli.calibrate import main as calibrate
from swarm_loc_estimator.cli.replay import main as main_tum
from swarm_loc_estimator.cli.replay_map import main, read_walls
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.settings import MapperSettings
from swarm_loc_estimator.offline.calibration.recording import read_recording
from swarm_loc_estimator.offline.export import TumError, read_truth, read_tum, write_tum
from swarm_loc_estimator.offline.map_replay import MapFigures, map_figures, replay_map, truth_of
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.report.plots import plot_overview
from swarm_loc_estimator.offline.report.report import text_report, write_report
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Landmark, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.settings import Settings

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
    folder = tmp_path_factory.mktemp("reports") / "new" / "folder"
    write_report(result_of(2, title="<b>bag & more"), folder)
    return folder


@pytest.fixture
def old_report(report_of_two: Path, tmp_path: Path) -> Path:
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


BAGS = Path(__file__).parents[3] / "bags"
BEGINNING_S = 30.0


def replayed(bag: str, description: str = "swarm.yaml", settings: Settings | None = None) -> ReplayResult:
    return replay(BAGS / bag, load_swarm(BAGS / bag / description), settings)


def assert_good(result: ReplayResult, metres: float, degrees: float, nees: tuple[float, float]) -> None:
    """RMSE of all robots together at most so large, NEES within a range."""
    errors = result.overall
    assert errors.position_rmse < metres
    assert np.degrees(errors.heading_rmse) < degrees
    assert nees[0] < errors.nees < nees[1]


def test_twenty_droplets_are_located_by_infrared_and_byte_for_byte_the_same_again(tmp_path: Path) -> None:
    """3.1 mm, 1.3 degrees, NEES 1.2, two of them with fixes; again for half a minute."""
    result = replayed("droplets_twenty")
    assert_good(result, 0.0045, 1.7, (0.8, 4.5))
    assert np.isfinite(result.poses[-1]).all()
    copy_part(BAGS / "droplets_twenty", tmp_path / "beginning", BEGINNING_S)
    again = replay(tmp_path / "beginning", result.swarm)
    same = len(again.stamp_ns) - 3  # the last ones lack what the cut has taken
    assert same > 250
    assert np.isfinite(again.poses[same - 1]).all(axis=-1).sum() > 10
    for name in ("stamp_ns", "poses", "covariances"):
        assert getattr(again, name)[:same].tobytes() == getattr(result, name)[:same].tobytes()


def test_the_robots_of_the_demo_are_located_to_millimetres() -> None:
    """2.7 mm and 1.1 degrees."""
    assert_good(replayed("eight_five_robots"), 0.0035, 1.5, (2.0, 3.6))


def test_five_robots_that_calibrate_themselves_are_located_to_millimetres() -> None:
    """3.3 mm in the world of systematic errors, 7 mm if not described, 21 mm by the paper's filter."""
    assert_good(replayed("eight_five_robots_w2", "self_calibrating.yaml"), 0.0045, 1.5, (0.8, 3.5))
    assert_good(replayed("eight_five_robots_w2"), 0.0095, 1.8, (0.8, 4.5))
    paper = replayed("eight_five_robots_w2", settings=Settings(max_fault_score=1e9))
    assert paper.overall.position_rmse > 0.015


def test_e_pucks_are_located_by_anonymous_detections_from_above_and_byte_for_byte_the_same_again() -> None:
    """6.4 mm and 3.1 degrees, with unknown starts and nothing else."""
    result, again = (replayed("aerial_five") for _ in range(2))
    assert_good(result, 0.008, 4.0, (1.5, 4.0))
    assert np.isnan(result.poses[0]).all()
    assert np.isfinite(result.poses[200:]).all(axis=-1).mean() > 0.95
    assert result.counters["identities answered"] >= 5
    for name in ("stamp_ns", "poses", "covariances"):
        assert getattr(again, name).tobytes() == getattr(result, name).tobytes()


LEDS = {"pushbot1": 1000.0, "pushbot2": 1111.111}


def figures_of(name: str, leds: dict[str, float]) -> MapFigures:
    bag = BAGS / name
    swarm = load_swarm(bag / "swarm.yaml")
    mapper, feed, _ = replay_map(bag, swarm, MapperSettings(), leds, lambda *_: None)
    assert set(feed.all_drops) <= {"light_of_nobody"}
    tracks = truth_of(bag, swarm)
    truth = {number: tracks[robot.name] for number, robot in enumerate(swarm.robots)}
    return map_figures(mapper, truth, read_walls(bag / "walls.csv"))


def test_one_pushbot_makes_the_same_map_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, files = BAGS / "pushbot_one", []
    copy_part(bag, tmp_path / "bag", 45.0)
    beside = ["--swarm", str(bag / "swarm.yaml"), "--walls", str(bag / "walls.csv")]
    for name in ("a", "b"):
        out = tmp_path / name
        assert main([str(tmp_path / "bag"), "--out", str(out), *beside]) == 0
        files.append({path.name: path.read_bytes() for path in out.iterdir()})
    assert set(files[0]) == {"map.yaml", "map.pgm", "map.png", "stops.csv"}
    assert files[0] == files[1]
    assert "% of the walls" in capsys.readouterr().out


def test_the_map_of_one_pushbot_is_as_good_as_is_said() -> None:
    """8.0 cm and .73 degrees after seven minutes without having come back, 70 % of the walls, 5.4 cm off."""
    figures = figures_of("pushbot_one", {})
    assert figures.stops > 35
    assert figures.position_m < 0.10
    assert math.degrees(figures.heading_rad) < 1.0
    assert figures.coverage > 0.65
    assert figures.wall_m < 0.07


def test_two_pushbots_map_more_of_the_hall_in_less_time() -> None:
    """2.1 cm and .82 degrees after five minutes, all of the walls, 1.8 cm off."""
    figures = figures_of("pushbots_two", LEDS)
    assert figures.stops > 60
    assert figures.position_m < 0.06
    assert math.degrees(figures.heading_rad) < 1.2
    assert figures.coverage > 0.88
    assert figures.wall_m < 0.045


def test_the_estimator_follows_the_mappers_fixes_and_finds_the_slip() -> None:
    """7 cm on the way, as the fixes were when published, with a covariance that says so."""
    result = replay(BAGS / "pushbots_two", load_swarm(BAGS / "pushbots_two" / "swarm.yaml"))
    errors = result.overall
    assert np.isfinite(result.poses[-1]).all()
    assert errors.position_rmse < 0.14
    assert 0.3 < errors.nees < 3.5
    assert result.counters["measurements used"] == result.counters["messages on <robot>/fix"] == 48


def test_a_map_without_anything_to_compare_with_has_no_figures() -> None:
    figures = map_figures(CooperativeMapper(), {}, np.zeros((0, 4)))
    assert not figures.stops
    assert math.isnan(figures.position_m)
    assert math.isnan(figures.coverage)
    assert not figures.sentence()


BAG = Path(__file__).resolve().parents[3] / "bags" / "eight_one_robot_slow"
LINE = "12.5 1 2 0 0 0 0 1"


@pytest.fixture(scope="module")
def result() -> ReplayResult:
    return replay(BAG)


@given(
    stamps_ns=st.lists(st.integers(0, 4 * 10**18), min_size=1, max_size=5, unique=True),
    pose=st.tuples(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0), st.floats(-3.14, 3.14)),
)
def test_what_is_written_is_read(
    result: ReplayResult,
    tmp_path_factory: pytest.TempPathFactory,
    stamps_ns: list[int],
    pose: tuple[float, float, float],
) -> None:
    folder = tmp_path_factory.mktemp("tum")
    stamp_ns = np.array(sorted(stamps_ns))
    poses = np.tile(pose, (stamp_ns.size, 1))
    write_tum(replace(result, stamp_ns=stamp_ns, poses=poses[:, None], truth={}), folder)
    found = read_tum(folder / f"{result.swarm.robots[0].name}.tum")
    assert found.stamp_ns.tolist() == stamp_ns.tolist()
    np.testing.assert_allclose(found.pose, poses, atol=1e-9)


def test_poses_are_sorted_and_comments_ignored(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("# seconds x y z qx qy qz qw\n2 1 0 0 0 0 1 0\n\n1.000000001 3 4 9 0 0 0 2\n")
    found = read_tum(path)
    assert found.stamp_ns.tolist() == [1_000_000_001, 2_000_000_000]
    np.testing.assert_allclose(found.pose, [[3.0, 4.0, 0.0], [1.0, 0.0, np.pi]])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "has no pose"),
        ("# nothing else\n", "has no pose"),
        (f"{LINE}\n12.6 1 2 0 0 0 1\n", "line 2: '12.6 1 2 0 0 0 1' is no pose: seconds x y z qx qy qz qw"),
        (f"{LINE} 9\n", "line 1"),
        ("stamp x y z qx qy qz qw\n", "line 1"),
        ("-1 1 2 0 0 0 0 1\n", "line 1"),
        ("1 nan 2 0 0 0 0 1\n", "has no pose"),
        ("nan 1 2 0 0 0 0\n", "line 1"),
        ("timestamp,x,y,z\n", "line 1"),
        ("\x00\x01", "line 1"),
    ],
)
def test_what_is_no_trajectory_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "a.truth.tum"
    path.write_text(text)
    with pytest.raises(TumError) as refused:
        read_tum(path)
    assert said in str(refused.value)
    assert "a.truth.tum" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_poses_that_are_not_finite_are_left_out_and_counted(
    result: ReplayResult, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = result.swarm.robots[0].name
    write_tum(result, tmp_path)
    path = tmp_path / f"{name}.truth.tum"
    clean = read_tum(path)
    bad = ["1 nan 2 0 0 0 0 1", "nan 1 2 0 0 0 0 1", "inf 1 2 0 0 0 0 1"]
    bad += ["1 1 2 0 0 0 0 0", "1 1 2 0 0 0 0 1e999"]
    path.write_text("\n".join([*bad, *path.read_text().splitlines()]))
    found = read_tum(path)
    assert found.left_out == len(bad)
    assert np.array_equal(found.stamp_ns, clean.stamp_ns)
    assert np.array_equal(found.pose, clean.pose)
    assert main_tum([str(BAG), "--out", str(tmp_path / "out"), "--truth", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert f"Ground truth of {name}: {len(bad)} poses that are not finite are left out." in said
    assert "No ground truth" not in said


def test_marks_of_editors_and_indented_comments_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text(f"\ufeff# x\n  # y\n\t{LINE}\r\n \t \n", encoding="utf-8")
    assert read_tum(path).stamp_ns.tolist() == [12_500_000_000]
    path.write_text(f"\ufeff{LINE}\n", encoding="utf-8")
    assert read_tum(path).stamp_ns.tolist() == [12_500_000_000]


@pytest.mark.parametrize(("off_s", "where"), [(-500, "before"), (1000, "after")])
def test_truth_of_another_clock_is_said_and_the_poses_are_written(
    result: ReplayResult, tmp_path: Path, capsys: pytest.CaptureFixture[str], off_s: int, where: str
) -> None:
    robot = result.swarm.robots[0].name
    moved = replace(result, stamp_ns=result.stamp_ns + off_s * 10**9, truth={})
    write_tum(moved, tmp_path)
    (tmp_path / f"{robot}.tum").rename(tmp_path / f"{robot}.truth.tum")
    assert main_tum([str(BAG), "--out", str(tmp_path / "out"), "--truth", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert said.count(f"Ground truth of {robot} is of another time, begins ") == 1
    assert f" s {where} the first pose, and is not used." in said
    assert "No ground truth to compare with." in said
    assert len((tmp_path / "out/poses.csv").read_text().splitlines()) > 100
    assert (tmp_path / "out/report.html").exists()


def test_ground_truth_replaces_that_of_the_bag(
    result: ReplayResult, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, swarm = result.swarm.robots[0].name, result.swarm
    write_tum(result, tmp_path)
    truth = read_truth(tmp_path, swarm)
    again = replay(BAG, swarm, truth=truth)
    assert again.poses.tobytes() == result.poses.tobytes()
    assert again.summaries[name].position_rmse == pytest.approx(
        result.summaries[name].position_rmse, abs=1e-6
    )
    moved = Trajectory(truth[name].stamp_ns, truth[name].pose + np.array([10.0, 0.0, 0.0]))
    assert replay(BAG, swarm, truth={name: moved}).summaries[name].position_rmse > 9.0
    assert main_tum([str(BAG), "--out", str(tmp_path / "out"), "--truth", str(tmp_path)]) == 0
    table = [line for line in text_report(again).splitlines() if line.startswith(f"{name} ")]
    assert table[0] in capsys.readouterr().out


def test_a_folder_without_ground_truth_is_refused(result: ReplayResult, tmp_path: Path) -> None:
    name = result.swarm.robots[0].name
    (tmp_path / f"{name}.tum").write_text(LINE)  # an estimate, as --tum writes it
    with pytest.raises(TumError, match=rf"has no ground truth of a robot, such as {name}\.truth\.tum\."):
        read_truth(tmp_path, result.swarm)


def test_a_calibration_uses_ground_truth_of_files(result: ReplayResult, tmp_path: Path) -> None:
    swarm, name = result.swarm, result.swarm.robots[0].name
    first = Trajectory(np.array([1, 2, 2, 3]), np.arange(12.0).reshape(4, 3))
    assert read_recording(BAG, swarm, truth={name: first}).truth[name].stamp_ns.tolist() == [1, 2, 3]
    write_tum(result, tmp_path)
    (short := tmp_path / "short").mkdir()
    lines = (tmp_path / f"{name}.truth.tum").read_text().splitlines(keepends=True)
    (short / f"{name}.truth.tum").write_text("".join(lines[:2]))
    for folder, status in ((short, 1), (tmp_path, 0)):
        out = ["--out", str(tmp_path / "new.yaml"), "--plain", "--evaluations", "1"]
        assert calibrate([str(BAG), "--truth", str(folder), *out]) == status
