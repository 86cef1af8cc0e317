"""Maps, goals and aerial images of a run: read from a bag, written for viewers, played on the page."""

import base64
import gzip
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from page_frames import unpack

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter, typestore
from swarm_loc_estimator.common.messages.cdr import OCCUPANCY_GRID, ODOMETRY, POSE_STAMPED, CdrError
from swarm_loc_estimator.common.messages.poses import UNKNOWN_COVARIANCE, encode_odometry, encode_pose_stamped
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.identification.memory import Identities
from swarm_loc_estimator.mapping.messages import MAX_CELLS, decode_occupancy_grid
from swarm_loc_estimator.offline.export import write_mcap
from swarm_loc_estimator.offline.recorded_bag import MapReader
from swarm_loc_estimator.offline.replay import AerialImages, replay
from swarm_loc_estimator.offline.report.report import recorded
from swarm_loc_estimator.sensors.aerial import AerialRows
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

SECOND = 1_000_000_000
SWARM = Swarm(robots=(Robot("a", start=(0.0, 0.0, 0.0)), Robot("b", start=(1.0, 0.0, 0.0))))


def grid_bytes(
    cells: np.ndarray[Any, np.dtype[np.int8]], stamp_ns: int = 0, frame: str = "map", resolution: float = 0.5
) -> bytes:
    """A serialized map, by the type store."""
    types = typestore().types
    time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    origin = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=-1.0, y=2.0, z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=np.sin(0.1), w=np.cos(0.1)),
    )
    height, width = cells.shape
    message = types[OCCUPANCY_GRID](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id=frame),
        info=types["nav_msgs/msg/MapMetaData"](
            map_load_time=time, resolution=resolution, width=width, height=height, origin=origin
        ),
        data=cells.reshape(-1),
    )
    return bytes(typestore().serialize_cdr(message, OCCUPANCY_GRID))


@given(st.integers(1, 9), st.integers(1, 9), st.text("abé/", max_size=7), st.integers(0, 2**31 * SECOND - 1))
def test_a_map_is_read_as_it_was_written(height: int, width: int, frame: str, stamp_ns: int) -> None:
    cells = np.arange(height * width, dtype=np.int8).reshape(height, width) - 1
    found = decode_occupancy_grid(grid_bytes(cells, stamp_ns, frame))
    assert (found.stamp_ns, found.frame_id, found.resolution) == (stamp_ns, frame, 0.5)
    assert found.origin == pytest.approx((-1.0, 2.0, 0.2))
    np.testing.assert_array_equal(found.cells, cells)


def test_bytes_that_are_no_map_are_refused() -> None:
    whole = grid_bytes(np.zeros((3, 4), np.int8))
    for length in range(len(whole)):
        with pytest.raises(CdrError):
            decode_occupancy_grid(whole[:length])
    with pytest.raises(CdrError):
        decode_occupancy_grid(whole + bytes(8))
    with pytest.raises(CdrError):
        decode_occupancy_grid(grid_bytes(np.zeros((1, 4), np.int8), resolution=float("nan")))
    with pytest.raises(CdrError, match=f"a map of {MAX_CELLS + 1} x 1 cells"):
        decode_occupancy_grid(grid_bytes(np.zeros((1, MAX_CELLS + 1), np.int8)))


@given(st.lists(st.integers(0, 3), min_size=1, max_size=80))
def test_maps_are_thinned_out_and_the_newest_is_kept(later_s: list[int]) -> None:
    data = grid_bytes(np.zeros((2, 2), np.int8))
    reader, log_ns = MapReader(SWARM, max_bytes=10 * len(data)), 0
    for step_s in later_s:
        log_ns += step_s * SECOND
        reader.add(MessageBatch.of([SerializedMessage(0, data, log_ns)]))
    kept = [one.log_ns for one in reader.maps()]
    assert 1 <= len(kept) <= 11
    assert kept == sorted(kept)
    assert kept[-1] == log_ns
    assert len(later_s) > 10 or len(kept) == len(later_s)


