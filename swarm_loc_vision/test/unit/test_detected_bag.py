"""A bag of images made a bag of detections: what is found, what it replays to, and what is dropped."""

import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from bench.shared.bags import copy_part
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.detections import decode_detections
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.markers.detect import main

BAG = Path(__file__).parents[3] / "bags" / "eight_pictures"
DESCRIPTION = BAG / "self_calibrating.yaml"
SWARM = load_swarm(DESCRIPTION)
BEGINNING_S = 2.5
GAP_NS = 200_000_000
TO_EDGE = 0.47  # Of the image, in focal lengths, less what hidden errors of the world may shift a marker by
MAX_OBLIQUE, ROBOT_M = math.radians(60.0), 0.08
CAMERA_INFO, IMAGE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/CompressedImage"
Messages = list[tuple[str, str, int, bytes]]


@pytest.fixture(scope="module")
def detected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("detected") / "detected"
    assert main([str(BAG), "--output", str(path), "--swarm", str(DESCRIPTION)]) == 0
    return path


@pytest.fixture(scope="module")
def replayed(detected: Path) -> ReplayResult:
    return replay(detected, SWARM)


def messages(bag: Path) -> Messages:
    with BagReader(bag) as reader:
        return list(reader.messages())


def write(bag: Path, content: Messages) -> None:
    with BagWriter(bag) as writer:
        for name, kind in dict.fromkeys((name, kind) for name, kind, _, _ in content):
            writer.add_topic(name, kind)
        for name, _, log_ns, data in content:
            writer.write(name, log_ns, data)


def in_view(pose: FloatArray, other: FloatArray) -> set[int]:
    """Landmarks that a robot at a pose (3,) sees well inside its image, and not behind the other one."""
    other_x, other_y, _ = se2.between(pose, other)
    seen = set()
    for mark in SWARM.landmarks:
        x, y, yaw = se2.between(pose, np.array([mark.x, mark.y, mark.yaw]))
        towards = math.atan2(y, x)
        oblique = abs(se2.wrap_angle(yaw - towards - math.pi))
        aside = abs(x * other_y - y * other_x) / math.hypot(x, y)
        is_hidden = aside < ROBOT_M and 0.0 < other_x < x
        if abs(towards) < math.atan(TO_EDGE) and oblique < MAX_OBLIQUE and not is_hidden:
            seen.add(mark.id)
    return seen


def test_markers_in_view_are_found_and_no_others(detected: Path, replayed: ReplayResult) -> None:
    """290 of 292."""
    expected = found = 0
    for name, _, _, data in messages(detected):
        if not name.endswith("/detections"):
            continue
        array = decode_detections(data)
        ids = set(array.detections["id"].tolist())
        assert len(ids) == len(array.detections)
        assert ids <= set(SWARM.owner_of)
        own, other = sorted(replayed.truth, key=lambda robot: not name.startswith(robot))
        stamps_ns = np.array([array.stamp_ns])
        poses = [interpolate(replayed.truth[robot], stamps_ns, GAP_NS)[0][0] for robot in (own, other)]
        if np.isfinite(poses).all():
            visible = in_view(*poses)
            expected += len(visible)
            found += len(visible & ids)
    assert expected > 250
    assert found > 0.98 * expected


def test_the_detections_locate_the_robots(replayed: ReplayResult) -> None:
    """To 4.7 mm and 1.1 degrees, NEES 1.1."""
    errors = replayed.overall
    assert errors.position_rmse < 0.0065
    assert np.degrees(errors.heading_rmse) < 1.6
    assert 0.5 < errors.nees < 3.5
    assert np.isfinite(replayed.poses[-1]).all()


def test_the_same_images_give_the_same_bytes(detected: Path, tmp_path: Path) -> None:
    copy_part(BAG, tmp_path / "beginning", BEGINNING_S)
    shutil.copyfile(BAG / "swarm.yaml", tmp_path / "beginning" / "swarm.yaml")
    for part in ("one", "two"):
        (tmp_path / part).mkdir()
        arguments = ["--output", str(tmp_path / part / "bag"), "--swarm", str(DESCRIPTION)]
        assert main([str(tmp_path / "beginning"), *arguments]) == 0
    one, two = tmp_path / "one" / "bag", tmp_path / "two" / "bag"
    assert (one / "bag.mcap").read_bytes() == (two / "bag.mcap").read_bytes()
    assert (one / "swarm.yaml").read_bytes() == DESCRIPTION.read_bytes()
    beginning = messages(one)
    assert beginning == messages(detected)[: len(beginning)]
    kept = [message for message in messages(BAG) if not message[0].endswith("compressed")]
    assert [m for m in messages(detected) if not m[0].endswith("detections")] == kept


def test_images_of_other_topics_are_kept(tmp_path: Path) -> None:
    own = [message for message in messages(BAG) if message[0].startswith("epuck1/")]
    info = next(message for message in own if message[1] == CAMERA_INFO)
    _, kind, log_ns, data = next(message for message in own if message[1] == IMAGE)
    image = ("epuck1/image_raw/compressed", kind, log_ns, data)
    others = [(name, kind, log_ns, data) for name in ("epuck1/image_rect/compressed", "overhead/compressed")]
    write(tmp_path / "bag", [info, image, *others])
    assert main([str(tmp_path / "bag"), "--output", str(tmp_path / "out")]) == 0
    left = messages(tmp_path / "out")
    assert [message for message in left if message[0] != "epuck1/detections"] == [info, *others]


def test_bad_images_are_counted_and_the_others_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = [message for message in messages(BAG) if message[0].startswith("epuck1/")]
    info = next(message for message in own if message[1] == CAMERA_INFO)
    early, cut, endless, whole = [message for message in own if message[1] == IMAGE][:4]
    cut = (*cut[:3], cut[3][: len(cut[3]) // 2])
    endless = (*endless[:3], endless[3].replace(b"\xff\xd9", b"\0\0"))
    infos = [(*info[:2], early[2] + 1, info[3]), (*info[:2], early[2] + 2, info[3][: len(info[3]) // 2])]
    write(tmp_path / "bag", [early, *infos, cut, endless, whole])
    assert main([str(tmp_path / "bag"), "--output", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    dropped = "dropped: corrupt 2, dropped: corrupt calibration 1, dropped: no_calibration 1"
    assert f"markers (0 fit no square) in 4 images, {dropped}" in said
    assert [m[2] for m in messages(tmp_path / "out") if m[0] == "epuck1/detections"] == [whole[2]]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "There is no bag"),
        ([str(BAG.parent / "eight_one_robot_slow")], "holds no images"),
        ([str(BAG), "--set", "familie=qr"], "'familie' is no parameter; there are family, ids"),
        ([str(BAG), "--set", "robot=epuck1"], "'robot' is no parameter"),
        ([str(BAG), "--set", "family=qr"], "family = 'qr' must be one of"),
        ([str(BAG), "--set", "ids=5,x"], "parameter ids: 'x'"),
        ([str(BAG), "--set", "min_side_px=much"], "min_side_px = 'much' must be a number"),
        ([str(BAG), "--swarm", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_mistakes_are_told_in_a_sentence(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, "--output", str(tmp_path / "out")]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
