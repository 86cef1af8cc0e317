"""Events in the `mono` encoding: what is encoded comes back, and broken packets are refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.messages.cdr import EVENT_PACKETS, SEQUENCE, fields_of
from swarm_loc_estimator.common.messages.event_encoding import (
    ENCODING,
    MAX_SPAN_NS,
    EventError,
    Events,
    decode_events,
    encode_events,
)

SIZE = (640, 480)


def events(seed: int, count: int) -> Events:
    rng = np.random.default_rng(seed)
    return Events(
        rng.integers(0, SIZE[0], count).astype(np.uint16),
        rng.integers(0, SIZE[1], count).astype(np.uint16),
        rng.random(count) < 0.5,
        np.sort(rng.integers(0, MAX_SPAN_NS, count, endpoint=True)),
    )


@given(seed=st.integers(0, 2**31), count=st.integers(0, 50))
def test_what_is_encoded_comes_back(seed: int, count: int) -> None:
    sent = events(seed, count)
    for one, other in zip(decode_events(encode_events(sent), ENCODING, SIZE), sent, strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_layout_is_that_of_event_camera_msgs() -> None:
    """Time in the lowest 32 bits, then column and row, polarity in the highest bit."""
    one = Events(np.array([37], np.uint16), np.array([100], np.uint16), np.array([True]), np.array([5000]))
    assert encode_events(one) == (1 << 63 | 100 << 48 | 37 << 32 | 5000).to_bytes(8, "little")


def test_our_copy_of_the_message_has_the_fields_of_event_camera_msgs() -> None:
    expected = {"header": "std_msgs/msg/Header", "height": "I", "width": "I", "seq": "Q", "time_base": "Q"}
    expected |= {"encoding": "string", "is_bigendian": "?", "events": "B"}
    fields = fields_of(EVENT_PACKETS[-1])
    assert [(one.name, one.type) for one in fields] == [*expected.items()]
    assert [one.name for one in fields if one.size == SEQUENCE] == ["events"]


def test_the_other_order_of_bytes_is_read() -> None:
    sent = events(1, 20)
    swapped = np.frombuffer(encode_events(sent), "<u8").astype(">u8").tobytes()
    np.testing.assert_array_equal(decode_events(swapped, ENCODING, SIZE, is_bigendian=True).x, sent.x)


@pytest.mark.parametrize(
    ("data", "encoding", "reason"),
    [
        (encode_events(events(2, 5))[:-3], ENCODING, "cut"),
        (encode_events(events(2, 5)), "evt3", "evt3"),
        ((640 << 32).to_bytes(8, "little"), ENCODING, "outside"),
        (encode_events(events(2, 5))[::-1], ENCODING, "outside|step back"),
        (encode_events(events(2, 5))[8:] + encode_events(events(2, 5))[:8], ENCODING, "step back"),
    ],
)
def test_broken_packets_are_refused(data: bytes, encoding: str, reason: str) -> None:
    with pytest.raises(EventError, match=reason):
        decode_events(data, encoding, SIZE)
