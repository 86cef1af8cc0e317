"""Anonymous detections from raw messages to the estimator's columns, and who is who as a message."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.cdr import ANONYMOUS_DETECTIONS, ROBOT_IDENTITIES, CdrError
from swarm_loc_estimator.common.messages.detections import (
    ANONYMOUS_DTYPE,
    decode_detections,
    encode_detections,
    encode_identities,
)
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.sensors.aerial import MAX_ANONYMOUS
from swarm_loc_estimator.sensors.inputs import Batch, Ingest
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

NAMES = st.sampled_from(["", "a", "map", "ab/base_link", "r\u00f6"])


def detections(count: int, seed: int = 1) -> NDArray[np.void]:
    rng = np.random.default_rng(seed)
    out = np.zeros(count, dtype=ANONYMOUS_DTYPE)
    for name in ANONYMOUS_DTYPE.names or ():
        out[name] = rng.uniform(-1.0, 1.0, out[name].shape)
    out["theta"][::2] = np.nan
    return out


def read(*messages: tuple[bytes, int]) -> tuple[Batch, Ingest]:
    ingest = Ingest(Swarm((Robot("a"), Robot("b"))))
    handle = ingest.handle_of["aerial/detections"]
    (found,) = ingest.read(MessageBatch.of([SerializedMessage(handle, data, at) for data, at in messages]))
    return found, ingest


@given(
    frame=NAMES,
    stamp_ns=st.integers(0, 2**60),
    count=st.integers(0, 5),
    seed=st.integers(0, 99),
    swapped=st.booleans(),
)
def test_images_read_as_the_type_store_writes_them(
    frame: str, stamp_ns: int, count: int, seed: int, swapped: bool
) -> None:
    shown = detections(count, seed)
    data = encode_detections(frame, stamp_ns, shown)
    message = typestore().deserialize_cdr(data, ANONYMOUS_DETECTIONS)
    rewritten = typestore().serialize_cdr(message, ANONYMOUS_DETECTIONS, little_endian=not swapped)
    for one in (
        decode_detections(data, ANONYMOUS_DETECTIONS),
        decode_detections(bytes(rewritten), ANONYMOUS_DETECTIONS),
    ):
        assert (one.stamp_ns, one.frame_id) == (stamp_ns, frame)
        assert one.detections.tobytes() == shown.tobytes()


@pytest.mark.parametrize("count", [0, 2])
def test_damaged_bytes_are_refused(count: int) -> None:
    good = encode_detections("map", 5, detections(count))
    for damaged in (b"", good[:3], good[:20], good[:-9], good + bytes(8)):
        with pytest.raises(CdrError):
            decode_detections(damaged, ANONYMOUS_DETECTIONS)


def test_images_become_rows_and_those_that_cannot_be_used_are_counted() -> None:
    far_too_many = encode_detections("map", 4, detections(MAX_ANONYMOUS + 1))
    images = [
        (encode_detections("map", 1, detections(2)), 10),
        (encode_detections("odom", 2, detections(3)), 11),
        (encode_detections("map", 3, detections(0)), 12),
        (far_too_many, 13),
        (b"nonsense", 14),
        (encode_detections("map", 5, detections(1, 2)), 15),
    ]
    found, ingest = read(*images)
    rows = found["aerial"]
    assert rows.stamp_ns.tolist() == [1, 1, 5]
    assert rows.number.tolist() == [0, 1, 0]
    assert rows.arrival_ns.tolist() == [10, 10, 15]
    assert rows.robot.tolist() == [-1, -1, -1]
    np.testing.assert_array_equal(rows.pose[2, :2], [detections(1, 2)["x"][0], detections(1, 2)["y"][0]])
    assert np.isnan(rows.pose[0, 2])
    assert found.dropped == {"aerial_frame": 1, "aerial_too_many": 1, "bad_message": 1}
    assert ingest.received() == {"aerial/detections": 6}


def test_identities_read_as_the_type_store_reads_them() -> None:
    names, place, probability = ["a", "epuck12"], np.array([3, -1]), np.array([0.995, 0.25])
    data = encode_identities("map", 7_000_000_001, names, place, probability)
    message: Any = typestore().deserialize_cdr(data, ROBOT_IDENTITIES)
    told = [(one.name, one.detection, one.probability) for one in message.identities]
    assert told == [("a", 3, 0.995), ("epuck12", -1, 0.25)]
    assert (message.header.frame_id, message.header.stamp.sec, message.header.stamp.nanosec) == ("map", 7, 1)
