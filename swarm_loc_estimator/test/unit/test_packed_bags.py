"""Bags that are packed or damaged: what can be read is read, and the rest is told."""

import gc
import os
import shutil
import sqlite3
import struct
import sys
import tempfile
import tracemalloc
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from test_bags import (
    START,
    TOPICS,
    expected,
    read,
    record_of,
    some_messages,
    stored,
    write_bag,
    write_mcap,
    write_sqlite,
)

from bench.shared.full_disk import full_after
from swarm_loc_estimator.common.bags import reader
from swarm_loc_estimator.common.bags.bag_file import MAX_LOG_NS, ReadErrors
from swarm_loc_estimator.common.bags.reader import BagError, BagReader, offered_qos, unpack_messages
from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.files import FileError
from swarm_loc_estimator.common.messages.poses import TransformsEncoder, encode_poses
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.offline.result import Spool

PACK = {".zst": zstandard.compress, ".zstd": zstandard.compress, ".lz4": lz4.frame.compress}


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.mark.parametrize("suffix", PACK)
@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_a_compressed_file_is_read_and_leaves_nothing(
    tmp_path: Path, temporary: Path, suffix: str, storage: str
) -> None:
    messages = some_messages(300)
    plain = stored(tmp_path, storage, messages)
    path = tmp_path / f"y.{storage}{suffix}"
    path.write_bytes(PACK[suffix](plain.read_bytes()))
    assert read(path) == (expected(messages), [])
    assert not list(temporary.iterdir())


@pytest.mark.parametrize("plugin", StoragePlugin)
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_bags_compressed_by_file_or_message(
    tmp_path: Path, temporary: Path, plugin: StoragePlugin, mode: CompressionMode
) -> None:
    messages = some_messages(300)
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer as bag:
        topics = {
            name: bag.add_connection("/" + name, kind, typestore=typestore()) for name, kind in TOPICS.items()
        }
        for topic, log_ns, data in messages:
            bag.write(topics[topic], log_ns, data)
    assert read(tmp_path / "bag") == (expected(messages), [])
    assert not list(temporary.iterdir())


