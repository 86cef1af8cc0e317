"""Reading bags: messages a second and CPU time per message, beside the libraries `mcap` and `rosbags`.

Two recordings, each as MCAP and as sqlite3: odometry of the MRCLAM dataset where its folder is named (else of
the demo's bag, again and again) and the demo's detections. Messages are read in order of log time, alone or
decoded to arrays of numbers: stamps and poses, or ids, positions and covariances. The libraries' messages are
bytes, which rosbags' type store turns into objects. All readers of a recording are measured in one run.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from bench.mrclam.sets import import_set
from bench.shared.bags import copy_part
from bench.shared.common import DEMO_BAG, OUT, flat, new_plot, save_plot, table, write_figures
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.cdr import DETECTIONS, ODOMETRY, nanoseconds
from swarm_loc_estimator.common.messages.poses import decode_odometry, yaw_of
from swarm_loc_estimator.common.messages.streams import DetectionReader, PoseReader

MRCLAM_S = 300.0  # How much of a set is read [s]; costs per message do not change with the length
REPEATS = 3

Messages = Iterator[tuple[str, bytes]]  # Type and bytes of one after the other


class Figures(NamedTuple):
    """What one reader did with a recording: messages, CPU time [s], and all numbers that it found (n, k)."""

    messages: int
    read_s: float
    decode_s: float
    numbers: FloatArray


class Recording(NamedTuple):
    """A bag folder of which the messages of one type are read."""

    folder: Path
    kind: str


def ours(recording: Recording) -> Figures:
    """This workspace's reader."""
    with BagReader(recording.folder) as bag:
        topics = [topic.name for topic in bag.topics if topic.type == recording.kind]
        count, read_s = _timed(lambda: sum(batch.size for batch in bag.batches(topics)))

        def decoded() -> FloatArray:
            if recording.kind == ODOMETRY:
                poses = PoseReader(len(topics), decode_odometry, names=2)
                read = [poses.read(batch) for batch in bag.batches(topics)]
                return np.concatenate([np.column_stack([one.stamp_ns, one.pose]) for one in read])
            detections = DetectionReader(len(topics))
            found = np.concatenate([detections.read(batch).detection for batch in bag.batches(topics)])
            return np.column_stack([found["id"], found["position"], found["covariance"].reshape(-1, 36)])

        numbers, decode_s = _timed(decoded)
    return Figures(count, read_s, decode_s, numbers)


def with_mcap(recording: Recording) -> Figures:
    """The reader of `mcap`."""

    def messages() -> Messages:
        with next(recording.folder.glob("*.mcap")).open("rb") as file:
            reader = make_reader(file)
            channels = reader.get_summary().channels.values()  # type: ignore[union-attr]  # bags here are whole
            schemas = reader.get_summary().schemas  # type: ignore[union-attr]
            topics = [one.topic for one in channels if schemas[one.schema_id].name == recording.kind]
            for schema, _, message in reader.iter_messages(topics):
                yield schema.name if schema else "", message.data

    return _library(recording.kind, messages)


def with_rosbags(recording: Recording) -> Figures:
    """The reader of `rosbags`."""

    def messages() -> Messages:
        with Reader(recording.folder) as reader:
            chosen = [one for one in reader.connections if one.msgtype == recording.kind]
            for connection, _, data in reader.messages(chosen):
                yield connection.msgtype, data

    return _library(recording.kind, messages)


def _library(kind: str, messages: Callable[[], Messages]) -> Figures:
    """A library's messages, and their numbers by way of message objects."""
    store, numbers = typestore(), _odometry_numbers if kind == ODOMETRY else _detection_numbers
    count, read_s = _timed(lambda: sum(1 for _ in messages()))
    found, decode_s = _timed(
        lambda: np.array(
            [row for name, data in messages() for row in numbers(store.deserialize_cdr(data, name))]
        )
    )
    return Figures(count, read_s, decode_s, found)


def _odometry_numbers(message: Any) -> Iterator[tuple[float, ...]]:
    stamp, pose = message.header.stamp, message.pose.pose
    turned = pose.orientation
    yaw = yaw_of(turned.x, turned.y, turned.z, turned.w)
    yield float(nanoseconds(stamp)), pose.position.x, pose.position.y, yaw


