"""Bags: every storage and compression in order of log time, whole, cut off anywhere, or damaged."""

import tracemalloc
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from swarm_loc_estimator.common.bags.reader import BagError, BagReader, BagTopic, RawMessage
from swarm_loc_estimator.common.bags.writer import RELIABLE, BagWriter, typestore
from swarm_loc_estimator.common.messages.cdr import DETECTIONS, ODOMETRY
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage, merge_streams

TOPICS = {"a/odom": ODOMETRY, "b/detections": DETECTIONS}
START = 1_700_000_000_000_000_000


def some_messages(count: int, seed: int = 1) -> list[tuple[str, int, bytes]]:
    """Messages in recording order, up to 2 s late in log time, so that chunks overlap."""
    rng = np.random.default_rng(seed)
    names = list(TOPICS)
    return [
        (
            names[int(rng.integers(2))],
            START + k * 10_000_000 - int(rng.integers(2_000)) * 1_000_000,
            rng.bytes(int(rng.integers(4, 90))),
        )
        for k in range(count)
    ]


def expected(messages: list[tuple[str, int, bytes]]) -> list[RawMessage]:
    """As they must be read: in order of log time, equal ones as recorded."""
    return sorted(
        ((topic, TOPICS[topic], log_ns, data) for topic, log_ns, data in messages), key=lambda m: m[2]
    )


def write_bag(path: Path, messages: list[tuple[str, int, bytes]]) -> None:
    with BagWriter(path) as bag:
        for name, kind in TOPICS.items():
            bag.add_topic(name, kind)
        for message in messages:
            bag.write(*message)


