"""The parser of events and of lines between them: how bytes are cut does not matter, lost ones do little."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pushbot_events import Sent, event_pieces, random_events

from swarm_loc_drivers.pushbot.event_parser import CONFIRMATIONS, EventParser, Parsed
from swarm_loc_drivers.pushbot.protocol import TIMESTAMPS

STAMPED = [name for name in TIMESTAMPS if name != "none"]
LINE = b"-S28 -120 4294\n"


def parse(data: bytes, timestamps: str, counts: Counter[str], cuts: list[int] | None = None) -> Parsed:
    """Feed bytes, cut at some places."""
    parser = EventParser(timestamps, counts)
    places = [0, *sorted(cuts or []), len(data)]
    parts = [parser.feed(data[begin:end]) for begin, end in pairwise(places)]
    before = np.cumsum([0, *(len(part.x) for part in parts)])
    lines = [
        (int(start) + at, line) for start, part in zip(before, parts, strict=False) for at, line in part.lines
    ]
    return Parsed(
        np.concatenate([part.x for part in parts]),
        np.concatenate([part.y for part in parts]),
        np.concatenate([part.polarity for part in parts]),
        np.concatenate([part.time_us for part in parts]),
        lines,
    )


def assert_same(parsed: Parsed, sent: Sent) -> None:
    """All events came, at their places, and apart by as much as they were."""
    np.testing.assert_array_equal(parsed.x, sent.x)
    np.testing.assert_array_equal(parsed.y, sent.y)
    np.testing.assert_array_equal(parsed.polarity, sent.p)


@pytest.mark.parametrize("timestamps", TIMESTAMPS)
def test_events_and_lines_come_whole(timestamps: str) -> None:
    sent = random_events(1, 500)
    pieces = event_pieces(sent, timestamps)
    data = b"".join(pieces[:200]) + LINE + b"".join(pieces[200:])
    counts: Counter[str] = Counter()
    parsed = parse(data, timestamps, counts)
    assert_same(parsed, sent)
    if timestamps != "none":
        np.testing.assert_array_equal(np.diff(parsed.time_us), np.diff(sent.t))
    assert parsed.lines == [(200, LINE[:-1])]
    assert not counts


def test_the_example_of_the_users_guide() -> None:
    data = bytes.fromhex("E4A50001E240") * CONFIRMATIONS
    parsed = parse(data, "32bit", Counter())
    assert (parsed.x[0], parsed.y[0], parsed.polarity[0]) == (37, 100, 1)


@settings(max_examples=30, deadline=None)
@given(
    timestamps=st.sampled_from(sorted(TIMESTAMPS)),
    seed=st.integers(0, 2**31),
    lost=st.lists(st.integers(0, 400), max_size=3),
    cuts=st.lists(st.integers(0, 600), max_size=12),
    line_at=st.integers(0, 60),
)
def test_any_cutting_gives_the_same(
    timestamps: str, seed: int, lost: list[int], cuts: list[int], line_at: int
) -> None:
    """Also of bytes of which some were lost, which is where there is most to decide."""
    pieces = event_pieces(random_events(seed, 100, start_us=seed % 5_000_000), timestamps)
    pieces.insert(line_at, LINE)
    data = bytearray(b"".join(pieces))
    for at in lost:
        del data[at : at + 1]
    counts, counts_cut = Counter[str](), Counter[str]()
    whole = parse(bytes(data), timestamps, counts)
    cut = parse(bytes(data), timestamps, counts_cut, [at for at in cuts if at < len(data)])
    for one, other in zip(whole[:4], cut[:4], strict=True):
        np.testing.assert_array_equal(one, other)
    assert whole.lines == cut.lines
    assert counts == counts_cut


@pytest.mark.parametrize("timestamps", ["24bit", "32bit"])
def test_after_lost_bytes_events_are_right_again_and_few_are_wrong(timestamps: str) -> None:
    """An event cut in the middle: long timestamps give those away that were put together wrongly."""
    rng, size, wrong = np.random.default_rng(0), 2 + TIMESTAMPS[timestamps], []
    for _ in range(400):
        seed, at, lost = int(rng.integers(2**31)), int(rng.integers(300, 901)), int(rng.integers(1, 41))
        sent = random_events(seed, 400, start_us=seed % 3_000_000)
        data = bytearray(b"".join(event_pieces(sent, timestamps)))
        del data[at : at + lost]
        parsed = parse(bytes(data), timestamps, Counter())
        right = set(zip(*(column.tolist() for column in sent[:3]), strict=True))
        got = list(zip(parsed.x.tolist(), parsed.y.tolist(), parsed.polarity.tolist(), strict=True))
        # the last hundred are far behind the cut: the boundary has been found again
        assert got[-100:] == list(zip(*(column[-100:].tolist() for column in sent[:3]), strict=True))
        assert len(got) >= 400 - lost // size - 1 - 60
        wrong.append(sum(event not in right for event in got))
    assert np.mean(wrong) < 0.2
    assert np.mean(np.array(wrong) > 2) < 0.01  # another boundary may look right for some events


@pytest.mark.parametrize("timestamps", ["16bit", "24bit", "32bit"])
def test_timestamps_wrap(timestamps: str) -> None:
    span = 1 << 8 * TIMESTAMPS[timestamps]
    sent = random_events(3, 400, start_us=span - 20_000)
    counts: Counter[str] = Counter()
    parsed = parse(b"".join(event_pieces(sent, timestamps)), timestamps, counts)
    np.testing.assert_array_equal(np.diff(parsed.time_us), np.diff(sent.t))
    assert not counts


@pytest.mark.parametrize("timestamps", ["24bit", "32bit"])
@pytest.mark.parametrize("jump_us", [-2_000, 1_000_000])
def test_a_jump_of_time_is_believed_once_confirmed(timestamps: str, jump_us: int) -> None:
    """As after `!ET0`, or when the scene was dark."""
    first = random_events(4, 100, start_us=4_000_000)
    second = random_events(5, 100, start_us=int(first.t[-1]) + jump_us)
    counts: Counter[str] = Counter()
    pieces = event_pieces(first, timestamps) + event_pieces(second, timestamps)
    parsed = parse(b"".join(pieces), timestamps, counts)
    assert len(parsed.x) == 200
    assert parsed.time_us[100] - parsed.time_us[99] == int(second.t[0] - first.t[-1])
    assert counts == {"time_jumps": 1}


def test_a_single_wrong_timestamp_is_dropped() -> None:
    sent = random_events(6, 100)
    pieces = event_pieces(sent, "32bit")
    pieces[50] = pieces[50][:2] + b"\x7f" + pieces[50][3:]
    counts: Counter[str] = Counter()
    parsed = parse(b"".join(pieces), "32bit", counts)
    assert len(parsed.x) == 99
    np.testing.assert_array_equal(parsed.time_us - parsed.time_us[0], np.delete(sent.t, 50) - sent.t[0])
    assert counts == {"corrupt_events": 1}


def test_a_jump_that_nothing_confirms_does_not_hold_lines_back_for_ever() -> None:
    sent = random_events(7, 20)
    lone = event_pieces(sent, "32bit")[0][:2] + b"\x70\0\0\0"
    data = b"".join(event_pieces(sent, "32bit")) + lone + LINE * 100
    assert len(parse(data, "32bit", Counter()).lines) == 100


def test_a_line_that_never_ends_is_dropped_and_counted() -> None:
    counts: Counter[str] = Counter()
    sent = random_events(8, 50)
    parsed = parse(b"a" * 1000 + b"\n" + b"".join(event_pieces(sent, "32bit")), "32bit", counts)
    assert_same(parsed, sent)
    assert counts["long_lines"] == 3
    assert [len(line) for _, line in parsed.lines] == [1000 - 3 * 256]


@settings(max_examples=30, deadline=None)
@given(data=st.binary(max_size=800), timestamps=st.sampled_from(sorted(TIMESTAMPS)))
def test_noise_of_any_kind_is_survived(data: bytes, timestamps: str) -> None:
    parser = EventParser(timestamps, Counter())
    for _ in range(4):
        parsed = parser.feed(data)
        assert (parsed.x < 128).all()
        assert (parsed.y < 128).all()
    sent = random_events(9, 300)
    got = [parser.feed(piece) for piece in event_pieces(sent, timestamps)]
    assert sum(len(one.x) for one in got) >= 200


@pytest.mark.parametrize("timestamps", STAMPED)
@pytest.mark.parametrize("spoils", [b"\x01", b"an invalid\xfe\xfebyte", b"\xff\xff\xff\xff\xff\xff"])
def test_lines_after_events_that_are_taken_back_come_after_those_that_are_left(
    timestamps: str, spoils: bytes
) -> None:
    """An event after a jump of time, a line of text, and bytes that show that it was none."""
    good = event_pieces(random_events(1, 40), timestamps)
    wrong = event_pieces(random_events(2, 1, start_us=1 << 30), timestamps)
    counts: Counter[str] = Counter()
    data = b"".join(good[:20]) + wrong[0] + LINE + spoils + b"".join(good[20:])
    parsed = parse(data, timestamps, counts)
    assert (
        any(before == 20 and line.endswith(LINE[:-1]) for before, line in parsed.lines)
        or timestamps == "delta"
    )
    assert all(before <= len(parsed.x) for before, _ in parsed.lines)


@pytest.mark.parametrize("timestamps", TIMESTAMPS)
@settings(max_examples=100)
@given(seed=st.integers(0, 2**31), share=st.floats(1e-4, 0.1))
def test_lines_never_lie_after_more_events_than_there_are(timestamps: str, seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    pieces = event_pieces(random_events(seed, 300), timestamps)
    array = np.frombuffer(b"".join(one + LINE * (k % 10 == 0) for k, one in enumerate(pieces)), np.uint8)
    hit = rng.random(len(array)) < share
    array = np.where(hit, rng.integers(0, 256, len(array)), array)[~hit | (rng.random(len(array)) < 0.5)]
    parser = EventParser(timestamps, Counter())
    for piece in np.array_split(array.astype(np.uint8), 20):
        parsed = parser.feed(piece.tobytes())
        places = [before for before, _ in parsed.lines]
        assert places == sorted(places)
        assert max(places, default=0) <= len(parsed.x)
