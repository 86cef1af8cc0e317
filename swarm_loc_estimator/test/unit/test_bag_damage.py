"""Bags that a disk, a crash or somebody with bad intentions has changed: nothing is lost without a word."""

import os
import sqlite3
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType
from test_bags import START, expected, read, record_of, some_messages, write_bag, write_mcap, write_sqlite

from swarm_loc_estimator.common.bags.bag_file import MAX_LOG_NS
from swarm_loc_estimator.common.bags.reader import BagError, BagReader

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