def write_mcap(path: Path, messages: list[tuple[str, int, bytes]], **options: Any) -> None:
    """A bare file as other recorders write it, in chunks of about ten messages."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=500, **options)
        writer.start("ros2", "test")
        channels = {
            name: writer.register_channel("/" + name, "cdr", writer.register_schema(kind, "ros2msg", b""))
            for name, kind in TOPICS.items()
        }
        for topic, log_ns, data in messages:
            writer.add_message(channels[topic], log_ns, data, log_ns)
        writer.finish()  # type: ignore[no-untyped-call]


def write_sqlite(path: Path, messages: list[tuple[str, int, bytes]]) -> Path:
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        topics = {
            name: bag.add_connection("/" + name, kind, typestore=typestore()) for name, kind in TOPICS.items()
        }
        for topic, log_ns, data in messages:
            bag.write(topics[topic], log_ns, data)
    return path / f"{path.name}.db3"


def stored(folder: Path, storage: str, messages: list[tuple[str, int, bytes]]) -> Path:
    """A file of either storage."""
    if storage == "db3":
        return write_sqlite(folder / "bag", messages)
    write_mcap(folder / "x.mcap", messages)
    return folder / "x.mcap"


def read(path: Path) -> tuple[list[RawMessage], list[str]]:
    with BagReader(path) as bag:
        return list(bag.messages()), bag.losses


def test_written_bag_is_read_back_and_by_the_library_too(tmp_path: Path) -> None:
    messages = some_messages(300)
    write_bag(tmp_path / "bag", messages)
    with BagReader(tmp_path / "bag") as bag:
        assert bag.topics == [BagTopic(*item) for item in TOPICS.items()]
        assert bag.message_count == 300
        assert list(bag.messages()) == expected(messages)
        assert bag.time_range_ns == (expected(messages)[0][2], expected(messages)[-1][2])
        assert bag.losses == []
        assert bag.offered_qos == {name: [RELIABLE] for name in TOPICS}
    with Reader(tmp_path / "bag") as library:
        theirs = [(c.topic, c.msgtype, log_ns, data) for c, log_ns, data in library.messages()]
        assert theirs == [("/" + m[0], *m[1:]) for m in expected(messages)]
        (odometry, detections) = library.connections
        assert "child_frame_id" in odometry.msgdef.data
        assert "corners_px" in detections.msgdef.data
        assert odometry.digest.startswith("RIHS01_")
        with (tmp_path / "bag" / "bag.mcap").open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        assert [one.metadata["topic_type_hash"] for one in summary.channels.values()] == [
            odometry.digest,
            detections.digest,
        ]
        assert odometry.ext.offered_qos_profiles[0].reliability.name == "RELIABLE"  # type: ignore[union-attr]


def test_equal_input_gives_equal_bytes(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        write_bag(tmp_path / folder / "bag", some_messages(100))
    for name in ("bag.mcap", "metadata.yaml"):
        assert (tmp_path / "one/bag" / name).read_bytes() == (tmp_path / "two/bag" / name).read_bytes()


def test_failed_writing_leaves_nothing_and_existing_bags_stay(tmp_path: Path) -> None:
    with pytest.raises(KeyError), BagWriter(tmp_path / "bag") as bag:
        bag.write("unknown", 1, b"")
    assert not (tmp_path / "bag").exists()
    write_bag(tmp_path / "bag", some_messages(3))
    with pytest.raises(BagError, match="exists already"):
        BagWriter(tmp_path / "bag")
    assert len(read(tmp_path / "bag")[0]) == 3


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunking", [True, False])
def test_other_recorders_files(tmp_path: Path, compression: CompressionType, chunking: bool) -> None:
    messages = some_messages(500)
    write_mcap(tmp_path / "x.mcap", messages, compression=compression, use_chunking=chunking)
    assert read(tmp_path / "x.mcap") == (expected(messages), [])


def test_files_without_any_summary(tmp_path: Path) -> None:
    messages = some_messages(200)
    write_mcap(
        tmp_path / "x.mcap", messages, use_statistics=False, repeat_channels=False, repeat_schemas=False
    )
    with BagReader(tmp_path / "x.mcap") as bag:
        assert (bag.message_count, len(bag.topics)) == (200, 2)
        assert list(bag.messages()) == expected(messages)


def test_sqlite(tmp_path: Path) -> None:
    messages = some_messages(500)
    file = write_sqlite(tmp_path / "bag", messages)
    assert read(tmp_path / "bag") == (expected(messages), [])
    assert read(file) == (expected(messages), [])


@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_topics_are_chosen_and_progress_grows_to_one(tmp_path: Path, storage: str) -> None:
    messages = some_messages(2000)
    with BagReader(stored(tmp_path, storage, messages)) as bag:
        chosen, progress = [], []
        for message in bag.messages(["/a/odom"]):
            chosen.append(message)
            progress.append(bag.progress)
        assert chosen == [message for message in expected(messages) if message[0] == "a/odom"]
        assert progress == sorted(progress)
        assert progress[0] < 0.5
        assert bag.progress == 1.0


@pytest.mark.parametrize("compression", list(CompressionType))
def test_mcap_cut_off_anywhere_gives_what_was_there(tmp_path: Path, compression: CompressionType) -> None:
    messages = [(topic, START + k, data) for k, (topic, _, data) in enumerate(some_messages(60))]
    whole = tmp_path / "whole.mcap"
    write_mcap(whole, messages, compression=compression)
    data = whole.read_bytes()
    path, counts = tmp_path / "cut.mcap", []
    for length in range(1, len(data), 7):
        path.write_bytes(data[:length])
        try:
            found, losses = read(path)
        except BagError as error:
            assert length < 8, error  # noqa: PT017  # the only excuse: not even the magic is there
            continue
        assert found == expected(messages)[: len(found)]
        if losses:
            assert (
                f"cut off at byte {min(length, len(data))} of" in losses[0] or f" of {length}: " in losses[0]
            )
        else:
            assert length >= len(data) - 8
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[-1] == 60
    assert 5 < counts[len(counts) // 3] < 60


def record_of(opcode: int, content: bytes) -> bytes:
    return bytes([opcode]) + len(content).to_bytes(8, "little") + content


def test_records_of_an_application_inside_a_chunk_are_skipped(tmp_path: Path) -> None:
    messages, path, own = some_messages(8), tmp_path / "x.mcap", record_of(0xFF, b"")
    write_mcap(path, messages, compression=CompressionType.NONE, enable_crcs=False)
    data = path.read_bytes()
    chunk = data.index(bytes([Opcode.CHUNK]), 8)
    while int.from_bytes(data[chunk + 1 : chunk + 9], "little") > len(data):
        chunk = data.index(bytes([Opcode.CHUNK]), chunk + 1)
    place = data.index(messages[3][2]) + len(messages[3][2])
    grown = bytearray(data[:place] + own + data[place:])
    for field in (1, 25, 41):  # lengths of the record, of what is packed, and of the packed
        number = int.from_bytes(grown[chunk + field : chunk + field + 8], "little") + len(own)
        grown[chunk + field : chunk + field + 8] = number.to_bytes(8, "little")
    path.write_bytes(grown)
    assert read(path) == (expected(messages), [])


def test_damaged_chunk_is_lost_alone_and_named(tmp_path: Path) -> None:
    messages = some_messages(200)
    write_mcap(tmp_path / "x.mcap", messages, compression=CompressionType.NONE)
    data = bytearray((tmp_path / "x.mcap").read_bytes())
    place = data.index(messages[100][2])
    data[place] ^= 0xFF
    (tmp_path / "x.mcap").write_bytes(data)
    found, losses = read(tmp_path / "x.mcap")
    assert set(found) < set(expected(messages))
    assert 180 < len(found) < 200
    assert len(losses) == 1
    assert "its checksum is wrong" in losses[0]


@pytest.mark.parametrize("storage", ["mcap", "db3"])
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(
    places=st.lists(
        st.tuples(st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=40)),
        min_size=1,
        max_size=5,
    )
)
def test_damage_anywhere_never_raises_anything_else(
    tmp_path: Path, storage: str, places: list[tuple[float, bytes]]
) -> None:
    path = tmp_path / f"whole.{storage}"
    if not path.exists():
        stored(tmp_path, storage, some_messages(100)).rename(path)
    data = bytearray(path.read_bytes())
    for place, replacement in places:
        begin = int(place * len(data))
        data[begin : begin + len(replacement)] = replacement
    damaged = tmp_path / f"damaged.{storage}"
    damaged.write_bytes(data)
    with suppress(BagError):
        messages, losses = read(damaged)
        assert all(isinstance(message[3], bytes) for message in messages)
        assert all(loss.endswith(".") for loss in losses)


@pytest.mark.parametrize("share", [0.4, 0.7, 0.95])
def test_sqlite_cut_off_gives_what_was_there(tmp_path: Path, share: float) -> None:
    messages = some_messages(4000)
    file = write_sqlite(tmp_path / "bag", messages)
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * share)])
    found, losses = read(tmp_path / "bag")
    assert set(found) <= set(expected(messages))
    assert found == sorted(found, key=lambda message: message[2])
    assert len(found) > 2000 * share
    assert len(losses) == 1
    assert f"{len(found)} messages were kept, the rest is lost" in losses[0]


def test_sqlite_hole_costs_only_what_was_in_it(tmp_path: Path) -> None:
    messages = some_messages(4000)
    file = write_sqlite(tmp_path / "bag", messages)
    data = bytearray(file.read_bytes())
    place = data.index(messages[2000][2]) & ~4095
    data[place : place + 4096] = np.random.default_rng(3).bytes(4096)
    file.write_bytes(data)
    found, losses = read(file)
    assert len(set(found) & set(expected(messages))) > 3800
    assert "is damaged" in losses[0]


def test_folder_of_a_crashed_recording(tmp_path: Path) -> None:
    messages = some_messages(100)
    write_bag(tmp_path / "bag", messages)
    (tmp_path / "bag/metadata.yaml").unlink()
    found, losses = read(tmp_path / "bag")
    assert found == expected(messages)
    assert "its recording was not finished" in losses[0]


def test_split_bags_are_merged_and_missing_parts_named(tmp_path: Path) -> None:
    messages = some_messages(400)
    folder = tmp_path / "bag"
    folder.mkdir()
    write_mcap(folder / "bag_0.mcap", messages[:200])
    write_mcap(folder / "bag_1.mcap", messages[200:])
    (folder / "bag_2.mcap").touch()
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n"
        "  relative_file_paths: [bag_0.mcap, bag_1.mcap, bag_2.mcap, bag_3.mcap]\n"
    )
    found, losses = read(folder)
    assert found == expected(messages)
    assert losses == [
        "bag_3.mcap: the file is missing, its messages are lost.",
        f"{folder}/bag_2.mcap is empty.",
    ]


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda _: None, "There is no bag"),
        (lambda path: path.mkdir(), "holds no .mcap or .db3 file"),
        (lambda path: path.write_text("hello"), "is no bag: expected"),
    ],
)
def test_what_is_no_bag_is_said(tmp_path: Path, make: Any, sentence: str) -> None:
    make(tmp_path / "bag")
    with pytest.raises(BagError, match=sentence):
        BagReader(tmp_path / "bag")


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
@pytest.mark.parametrize("content", [b"", b"hello world, this is no bag at all"])
def test_files_of_something_else_are_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    (tmp_path / f"x{suffix}").write_bytes(content)
    with pytest.raises(BagError, match=r"is empty|is no"):
        BagReader(tmp_path / f"x{suffix}")


def test_a_database_without_a_needed_column_has_no_messages_and_that_is_said(tmp_path: Path) -> None:
    path = write_sqlite(tmp_path / "bag", some_messages(10))
    path.write_bytes(path.read_bytes().replace(b"topic_id", b"topic_no"))
    messages, losses = read(path)
    assert messages == []
    assert any("no such column: topic_id): 0 messages were kept" in loss for loss in losses)


def peak_of_reading(path: Path) -> int:
    """Memory that reading takes [bytes], the least of three times: threads of other tests allocate, too."""
    return min(one_peak_of_reading(path) for _ in range(3))


def one_peak_of_reading(path: Path) -> int:
    with BagReader(path) as bag:
        tracemalloc.start()
        for _ in bag.messages():
            pass
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak


@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_memory_does_not_grow_with_the_bag(tmp_path: Path, storage: str) -> None:
    peaks = []
    for count in (3000, 12000):  # all of the second together take three times what is allowed
        (tmp_path / str(count)).mkdir()
        peaks.append(peak_of_reading(stored(tmp_path / str(count), storage, some_messages(count))))
    assert peaks[1] < 1.1 * peaks[0] + 50_000


@given(st.lists(st.lists(st.lists(st.integers(0, 30), max_size=5), max_size=4), max_size=4))
def test_streams_of_batches_merge_in_order_of_time_and_of_streams(streams: list[list[list[int]]]) -> None:
    rows = []
    batches: list[list[MessageBatch]] = []
    for number, stream in enumerate(streams):
        times = iter(sorted(t for part in stream for t in part))
        batches.append([])
        for part in stream:
            messages = [(number, bytes([number, t]), t) for t, _ in zip(times, part, strict=False)]
            batches[-1].append(MessageBatch.of([SerializedMessage(*one) for one in messages]))
            rows += messages
    merged = [row for batch in merge_streams([iter(s) for s in batches]) for row in batch.messages()]
    assert merged == [(n, t, data) for n, data, t in sorted(rows, key=lambda row: row[2])]
