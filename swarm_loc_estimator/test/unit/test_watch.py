"""What the page is told and who may open it, without a browser."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Iterator

import aiohttp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from processor_wait import THIS_THREAD, waited_s

from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.watch.access import Access, AccessError
from swarm_loc_estimator.watch.frames import Frame, History, pack, unpack
from swarm_loc_estimator.watch.page import about, content_security_policy, page
from swarm_loc_estimator.watch.server import Answer, Command, ServerError, ServerLoad, WatchServer

SECOND = 1_000_000_000
MEGABYTE = 1 << 20


@given(
    st.lists(st.sampled_from(["float64", "float32", "int32", "uint8", "int8"]), max_size=6),
    st.lists(st.integers(0, 9), min_size=6, max_size=6),
    st.integers(0, 2**61),
)
def test_columns_come_back_from_a_frame(kinds: list[str], lengths: list[int], stamp_ns: int) -> None:
    columns = {
        f"c{k}": np.arange(n).astype(kind) for k, (kind, n) in enumerate(zip(kinds, lengths, strict=False))
    }
    frame = pack("poses", stamp_ns, columns, width=3)
    header, found = unpack(frame.data)
    assert (header["kind"], header["width"]) == ("poses", 3)
    assert header["stamp"] == pytest.approx(stamp_ns * 1e-6)
    assert found.keys() == columns.keys()
    for name, column in columns.items():
        assert found[name].dtype == column.dtype
        assert np.array_equal(found[name], column)
    assert len(frame.data) % 8 == 0, "the next frame of a recording would not be aligned"


@given(st.lists(st.tuples(st.sampled_from(["poses", "truth", "map"]), st.integers(0, 400)), max_size=300))
def test_the_history_stays_within_its_bounds(steps: list[tuple[str, int]]) -> None:
    history, now_ns = History(span_ns=60 * SECOND, max_bytes=5000), 0
    newest: dict[str, Frame] = {}
    for kind, later_ms in steps:
        now_ns += later_ms * 1_000_000
        newest[kind] = Frame(kind, now_ns, bytes(100))
        history.add(newest[kind])
        assert history.size <= 5000
    told = history.frames()
    assert all(frame in told for frame in newest.values()), "the newest of each kind must be told"
    assert all(frame.stamp_ns >= now_ns - 60 * SECOND for frame in told if frame not in newest.values())


def test_the_history_begins_anew_when_time_jumps_back() -> None:
    history = History()
    assert not any(history.add(Frame("poses", k * SECOND, b"x")) for k in range(10))
    assert history.add(Frame("poses", 2 * SECOND, b"y"))
    assert [frame.data for frame in history.frames()] == [b"y"]


@pytest.mark.parametrize(
    ("address", "token", "host", "origin", "given", "is_let_in"),
    [
        ("127.0.0.1", "", "127.0.0.1:8420", "http://127.0.0.1:8420", "", True),
        ("127.0.0.1", "", "localhost:8420", "http://localhost:8420", "", True),
        ("127.0.0.1", "", "localhost:8420", None, "", True),
        ("127.0.0.1", "", "localhost:8420", "http://localhost:9000", "", False),
        ("127.0.0.1", "", "localhost:8420", "https://elsewhere.example", "", False),
        ("127.0.0.1", "", "localhost:8420", "null", "", False),
        ("127.0.0.1", "", "elsewhere.example:8420", "http://elsewhere.example:8420", "", False),
        ("0.0.0.0", "secret", "robots.lab:8420", "http://robots.lab:8420", "secret", True),  # noqa: S104
        ("0.0.0.0", "secret", "robots.lab:8420", "http://robots.lab:8420", "wrong", False),  # noqa: S104
        ("0.0.0.0", "secret", "robots.lab:8420", "http://other.lab", "secret", False),  # noqa: S104
    ],
)
def test_who_is_let_in(
    address: str, token: str, host: str, origin: str | None, given: str, *, is_let_in: bool
) -> None:
    assert (Access(address, token).refusal(host, origin, given) == "") == is_let_in


def test_an_address_that_others_reach_needs_a_token() -> None:
    with pytest.raises(
        AccessError, match=r"address = '0\.0\.0\.0' can be reached by others: set the parameter token"
    ):
        Access("0.0.0.0")  # noqa: S104


def test_the_page_is_whole_and_may_ask_nobody_else() -> None:
    text = re.sub(r"/\*!.*?\*/", "", page())
    assert "http" not in text
    assert not re.search(r"""(src|href)=["'](?!data:)""", text)
    policy = content_security_policy()
    assert "default-src 'none'" in policy
    assert "unsafe-eval" not in policy