def test_a_file_that_was_unpacked_by_hand_is_read_once(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", some_messages(30))
    file = tmp_path / "bag" / "bag.mcap"
    file.with_suffix(".mcap.zstd").write_bytes(zstandard.compress(file.read_bytes()))
    assert read(tmp_path / "bag") == (expected(some_messages(30)), [])


@pytest.mark.parametrize("suffix", [".zst", ".lz4"])
def test_a_compressed_file_that_is_cut_off_gives_what_was_there(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(1)
    messages = [("a/odom", START + k, rng.bytes(4000)) for k in range(500)]
    write_mcap(tmp_path / "x.mcap", messages, use_chunking=False)
    data = PACK[suffix]((tmp_path / "x.mcap").read_bytes())
    path = tmp_path / f"y.mcap{suffix}"
    path.write_bytes(data[: len(data) // 2])
    found, losses = read(path)
    assert found == expected(messages)[: len(found)]
    assert 150 < len(found) < 260
    assert any("y.mcap: it was cut off" in loss for loss in losses)


def test_a_compressed_file_of_something_else_is_refused_by_its_own_name(
    tmp_path: Path, temporary: Path
) -> None:
    path = tmp_path / "x.mcap.zst"
    for content in (b"", b"no zstd at all", zstandard.compress(b"hello world, this is no bag")):
        path.write_bytes(content)
        with pytest.raises(BagError, match=rf"{path} is (no MCAP file|empty)\."):
            BagReader(path)
    assert not list(temporary.iterdir())


def test_a_file_that_would_fill_the_disk_is_refused(
    tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=20_000_000))
    path = tmp_path / "x.mcap.zst"
    path.write_bytes(zstandard.compress(bytes(100_000_000)))
    with pytest.raises(BagError, match="unpacks to more than half of the free space"):
        BagReader(path)
    assert not list(temporary.iterdir())


def test_messages_that_cannot_be_unpacked_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "MAX_MESSAGE", 1000)
    good, plain = zstandard.compress(bytes(1000)), b"\0\1\0\0 as it is"
    contents = [plain, good, good[:4] + b"damage", zstandard.compress(bytes(1001)), b"", plain]
    batch = MessageBatch.of([SerializedMessage(k, data, k) for k, data in enumerate(contents)])
    losses = ReadErrors("x.db3")
    (unpacked,) = unpack_messages(iter([batch]), losses)
    assert [*unpacked.messages()] == [(0, 0, plain), (1, 1, bytes(1000)), (4, 4, b""), (5, 5, plain)]
    assert losses == ["x.db3: 2 messages whose compression is damaged were skipped."]


def test_batches_are_split_where_messages_unpack_to_much(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "_MAX_BATCH", 2500)
    message = zstandard.compress(bytes(1000))
    batch = MessageBatch.of([SerializedMessage(0, message, k) for k in range(8)])
    sizes = [part.size for part in unpack_messages(iter([batch]), ReadErrors("x"))]
    assert sizes == [3, 3, 2]


@pytest.mark.parametrize("make", [lambda path: path, lambda path: path / "old.bag"])
def test_a_bag_of_ros_1_is_named_with_the_tool_that_converts_it(tmp_path: Path, make: Any) -> None:
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(BagError, match=r"convert bags of ROS 1 first: rosbags-convert --src .*\.bag --dst "):
        BagReader(make(tmp_path))


def test_topics_of_another_encoding_are_named_and_the_others_read(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start("ros2", "test")
        for name, encoding in (("a/odom", "cdr"), ("b/odom", "json"), ("c/odom", "ros1"), ("d/odom", "ros1")):
            schema = writer.register_schema(TOPICS["a/odom"], "ros2msg", b"")
            channel = writer.register_channel("/" + name, encoding, schema)
            writer.add_message(channel, START, b"\0\1\0\0" + name.encode(), START)
        writer.finish()  # type: ignore[no-untyped-call]
    found, losses = read(path)
    assert found == [("a/odom", TOPICS["a/odom"], START, b"\0\1\0\0a/odom")]
    json, ros_1 = losses
    assert json.startswith("x.mcap: the messages on b/odom are serialized as json, not as cdr as in ROS 2;")
    assert "on c/odom, d/odom are serialized as ros1" in ros_1


FOREVER = {"sec": 9223372036, "nsec": 854775807}
NEW = {
    "history": "keep_last",
    "depth": 5,
    "reliability": "best_effort",
    "durability": "transient_local",
    "deadline": FOREVER,
    "lifespan": FOREVER,
    "liveliness": "automatic",
    "liveliness_lease_duration": FOREVER,
    "avoid_ros_namespace_conventions": False,
}
OLD = """
- {history: 1, depth: 5, reliability: 2, durability: 1, deadline: {sec: 0, nsec: 0},
   lifespan: {sec: 0, nsec: 0}, liveliness: 1, liveliness_lease_duration: {sec: 0, nsec: 0},
   avoid_ros_namespace_conventions: false}
"""


def _metadata(profiles: object) -> dict[str, Any]:
    topics = [("/a/odom", profiles), ("/b/odom", "")]
    return {
        "topics_with_message_count": [
            {"message_count": 1, "topic_metadata": {"name": name, "offered_qos_profiles": offered}}
            for name, offered in topics
        ]
    }


@pytest.mark.parametrize("profiles", [[NEW], OLD])
def test_profiles_of_all_versions(profiles: object) -> None:
    found = offered_qos(_metadata(profiles))
    (profile,) = found["a/odom"]
    assert (profile.reliability, profile.durability) == (
        QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL,
    )
    assert profile.depth == 5
    assert found["b/odom"] == []


def test_damaged_profiles_and_topics_are_none() -> None:
    for profiles in ("]", "reliable", [{"depth": 1}], [3], 7, [{**NEW, "deadline": None}]):
        assert offered_qos(_metadata(profiles)) == {"b/odom": []}
    wrong: list[Any] = [None, 7, [None], [{"topic_metadata": 3}], [{"topic_metadata": {}}]]
    for topics in wrong:
        assert offered_qos({"topics_with_message_count": topics}) == {}


def test_rows_come_back_by_key_in_their_order() -> None:
    rng = np.random.default_rng(1)
    spool = Spool()
    parts = {key: [rng.normal(size=(int(rng.integers(0, 3000)), 2, 3)) for _ in range(20)] for key in "ab"}
    for k in range(20):
        for key, rows in parts.items():
            spool.append(key, rows[k])
    arrays = {key: spool.array(key, np.float64, 2, 3) for key in parts}
    nothing = spool.array("c", np.int64)
    del spool
    for key, rows in parts.items():
        np.testing.assert_array_equal(arrays[key], np.concatenate(rows))
    assert nothing.shape == (0,)
    with pytest.raises(ValueError, match="read-only"):
        arrays["a"][0] = 0.0


def filled(spool: Spool, rows: int) -> None:
    spool.append("a", np.ones(rows))
    spool.array("a", float)


@pytest.mark.parametrize("rows", [20_001, 10])
def test_a_full_disk_is_said_with_its_folder_and_no_traceback(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, rows: int
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    unraised: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", unraised.append)
    spool = Spool()
    with full_after(8 * rows - 8):
        with pytest.raises(FileError, match=f"{tmp_path} cannot be written: File too large"):
            filled(spool, rows)
        del spool
        gc.collect()
    assert not unraised


STAMP_NS = 1_234_567_890_123_456_789
NAMES = ["a", "robot17", "x" * 40]
POSES = np.array([[1.0, 2.0, 0.3], [-4.0, 5.0, -3.0], [np.nan, np.nan, np.nan]])
COVARIANCES = np.arange(27.0).reshape(3, 3, 3)


def read_outputs(data: bytes, message_type: str) -> Any:
    """The message object; equal to the bytes again when serialized, so nothing is missing or too much."""
    message = typestore().deserialize_cdr(data, message_type)
    assert bytes(typestore().serialize_cdr(message, message_type)).rstrip(b"\x00") == data.rstrip(b"\x00")
    return message


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def yaw(quaternion: Any) -> float:
    assert quaternion.x == quaternion.y == 0.0
    return float(2.0 * np.arctan2(quaternion.z, quaternion.w))


def test_robot_poses_are_sure_of_the_plane_but_not_beyond_doubt() -> None:
    messages = encode_poses("map", np.full(2, STAMP_NS), POSES[:2], COVARIANCES[:2])
    for k, data in enumerate(messages):
        message = read_outputs(data, "geometry_msgs/msg/PoseWithCovarianceStamped")
        assert (stamp_ns(message), message.header.frame_id) == (STAMP_NS, "map")
        place = message.pose.pose.position
        assert (place.x, place.y, place.z) == (*POSES[k, :2], 0.0)
        assert yaw(message.pose.pose.orientation) == pytest.approx(POSES[k, 2])
        covariance = np.array(message.pose.covariance).reshape(6, 6)
        assert np.array_equal(covariance[np.ix_((0, 1, 5), (0, 1, 5))], COVARIANCES[k])
        assert (np.diagonal(covariance)[2:5] > 0.0).all()
        assert not covariance[2:5, [0, 1, 5]].any()


def test_transforms_of_those_that_are_chosen() -> None:
    encoder = TransformsEncoder("map", [f"{name}/odom" for name in NAMES])
    for chosen in ([True, False, False], [True, True, False], [False, True, False]):
        data = encoder.encode(STAMP_NS, np.array(chosen), POSES)
        transforms = read_outputs(data, "tf2_msgs/msg/TFMessage").transforms
        rows = np.flatnonzero(chosen)
        assert [t.child_frame_id for t in transforms] == [f"{NAMES[row]}/odom" for row in rows]
        for row, transform in zip(rows, transforms, strict=True):
            assert (stamp_ns(transform), transform.header.frame_id) == (STAMP_NS, "map")
            assert transform.transform.translation.x == POSES[row, 0]
            assert yaw(transform.transform.rotation) == pytest.approx(POSES[row, 2])


CHUNK_HEAD = 9 + 8 + 8 + 8 + 4 + 4 + 8  # Bytes of a chunk's record before its messages, without compression
UNTIMED = "messages whose log time cannot be were skipped"


def chunks_of(data: bytes) -> list[int]:
    found, offset = [], 8
    while offset < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, offset)
        if opcode == Opcode.CHUNK:
            found.append(offset)
        offset += 9 + length
    return found


@pytest.mark.parametrize("checksums", [True, False])
def test_a_flipped_bit_in_the_head_of_a_chunk_is_told(tmp_path: Path, checksums: bool) -> None:
    messages, path = some_messages(60), tmp_path / "x.mcap"
    write_mcap(path, messages, compression=CompressionType.NONE, enable_crcs=checksums)
    data = path.read_bytes()
    chunk = chunks_of(data)[2]
    for bit in range(8 * CHUNK_HEAD):
        damaged = bytearray(data)
        damaged[chunk + bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        found, losses = read(path)
        assert losses or found == expected(messages), bit
        assert found == sorted(found, key=lambda message: message[2])


def test_a_bit_flipped_in_our_own_bags_is_told(tmp_path: Path) -> None:
    messages = some_messages(60)
    write_bag(tmp_path / "bag", messages)
    path = tmp_path / "bag" / "bag.mcap"
    data = bytearray(path.read_bytes())
    data[data.index(messages[30][2])] ^= 1
    path.write_bytes(data)
    found, losses = read(path)
    assert found == []
    assert "its checksum is wrong" in losses[0]


def test_fewer_messages_than_the_statistics_tell_are_told(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    write_mcap(path, some_messages(60), compression=CompressionType.NONE, use_chunking=False)
    data = bytearray(path.read_bytes())
    data[data.index(some_messages(60)[20][2]) - 22 - 9] = 0xFF  # a message becomes an application's record
    path.write_bytes(data)
    found, losses = read(path)
    assert len(found) == 59
    assert losses == ["x.mcap: it holds 59 messages, but its statistics count 60."]


def test_a_message_shorter_than_its_head_ends_a_file(tmp_path: Path) -> None:
    messages, path = some_messages(10), tmp_path / "x.mcap"
    write_mcap(path, messages, compression=CompressionType.NONE, use_chunking=False)
    data = path.read_bytes()
    place = data.index(messages[-1][2]) + len(messages[-1][2])
    path.write_bytes(data[:place] + record_of(Opcode.MESSAGE, b"1234"))
    found, losses = read(path)
    assert found == expected(messages)
    (loss,) = losses
    assert f"was cut off at byte {place} of {place + 13}: the 10 messages before that were kept" in loss


ABSURD_NS = [2**63 - 1, 2**63, 2**64 - 1, MAX_LOG_NS + 1]


@pytest.mark.parametrize("log_ns", ABSURD_NS)
@pytest.mark.parametrize("chunking", [True, False])
def test_mcap_messages_whose_log_time_cannot_be_are_told(tmp_path: Path, log_ns: int, chunking: bool) -> None:
    messages, path = some_messages(60), tmp_path / "x.mcap"
    write_mcap(path, [*messages, ("a/odom", log_ns, b"late")], use_chunking=chunking)
    check_untimed(path, messages)


@pytest.mark.parametrize("log_ns", [2**63 - 1, -(2**63), -1, MAX_LOG_NS + 1])
def test_sqlite_messages_whose_log_time_cannot_be_are_told(tmp_path: Path, log_ns: int) -> None:
    messages = some_messages(60)
    path = write_sqlite(tmp_path / "bag", messages)
    execute(path, "INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", (log_ns, b"late"))
    check_untimed(path, messages)


def check_untimed(path: Path, messages: list[tuple[str, int, bytes]]) -> None:
    with BagReader(path) as bag:
        assert list(bag.messages()) == expected(messages)
        assert len(bag.losses) == 1
        assert f"1 {UNTIMED}" in bag.losses[0]
        assert bag.message_count == len(messages)
        assert START - 2 * 10**9 <= bag.time_range_ns[0] < bag.time_range_ns[1] < START + 10**9


def execute(path: Path, statement: str, values: tuple[Any, ...] = ()) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute(statement, values)
    connection.close()


@pytest.mark.parametrize("text", ["'text'", "CAST(x'ff00fe' AS TEXT)", "17"])
def test_sqlite_messages_that_are_no_bytes_are_told(tmp_path: Path, text: str) -> None:
    messages = some_messages(20)
    path = write_sqlite(tmp_path / "bag", messages)
    execute(path, f"INSERT INTO messages(topic_id, timestamp, data) VALUES (1, 5, {text})")  # noqa: S608
    found, losses = read(path)
    assert found == expected(messages)
    assert losses == ["bag.db3: 1 messages without a known topic or data were skipped."]


def test_messages_that_a_query_would_compute_for_ever_are_refused(tmp_path: Path) -> None:
    path = write_sqlite(tmp_path / "bag", some_messages(5))
    execute(path, "DROP TABLE messages")
    execute(
        path,
        "CREATE VIEW Messages AS WITH RECURSIVE more(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM more)"
        " SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM more",
    )
    with pytest.raises(BagError, match="its Messages are computed, not stored"):
        BagReader(path)


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_what_is_no_file_is_refused(tmp_path: Path, suffix: str) -> None:
    (tmp_path / "bag").mkdir()
    os.mkfifo(tmp_path / "bag" / f"a{suffix}")
    with pytest.raises(BagError, match=r"is no file|no such file"):
        BagReader(tmp_path / "bag")
    with pytest.raises(BagError, match="is no bag: expected"):
        BagReader(tmp_path / "bag" / f"a{suffix}")
    (tmp_path / "folder" / f"a{suffix}").mkdir(parents=True)
    with pytest.raises(BagError, match=r"is no file|no such file"):
        BagReader(tmp_path / "folder")


@pytest.mark.parametrize(
    ("told", "sentence"), [(1000, "holds more than its 1000 bytes"), (2**40, "is damaged (it should unpack")]
)
def test_a_chunk_that_unpacks_to_more_than_it_says_costs_no_memory(
    tmp_path: Path, told: int, sentence: str
) -> None:
    path = tmp_path / "x.mcap"
    packed = zstandard.compress(bytes(100_000_000))
    head = struct.pack("<QQQII", START, START, told, 0, 4) + b"zstd" + struct.pack("<Q", len(packed))
    path.write_bytes(b"\x89MCAP0\r\n" + record_of(Opcode.CHUNK, head + packed))
    tracemalloc.start()
    found, losses = read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10_000_000
    assert found == []
    assert any(sentence in loss for loss in losses)


def test_unreadable_metadata_are_told(tmp_path: Path) -> None:
    messages = some_messages(10)
    write_bag(tmp_path / "bag", messages)
    (tmp_path / "bag" / "metadata.yaml").write_text("{", encoding="utf-8")
    found, losses = read(tmp_path / "bag")
    assert found == expected(messages)
    assert "metadata.yaml is not YAML" in losses[0]
