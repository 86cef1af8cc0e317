"""Reading bags: rosbag2 folders and bare files, MCAP and sqlite3, plain or compressed, whole or cut off."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from rosbags.interfaces import Qos
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos
from typing_extensions import Self

from swarm_loc_estimator.common.bags.bag_file import (
    BagError,
    BagTopic,
    McapFile,
    RawMessage,
    ReadErrors,
    SqliteFile,
)
from swarm_loc_estimator.common.files import temporary_folder
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage, merge_streams
from swarm_loc_estimator.common.yaml_tree import YamlTreeError, read_tree

PACKED = (".zstd", ".zst", ".lz4")  # Suffixes of compressed files, as in bag_0.db3.zstd
MAX_MESSAGE = 1 << 28  # Unpacked messages are at most so large [byte]

_STEP = 1 << 20
_MAX_BATCH = 1 << 26
_ZSTD = b"\x28\xb5\x2f\xfd"  # no message of ROS 2 begins so: its first byte is 0
_ERRORS = (zstandard.ZstdError, EOFError, RuntimeError)


def unpack_file(path: Path, folder: Path, losses: list[str]) -> Path:
    """Unpack a file with a suffix of `PACKED` into a folder; of a damaged one, the part before the damage.

    A sentence about damage is added to `losses`. Raises BagError if it is no file, or needs more than half of
    the free disk space.
    """
    if not path.is_file():
        raise BagError(f"{path} is no file.")  # opening a pipe would never return
    unpacked, free = folder / path.stem, shutil.disk_usage(folder).free // 2
    with path.open("rb") as packed, unpacked.open("wb") as file:
        try:
            if path.suffix == ".lz4":
                source = lz4.frame.LZ4FrameFile(packed)
            else:
                source = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            while part := source.read1(_STEP):  # read would lose what stands before an early end
                free -= len(part)
                if free < 0:
                    raise BagError(f"{path} unpacks to more than half of the free space in {folder.parent}.")
                file.write(part)
        except _ERRORS as error:
            losses.append(f"{path.name}: its compression is damaged ({error}); the part before was read.")
    return unpacked


def unpack_messages(batches: Iterator[MessageBatch], losses: ReadErrors) -> Iterator[MessageBatch]:
    """Unpack the messages that are compressed one by one; what cannot be unpacked is counted and left out."""
    damaged = 0
    for batch in batches:
        packed = batch.length >= len(_ZSTD)  # whether each message begins like a zstd frame
        for k, byte in enumerate(_ZSTD):
            packed[packed] = batch.data[batch.offset[packed] + k] == byte
        if not packed.any():
            yield batch
            continue
        messages, size = [], 0
        for is_packed, (topic, log_ns, data) in zip(packed.tolist(), batch.messages(), strict=True):
            content = data
            if is_packed:
                with (
                    suppress(zstandard.ZstdError),
                    zstandard.ZstdDecompressor().stream_reader(data) as reader,
                ):
                    content = reader.read(MAX_MESSAGE + 1)
                if content is data or len(content) > MAX_MESSAGE:
                    damaged += 1
                    continue
            messages.append(SerializedMessage(topic, content, log_ns))
            size += len(content)
            if size > _MAX_BATCH:
                yield MessageBatch.of(messages)
                messages, size = [], 0
        yield MessageBatch.of(messages)
    if damaged:
        losses.add(f"{damaged} messages whose compression is damaged were skipped.")


__all__ = ["BagError", "BagReader", "BagTopic", "RawMessage"]

BagFile = McapFile | SqliteFile
_STORAGES: dict[str, type[BagFile]] = {".mcap": McapFile, ".db3": SqliteFile}
_METADATA_BYTES = 20_000_000  # Larger metadata are not read; a thousand robots' topics take a tenth of it
_ENCODINGS = ("cdr", "")
_EXPECTED = "expected a rosbag2 folder, or an .mcap or .db3 file, plain or compressed as .zstd, .zst or .lz4"
_ROS_1 = "convert bags of ROS 1 first: rosbags-convert --src NAME.bag --dst NAME"


class BagReader:
    """An open bag, as a context manager: a rosbag2 folder, or an .mcap or .db3 file, plain or compressed.

    Topic names come without the leading slash, as `robot1/odom`. `renamed` has by topic of the bag the name
    that it has here; a topic of that name in the bag is hidden. Raises BagError if there is nothing to read.
    """

    def __init__(self, path: Path, renamed: Mapping[str, str] = MappingProxyType({})) -> None:
        self._path = path
        self._renamed = renamed
        # Topic -> what its publishers offered, as far as a folder's metadata know it
        self.offered_qos: dict[str, list[Qos]] = {}
        self._files: list[BagFile] = []
        self._own_losses = ReadErrors(path.name)
        self._unpacked = ExitStack()
        try:
            self._open()
            self._check_topics()
        except BaseException:
            self.close()
            raise

    @property
    def topics(self) -> list[BagTopic]:
        """The readable topics of all files, by their names here."""
        return list(dict.fromkeys(here for topic in self._stored() if (here := self._here(topic))))

    @property
    def message_count(self) -> int:
        """Number of messages, as far as they can be counted before reading."""
        return sum(file.message_count for file in self._files)

    @property
    def time_range_ns(self) -> tuple[int, int]:
        """First and last log time; (0, 0) without messages."""
        ranges = [file.time_range_ns for file in self._files if file.message_count]
        return (min(first for first, _ in ranges), max(last for _, last in ranges)) if ranges else (0, 0)

    @property
    def losses(self) -> list[str]:
        """One sentence for each thing that could not be read; more may come while reading."""
        return self._own_losses + [loss for file in self._files for loss in file.losses]

    @property
    def progress(self) -> float:
        """Share of the bag that was read, 0 to 1."""
        return sum(file.progress for file in self._files) / len(self._files)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages, of all or of some topics, by log time: topic, type, log time [ns], serialized message."""
        wanted = None if topics is None else {name.lstrip("/") for name in topics}
        read = [topic for topic in self.topics if wanted is None or topic.name in wanted]
        for batch in self._batches({topic: number for number, topic in enumerate(read)}):
            for number, log_ns, data in batch.messages():
                yield read[number].name, read[number].type, log_ns, data

    def batches(self, topics: Sequence[str]) -> Iterator[MessageBatch]:
        """Messages in order of log time, many at once; topics are numbered by their place in `topics`."""
        number_of = {name.lstrip("/"): number for number, name in enumerate(topics)}
        return self._batches({t: number_of[t.name] for t in self.topics if t.name in number_of})

    def _batches(self, number_of: Mapping[BagTopic, int]) -> Iterator[MessageBatch]:
        names = {topic: here for topic in self._stored() if (here := self._here(topic))}
        stored = {topic: number_of[here] for topic, here in names.items() if here in number_of}
        ends = [file.time_range_ns for file in self._files]
        streams = [unpack_messages(file.batches(stored), file.losses) for file in self._files]
        if all(before[1] < after[0] for before, after in itertools.pairwise(ends)):
            return itertools.chain.from_iterable(streams)
        return merge_streams(streams)

    def _stored(self) -> list[BagTopic]:
        return list(dict.fromkeys(topic for file in self._files for topic in file.topics))

    def _here(self, topic: BagTopic) -> BagTopic | None:
        """A topic by its name here; None if it is hidden or cannot be read."""
        if topic.encoding not in _ENCODINGS:
            return None
        name = self._renamed.get(topic.name)
        if name is None:
            return None if topic.name in self._renamed.values() else topic
        return topic._replace(name=name)

    def close(self) -> None:
        """Close all files, and remove what was unpacked; may be called twice."""
        for file in self._files:
            file.close()
        self._unpacked.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> None:
        """Open every file; one that is unreadable among readable ones is a loss."""
        errors: list[BagError] = []
        for path in self._find():
            try:
                self._files.append(self._open_file(path))
            except BagError as error:  # each file may fail on its own
                errors.append(error)
        if not self._files:
            raise errors[0]
        self._own_losses += [str(error) for error in errors]

    def _open_file(self, path: Path) -> BagFile:
        """Open a file; a compressed one is unpacked into a temporary folder first."""
        if path.suffix in _STORAGES:
            return _STORAGES[path.suffix](path)
        folder = self._unpacked.enter_context(temporary_folder("unpacked_bag_"))
        plain = unpack_file(path, folder, self._own_losses)
        try:
            return _STORAGES[plain.suffix](plain)
        except BagError as error:
            raise BagError(str(error).replace(str(plain), str(path))) from error

    def _check_topics(self) -> None:
        """Name topics that cannot be read or are not there; raises BagError if there are no others."""
        stored = self._stored()
        for encoding in dict.fromkeys(topic.encoding for topic in stored):
            if encoding in _ENCODINGS:
                continue
            names = [topic.name for topic in stored if topic.encoding == encoding]
            advice = _ROS_1 if encoding == "ros1" else "publish them in ROS 2 and record them again"
            said = f"the messages on {listed(names)} are serialized as {encoding}, not as cdr as in ROS 2"
            self._own_losses.add(f"{said}; {advice}.")
        if stored and not any(topic.encoding in _ENCODINGS for topic in stored):
            raise BagError("\n".join(self._own_losses))
        there = {topic.name for topic in stored}
        missing = [name for name in self._renamed if name not in there]
        if missing and len(missing) == len(self._renamed):
            said = f"'{self._path}' has no topic {listed(missing)}"
            raise BagError(f"{said}; it has {listed(sorted(there)) or 'none'}.")
        for name in missing:
            self._own_losses.add(f"there is no topic {name}, which {self._renamed[name]} is mapped to.")

    def _find(self) -> list[Path]:
        path = self._path
        if not path.exists():
            raise BagError(f"There is no bag '{path}'.")
        if not path.is_dir():
            if path.is_file() and is_storage(path):
                return [path]
            hint = _ROS_1.replace("NAME", str(path.with_suffix(""))) if path.suffix == ".bag" else _EXPECTED
            raise BagError(f"'{path}' is no bag: {hint}.")
        recorded = self._listed()
        paths = sorted(filter(is_storage, path.iterdir()), key=_part_number)
        paths = [one for one in paths if one.suffix in _STORAGES or one.with_suffix("") not in paths]
        missing = [name for name in recorded if not (self._path / name).exists()]
        self._own_losses += [f"{name}: the file is missing, its messages are lost." for name in missing]
        if not paths:
            hint = _ROS_1 if any(one.suffix == ".bag" for one in path.iterdir()) else _EXPECTED
            raise BagError(f"'{path}' holds no .mcap or .db3 file: {hint}.")
        return paths

    def _listed(self) -> list[str]:
        """File names in the folder's metadata; none when a crash left it without."""
        path = self._path / "metadata.yaml"
        try:
            tree = read_tree(path, most_bytes=_METADATA_BYTES) if path.exists() else None
        except YamlTreeError as error:
            self._own_losses.append(str(error))
            return []
        info = tree.get("rosbag2_bagfile_information") if isinstance(tree, dict) else None
        if not isinstance(info, dict):
            self._own_losses.append(f"'{self._path}' has no metadata: its recording was not finished.")
            return []
        self.offered_qos = offered_qos(info)
        files = info.get("relative_file_paths")
        return [str(name) for name in files] if isinstance(files, list) else []


def is_storage(path: Path) -> bool:
    """Whether the name is that of a storage file, plain or compressed."""
    return (path if path.suffix not in PACKED else path.with_suffix("")).suffix in _STORAGES


def _part_number(path: Path) -> tuple[int, str]:
    """Parts are numbered without leading zeros: bag_10 comes after bag_9."""
    number = path.name.partition(".")[0].rpartition("_")[2]
    return (int(number) if number.isdecimal() else 0, path.name)


def offered_qos(metadata: dict[str, Any]) -> dict[str, list[Qos]]:
    """The profiles of publishers by topic, from a folder's metadata; malformed parts have none."""
    topics = metadata.get("topics_with_message_count")
    profiles: dict[str, list[Qos]] = {}
    for topic in topics if isinstance(topics, list) else []:
        try:
            about = topic["topic_metadata"]
            profiles[str(about["name"]).lstrip("/")] = parse_qos(about["offered_qos_profiles"])
        except (AttributeError, KeyError, ReaderError, TypeError):
            continue
    return profiles