@pytest.fixture
def server() -> Iterator[WatchServer]:
    def obey(command: Command, answer: Answer) -> None:
        answer(f"done: {command['do']}")

    swarm = Swarm(robots=(Robot("alpha"),))
    served = WatchServer(about(swarm, "one"), Access("127.0.0.1"), 0, 20.0, obey)
    yield served
    served.close()


def test_a_taken_port_is_named(server: WatchServer) -> None:
    told = about(Swarm(), "none")
    with pytest.raises(ServerError, match=f"parameter port = {server.port}: 127.0.0.1 cannot be listened on"):
        WatchServer(told, Access("127.0.0.1"), server.port, 20.0, lambda _command, _answer: None)


def test_wrong_words_of_a_page_are_answered(server: WatchServer) -> None:
    async def talk() -> list[str]:
        async with aiohttp.ClientSession() as session, session.ws_connect(f"{server.url}socket") as socket:
            assert (await socket.receive_json())["names"] == ["alpha"]
            said = []
            for text in (
                "{",
                "[]",
                '{"do": "reset", "robot": 7}',
                '{"do": "reset", "robot": "x"}',
                '{"do": "reset"}',
            ):
                await socket.send_str(text)
                said.append((await socket.receive_json())["text"])
            return said

    unread = "The page's command cannot be read."
    assert asyncio.run(talk()) == [unread, unread, "There is no robot number 7.", unread, "done: reset"]


def test_a_page_that_does_not_read_costs_nothing_and_others_see_the_newest(server: WatchServer) -> None:
    frames = [pack("poses", k * SECOND, {"x": np.zeros(MEGABYTE // 8)}) for k in range(1, 101)]

    async def look() -> float:
        async with aiohttp.ClientSession() as session:
            # a small receive buffer that nobody empties
            sleeper = await session.ws_connect(f"{server.url}socket", max_msg_size=0)
            reader = await session.ws_connect(f"{server.url}socket", max_msg_size=0)
            await reader.receive_json()
            begin_s = time.perf_counter() - waited_s(THIS_THREAD)
            for frame in frames:
                server.publish(frame)
            took_s = time.perf_counter() - waited_s(THIS_THREAD) - begin_s
            while unpack(await reader.receive_bytes())[0]["stamp"] != pytest.approx(100e3):
                await reader.send_str("+")
            await reader.close()
            del sleeper
            return took_s

    assert asyncio.run(look()) < 0.5, "publishing waits for a page"


def test_a_page_that_is_behind_is_told_as_slow(server: WatchServer) -> None:
    async def look() -> tuple[ServerLoad, ServerLoad]:
        async with aiohttp.ClientSession() as session:
            sleeper = await session.ws_connect(f"{server.url}socket")
            reader = await session.ws_connect(f"{server.url}socket")
            assert (await reader.receive_json())["names"] == ["alpha"]
            for k in range(1, 11):
                server.publish(pack("poses", k * SECOND, {"x": np.zeros(3)}))
                await reader.receive_bytes()
                await reader.send_str("+")
            found = (server.load(), server.load())
            await reader.close()
            await sleeper.close()
            return found

    first, then = asyncio.run(look())
    assert (first.pages, first.slow) == (2, 1)
    assert first.left_out >= 4
    assert (then.slow, then.left_out) == (0, first.left_out)
    server.close()
    assert server.load() == first._replace(pages=0, slow=0), "what was left out is forgotten with its page"


def test_pages_that_are_not_let_in_are_counted(server: WatchServer) -> None:
    async def ask() -> int:
        headers = {"Origin": "https://elsewhere.example"}
        async with aiohttp.ClientSession() as session, session.get(server.url, headers=headers) as answer:
            return answer.status

    assert asyncio.run(ask()) == 403
    assert server.load().refused == 1