def test_who_is_who_comes_to_the_image_in_which_it_was_so() -> None:
    images = AerialImages()
    stamps, numbers = np.array([1, 1, 2]), np.array([0, 1, 0])
    pose, nothing = np.arange(9.0).reshape(3, 3), np.zeros(3, np.int64)
    images.add(AerialRows(nothing - 1, stamps, numbers, pose, np.zeros((3, 3, 3)), nothing))
    for probability in (0.5, 0.9):  # what is known changes
        images.note(Identities(1, np.array([1, -1]), np.array([probability, 0.3])))
    images.note(Identities(7, np.array([0, 1]), np.array([1.0, 1.0])))
    first, second = images.images()
    assert (first.stamp_ns, first.robot.tolist(), first.probability.tolist()) == (1, [-1, 0], [0.0, 0.9])
    assert (second.stamp_ns, second.robot.tolist(), second.probability.tolist()) == (2, [-1], [0.0])
    assert first.position.tolist() == [[0.0, 1.0], [3.0, 4.0]]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots that stand, a map that grows, and goals."""
    path = tmp_path_factory.mktemp("bags") / "mapped"
    stamps_ns = np.arange(1, 41) * SECOND // 10
    with BagWriter(path) as writer:
        for robot in SWARM.robots:
            writer.add_topic(f"{robot.name}/odom", ODOMETRY)
            writer.add_topic(f"{robot.name}/goal", POSE_STAMPED)
        writer.add_topic("map", OCCUPANCY_GRID)
        messages = encode_odometry(
            "a/odom",
            "a/base_link",
            stamps_ns,
            np.zeros((40, 3)),
            np.zeros((40, 3)),
            np.eye(6),
            UNKNOWN_COVARIANCE,
        )
        for k, message in enumerate(messages):
            for robot in SWARM.robots:
                writer.write(f"{robot.name}/odom", int(stamps_ns[k]), message)
            if k % 10 == 5:
                writer.write("map", int(stamps_ns[k]), grid_bytes(np.full((2, 3), k, np.int8)))
                goal = encode_pose_stamped("map", stamps_ns[k : k + 1], np.array([[k, 1.0, 0.5]]))[0]
                writer.write(f"{'ab'[k == 25]}/goal", int(stamps_ns[k]), goal)
        writer.write("map", int(stamps_ns[-1]), b"no map")
    return path


def test_map_and_goals_of_a_bag_come_to_viewers_and_to_the_page(bag: Path, tmp_path: Path) -> None:
    result = replay(bag, SWARM, keep_sightings=True)
    assert [int(one.grid.cells[0, 0]) for one in result.maps] == [5, 15, 25, 35]
    assert "1 messages of maps or goals are malformed." in result.remarks
    write_mcap(result, tmp_path / "new" / "run.mcap")
    with BagReader(tmp_path / "new" / "run.mcap") as reader:
        found: dict[str, list[bytes]] = {}
        for topic, _, _, data in reader.messages(["map", "a/goal", "b/goal"]):
            found.setdefault(topic, []).append(bytes(data))
    assert [int(decode_occupancy_grid(data).cells[0, 0]) for data in found["map"]] == [5, 15, 25, 35]
    assert (len(found["a/goal"]), len(found["b/goal"])) == (3, 1)
    frames = frames_of(recorded(result))
    maps = [(header, columns) for header, columns in frames if header["kind"] == "map"]
    assert [header["origin"] for header, _ in maps] == [pytest.approx([-1.0, 2.0, 0.2])] * 4
    assert [columns["cells"].tolist() for _, columns in maps] == [[k] * 6 for k in (5, 15, 25, 35)]
    goals = [columns for header, columns in frames if header["kind"] == "goals"]
    assert [dict(zip(one["robot"].tolist(), one["x"].tolist(), strict=True)) for one in goals] == [
        {0: 5.0},
        {0: 15.0},
        {0: 15.0, 1: 25.0},
        {0: 35.0, 1: 25.0},
    ]


def frames_of(text: str) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """All frames of a recording, as the page reads them."""
    data = gzip.decompress(base64.b64decode(text))
    at = 4 + struct.unpack_from("<I", data)[0]
    json.loads(data[4:at])
    frames = []
    while at < len(data):
        header, columns = unpack(data[at:])
        frames.append((header, columns))
        header_end = 4 + struct.unpack_from("<I", data, at)[0]
        at += header_end + sum(-(-one.nbytes // 8) * 8 for one in columns.values())
    return frames
