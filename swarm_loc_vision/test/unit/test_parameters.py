"""Parameters, pages and files of the vision package."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bench.shared.full_disk import full_after
from bench.shared.parameter_table import markdown_table
from bench.vision.scenes import CAMERA, HEIGHT, WIDTH, Look, random_scene
from swarm_loc_estimator.common.files import FileError
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_estimator.swarm.swarm import Face, Landmark, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_vision.aerial.ground_control import AerialParameters, FloorMarker, Ground, save_ground
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.events.tracker import EventTrackerParameters, laser_calibration, light_sources
from swarm_loc_vision.laser.calibration import LaserCalibration, save_laser
from swarm_loc_vision.markers.detector import DetectorParameters, detector_maker, parse_ids, parse_lengths
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.foreign_markers import ForeignParameters
from swarm_loc_vision.sheets import print_markers
from swarm_loc_vision.sheets.print_markers import board_page, save_pdf

DOC = Path(__file__).parents[2] / "doc"
FAMILY = "aruco_mip_36h12"


@pytest.mark.parametrize(
    ("page", "parameters"),
    [
        ("marker_detector_node.md", DetectorParameters),
        ("marker_bridge_node.md", ForeignParameters),
        ("aerial_camera_node.md", AerialParameters),
        ("event_tracker_node.md", EventTrackerParameters),
    ],
)
def test_the_page_says_what_the_table_says(page: str, parameters: type) -> None:
    assert markdown_table(parameters) in (DOC / page).read_text(encoding="utf-8")


def test_every_marker_of_the_swarm_has_its_own_size(tmp_path: Path) -> None:
    image, truths = random_scene(np.random.default_rng(4), family_named(FAMILY), 8, Look())
    first, *others = truths
    robot = Robot("a", faces=(Face("front", first.marker_id, yaw=0.0, size=first.length),))
    marks = tuple(Landmark(one.marker_id, yaw=0.0, size=one.length) for one in others)
    save_swarm(Swarm((robot,), marks), tmp_path / "swarm.yaml")
    parameters = DetectorParameters(family=FAMILY, swarm_file=str(tmp_path / "swarm.yaml"))
    detector = detector_maker(parameters)(Camera.from_matrix((WIDTH, HEIGHT), CAMERA, ()))

    detections = detector.detect(image)

    assert detections.poses is not None
    found = dict(zip(detections.id.tolist(), detections.poses.position[:, 0, 2].tolist(), strict=True))
    expected = {truth.marker_id: pytest.approx(truth.position[2], rel=0.02) for truth in truths}
    assert found == expected


def test_ids() -> None:
    assert parse_ids("ids", ["7", "0-2", " 2-3 "], 10).tolist() == [0, 1, 2, 3, 7]
    assert parse_ids("ids", [], 10).tolist() == []


@pytest.mark.parametrize("text", ["", "a", "-1", "3-", "5-3", "10", "0-10", "1.5"])
def test_what_is_no_id_is_refused(text: str) -> None:
    with pytest.raises(ParameterError):
        parse_ids("ids", [text], 10)


def test_lengths() -> None:
    assert parse_lengths(["1-2:0.08", "5:.03"], 10) == {1: 0.08, 2: 0.08, 5: 0.03}


@pytest.mark.parametrize("text", ["1", "1:", "1:0", "1:-0.1", "1:11", "10:0.1", ":0.1", "1:0.1m"])
def test_what_is_no_length_is_refused(text: str) -> None:
    with pytest.raises(ParameterError):
        parse_lengths([text], 10)


def test_the_laser_comes_first_and_lights_by_frequency() -> None:
    sources = light_sources(EventTrackerParameters(light_frequencies=("1000", "700", "700")))
    assert [(one.frequency, one.is_above) for one in sources] == [
        (450.0, False),
        (700.0, True),
        (1000.0, True),
    ]


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"laser_frequency": 0.0}, "leave nothing to track"),
        ({"laser_frequency": 3.0}, "laser_frequency = 3.0 must lie in"),
        ({"light_frequencies": ("nan",)}, "light_frequencies = 'nan' must lie in"),
        (
            {"light_frequencies": tuple(str(one) for one in range(100, 140))},
            "has 40 entries, the most are 31",
        ),
    ],
)
def test_frequencies_that_cannot_be_are_named(changed: dict[str, object], sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        light_sources(EventTrackerParameters(**changed))  # type: ignore[arg-type]


def test_the_calibration_is_the_one_named(tmp_path: Path) -> None:
    save_laser(tmp_path / "laser.yaml", LaserCalibration())
    parameters = EventTrackerParameters(calibration=str(tmp_path / "laser.yaml"))
    assert laser_calibration(parameters) == LaserCalibration()
    assert laser_calibration(EventTrackerParameters()) is None


def sheets(folder: Path) -> None:
    family = family_named("artoolkit_bch_thin")
    save_pdf([board_page(0, 3, 4, 40.0, family, "a4")], family, "a4", folder / "a.pdf")


def ground(folder: Path) -> None:
    markers = tuple(FloorMarker(k, 0.1 * k, 0.0) for k in range(100))
    save_ground(Ground(markers=markers, family=family_named("artoolkit_bch_thin")), folder / "a.yaml")


def laser(folder: Path) -> None:
    save_laser(folder / "laser.yaml", LaserCalibration())


WRITERS = [sheets, ground, laser]


@pytest.mark.parametrize("write", WRITERS)
def test_a_full_disk_leaves_the_old_file_and_is_said_with_the_path(
    write: Callable[[Path], None], tmp_path: Path
) -> None:
    write(tmp_path)
    (file,) = tmp_path.iterdir()
    old = file.read_bytes()
    with full_after(100), pytest.raises(FileError) as said:
        write(tmp_path)
    assert str(said.value) == f"{file} cannot be written: File too large."
    assert [one.read_bytes() for one in tmp_path.iterdir()] == [old]


@pytest.mark.parametrize("write", WRITERS)
def test_nothing_is_written_through_links(write: Callable[[Path], None], tmp_path: Path) -> None:
    write(tmp_path)
    (file,) = tmp_path.iterdir()
    other = file.rename(tmp_path / "other")
    other.write_text("of others")
    file.symlink_to(other)
    with pytest.raises(FileError, match="cannot be written: it is a symbolic link"):
        write(tmp_path)
    assert other.read_text() == "of others"


@pytest.mark.parametrize("more", [[], ["--out", "a/b.pdf"]])
def test_a_full_disk_is_found_before_markers_are_drawn(
    more: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with full_after(100_000), pytest.raises(SystemExit):
        print_markers.main(["--board", "2x2", *more])
    assert "cannot be written: File too large" in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == []


def test_a_link_in_the_way_of_a_board_is_found_before_markers_are_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a_board.yaml").symlink_to("elsewhere")
    assert print_markers.main(["--board", "2x2", "--out", str(tmp_path / "a.pdf")]) == 1
    assert "a_board.yaml cannot be written: it is a symbolic link" in capsys.readouterr().err
    assert not (tmp_path / "a.pdf").exists()