def _detection_numbers(message: Any) -> Iterator[tuple[float, ...]]:
    for one in message.detections:
        place = one.pose.pose.position
        yield float(one.id), place.x, place.y, place.z, *one.pose.covariance


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """The result and the least CPU time [s] of some repetitions."""
    best = float("inf")
    for _ in range(REPEATS):
        began = time.process_time()
        result = work()
        best = min(best, time.process_time() - began)
    return result, best


READERS: dict[str, dict[str, Callable[[Recording], Figures]]] = {
    "mcap": {"this": ours, "mcap": with_mcap, "rosbags": with_rosbags},
    "sqlite3": {"this": ours, "rosbags": with_rosbags},
}
"""By storage."""


def write_copy(source: Path, folder: Path, kind: str, storage: str, times: int) -> Recording:
    """The messages of one type, again and again, as a bag of a storage."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with BagReader(source) as bag, Writer(folder, version=9, storage_plugin=plugin) as writer:
        names = [topic.name for topic in bag.topics if topic.type == kind]
        connections = {name: writer.add_connection("/" + name, kind, typestore=typestore()) for name in names}
        first_ns, last_ns = bag.time_range_ns
        for k in range(times):
            for name, _, log_ns, data in bag.messages(names):
                writer.write(connections[name], log_ns + k * (last_ns - first_ns + 1), data)
    return Recording(folder, kind)


def measure(source: Path, kind: str, times: int) -> dict[str, dict[str, Figures]]:
    """Storage -> reader -> figures of a recording; all readers must find the same numbers.

    Raises:
        RuntimeError: They do not.
    """
    results: dict[str, dict[str, Figures]] = {}
    with tempfile.TemporaryDirectory() as work:
        for storage, readers in READERS.items():
            recording = write_copy(source, Path(work, storage), kind, storage, times)
            found = {name: read(recording) for name, read in readers.items()}
            for name, figures in found.items():
                if not _alike(figures, found["this"]):
                    raise RuntimeError(f"{name} reads something else from {source} as {storage}.")
            results[storage] = found
    return results


def _alike(one: Figures, other: Figures) -> bool:
    """Whether two readers found the same, those of equal log time in any order."""
    if one.messages != other.messages or one.numbers.shape != other.numbers.shape:
        return False
    return np.allclose(np.sort(one.numbers, axis=0), np.sort(other.numbers, axis=0), equal_nan=True)


def report(results: dict[str, dict[str, dict[str, Figures]]], folder: Path = OUT) -> None:
    """Print the table, draw the plot and write the figures, by recording, storage and reader."""
    rows: list[list[str | float | int]] = []
    figures: dict[str, dict[str, float]] = {}
    for recording, storages in results.items():
        for storage, readers in storages.items():
            for name, one in readers.items():
                read_us, decode_us = (1e6 * s / one.messages for s in (one.read_s, one.decode_s))
                share = readers["this"].decode_s / one.decode_s
                rows.append([f"{recording}.{storage}.{name}", one.messages, read_us, decode_us, share])
                figures[f"{recording}.{storage}.{name}"] = {
                    "read_us": read_us,
                    "decode_us": decode_us,
                    "this_to_it": share,
                }
    print(table(["reader", "messages", "read us", "decoded us", "this / it"], rows))
    figure, (axis,) = new_plot(1, width=7.0)
    for shift, key in ((-0.2, "read_us"), (0.2, "decode_us")):
        axis.barh(np.arange(len(figures)) + shift, [one[key] for one in figures.values()], 0.4, label=key)
    axis.set_yticks(range(len(figures)), [*figures])
    axis.set(xscale="log", xlabel="CPU time per message [us]")
    axis.legend()
    print(f"plot: {save_plot(figure, 'reading', folder)}")
    print(f"figures: {write_figures('reading', flat(figures), folder / 'bench')}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="a set of MRCLAM, such as MRCLAM_Dataset1")
    parser.add_argument("--times", type=int, default=20, help="how often the demo's messages are repeated")
    options = parser.parse_args(arguments)
    results = {}
    with tempfile.TemporaryDirectory() as work:
        source, times = DEMO_BAG, options.times
        if options.folder:
            whole, source, times = Path(work, "whole"), Path(work, "first"), 1
            import_set(options.folder, whole)
            copy_part(whole, source, MRCLAM_S)
        results["odometry"] = measure(source, ODOMETRY, times)
    results["detections"] = measure(DEMO_BAG, DETECTIONS, options.times)
    report(results)


if __name__ == "__main__":
    main()
