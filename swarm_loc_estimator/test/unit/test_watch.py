"""The page's server, its frames and its access control, without a browser."""

import asyncio
import re
import socket
import time
from collections.abc import Iterator
from types import SimpleNamespace

import aiohttp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from page_frames import unpack
from processor_wait import THIS_THREAD, waited_s

from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimate import Status
from swarm_loc_estimator.watch.markers import _COLOURS
from swarm_loc_estimator.watch.page import Frame, History, about, content_security_policy, pack, page
from swarm_loc_estimator.watch.server import (
    Access,
    AccessError,
    Answer,
    Command,
    ServerError,
    ServerLoad,
    WatchServer,
    WrongTokens,
)

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
    kept = history.frames()
    assert all(frame in kept for frame in newest.values()), "the newest of each kind must be kept"
    assert all(frame.stamp_ns >= now_ns - 60 * SECOND for frame in kept if frame not in newest.values())


def test_the_history_restarts_when_time_jumps_back() -> None:
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
        ("127.0.0.1", "", "LocalHost", "http://LocalHost", "", True),
        ("::1", "", "[::1]:8420", "http://[::1]:8420", "", True),
        ("127.0.0.1", "", "[::1].evil.com", None, "", False),
        ("127.0.0.1", "", "[::1]evil.com:8420", "http://[::1]evil.com:8420", "", False),
        ("127.0.0.1", "", "evil.com\\@127.0.0.1", None, "", False),
        ("127.0.0.1", "", "evil.com@127.0.0.1:8420", None, "", False),
        ("127.0.0.1", "", "127.0.0.1/evil.com", None, "", False),
        ("127.0.0.1", "", "127.0.0.1:8420:80", None, "", False),
        ("127.0.0.1", "", "127.0.0.1\n", None, "", False),
        ("127.0.0.1", "", "", None, "", False),
        ("127.0.0.1", "", "localhost:8420", "ftp://localhost:8420", "", False),
        ("0.0.0.0", "a secret", "robots.lab:8420", "http://robots.lab:8420", "a secret", True),  # noqa: S104
        ("0.0.0.0", "a secret", "robots.lab:8420", "http://robots.lab:8420", "wrong", False),  # noqa: S104
        ("0.0.0.0", "a secret", "robots.lab:8420", "http://other.lab", "a secret", False),  # noqa: S104
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


@pytest.mark.parametrize("address", ["127.0.0.1", "0.0.0.0"])  # noqa: S104
@pytest.mark.parametrize(
    "token", ["seven77", "aaaaaaaa", "        ", "abababababab", "11223344", "äääääääääää"]
)
def test_a_weak_token_is_refused(address: str, token: str) -> None:
    with pytest.raises(AccessError, match="parameter token is too weak: it needs 8 characters or more"):
        Access(address, token)


def locked_out(wrong: WrongTokens, clients: list[str]) -> float:
    """Share of clients whose right token is refused."""
    return sum(wrong.refusal(client, "a secret", "a secret") != "" for client in clients) / len(clients)


@pytest.mark.parametrize(
    "guessers",
    [
        [f"203.0.113.{k}" for k in range(256)],
        [f"::ffff:203.0.113.{k}" for k in range(256)],
        [f"203.0.{k >> 8}.{k & 255}" for k in range(0, 65536, 7)],
        [f"2001:db8::{k:x}" for k in range(5000)],
        [f"2001:db8:0:{k:x}::1" for k in range(5000)],
    ],
)
def test_a_guesser_with_many_addresses_locks_few_others_out(
    guessers: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    standing = SimpleNamespace(monotonic=lambda: 1.0)
    monkeypatch.setattr("swarm_loc_estimator.watch.server.time", standing)
    wrong = WrongTokens()
    for guesser in guessers:
        for k in range(20):
            wrong.refusal(guesser, f"guess{k}", "a secret")
    assert locked_out(wrong, guessers) == 1.0
    others = [f"{k % 223 + 1}.{k * 7 % 256}.{k * 13 % 256}.{k * 29 % 256}" for k in range(2000)]
    others += [f"{0x2000 + k % 4096:x}:{k * 7:x}:{k * 11:x}:{k:x}::{k * 3:x}" for k in range(2000)]
    assert locked_out(wrong, others) < 0.05


def test_few_words_in_the_log_for_many_requests_that_cannot_be_read(
    server: WatchServer, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    begin_s = time.monotonic()
    for k in range(100):
        with socket.create_connection(("127.0.0.1", server.port), 10.0) as one:
            one.sendall(
                [b"\x16\x03\x01\x02\r\n\r\n", b"GET / HTTP/9.x\r\n\r\n", b"GET / HTTP/1.1\r\n: \r\n\r\n"][
                    k % 3
                ]
            )
            read_all(one)
    assert len(caplog.records) <= 1 + (time.monotonic() - begin_s)
    assert all(record.exc_info is None and "\n" not in record.getMessage() for record in caplog.records)
    assert "Traceback" not in capfd.readouterr().err
    assert " 200 " in head(server)


@pytest.mark.parametrize(
    "origins",
    [
        ("http://HOST", "http://evil.com"),
        ("http://evil.com", "http://HOST"),
        ("http://HOST",) * 2,
        ("", "http://HOST"),
        ("",),
    ],
)
def test_two_origin_headers_are_refused(server: WatchServer, origins: tuple[str, ...]) -> None:
    host = f"127.0.0.1:{server.port}"
    lines = "".join(f"\r\nOrigin: {one.replace('HOST', host)}" for one in origins)
    assert re.match(r"HTTP/1\.[01] 40[03] ", head(server, host=f"{host}{lines}".encode()))
    assert " 200 " in head(server, host=f"{host}\r\nOrigin: http://{host}".encode())


def test_page_and_markers_show_each_status() -> None:
    listed = re.search(r"const STATUS = \[(.*?)\]", page())
    assert listed is not None
    assert re.findall(r"\w+", listed[1]) == [status.name.lower() for status in Status]
    assert len(_COLOURS) == len(Status)


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
    first = about(Swarm(), "none")
    with pytest.raises(ServerError, match=f"parameter port = {server.port}: 127.0.0.1 cannot be listened on"):
        WatchServer(first, Access("127.0.0.1"), server.port, 20.0, lambda _command, _answer: None)


UNREAD = "The page's command cannot be read."


@pytest.mark.parametrize(
    ("text", "answer"),
    [
        ("{", UNREAD),
        ("[]", UNREAD),
        ("3", UNREAD),
        pytest.param("[" * 1000, UNREAD, id="a thousand brackets"),
        pytest.param("[" * 2000 + "]" * 2000, UNREAD, id="closed brackets"),
        pytest.param('{"do":' + '{"a":' * 600 + "1" + "}" * 601, UNREAD, id="braces"),
        ('{"robot": 0}', UNREAD),
        ('{"do": ["reset"]}', UNREAD),
        ('{"do": "reset", "robot": "x"}', UNREAD),
        ('{"do": "reset", "robot": null}', UNREAD),
        ('{"do": "reset", "robot": 1e999}', UNREAD),
        ('{"do": "reset", "robot": Infinity}', UNREAD),
        ('{"do": "reset", "robot": NaN}', UNREAD),
        ('{"do": "reset", "robot": 7}', "There is no robot number 7."),
        ('{"do": "reset"}', "done: reset"),
    ],
)
def test_wrong_commands_are_answered(
    server: WatchServer, caplog: pytest.LogCaptureFixture, text: str, answer: str
) -> None:
    async def talk() -> str:
        async with aiohttp.ClientSession() as session, session.ws_connect(f"{server.url}socket") as socket:
            assert (await socket.receive_json())["names"] == ["alpha"]
            await socket.send_str(text)
            said: str = (await socket.receive_json())["text"]
            return said

    assert asyncio.run(talk()) == answer
    assert not caplog.records


def head(
    server: WatchServer, *, path: str = "/", host: bytes = b"127.0.0.1", client: str = "127.0.0.1"
) -> str:
    """The status line and the text that the server answers a request."""
    with socket.create_connection(("127.0.0.1", server.port), 10.0, source_address=(client, 0)) as one:
        one.sendall(f"GET {path} HTTP/1.1\r\nConnection: close\r\nHost: ".encode() + host + b"\r\n\r\n")
        answer = b"".join(iter(lambda: one.recv(65536), b"")).decode()
    lines = answer.splitlines()
    return f"{lines[0]} {lines[-1]}"


@pytest.mark.parametrize("host", [b"[::1].evil.com", b"evil.com\\@127.0.0.1", b"evil.com", b"\xff\xfe", b""])
def test_foreign_host_headers_are_refused(
    server: WatchServer, caplog: pytest.LogCaptureFixture, host: bytes
) -> None:
    assert re.match(r"HTTP/1\.[01] 40[03] ", head(server, host=host))
    assert not caplog.records


def test_two_host_headers_are_refused(server: WatchServer) -> None:
    assert re.match(r"HTTP/1\.[01] 40[03] ", head(server, host=b"127.0.0.1\r\nHost: evil.com"))
    assert " 200 " in head(server)


@pytest.mark.parametrize(
    "part",
    [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: x", b"GET /socket HTTP/1.1\r\nContent-Length: 9\r\n\r\nx"],
)
def test_half_a_request_is_closed_in_time(
    monkeypatch: pytest.MonkeyPatch, server: WatchServer, part: bytes
) -> None:
    async def look() -> None:
        async with aiohttp.ClientSession() as session, session.ws_connect(f"{server.url}socket") as page:
            with socket.create_connection(("127.0.0.1", server.port), 15.0) as one:
                one.sendall(part)
                reader = asyncio.get_running_loop().run_in_executor(None, read_all, one)
                await asyncio.wait_for(reader, 15.0)
            await page.receive_json()
            await page.send_str('{"do": "reset"}')
            assert (await page.receive_json())["text"] == "done: reset", "an open page was closed, too"

    monkeypatch.setattr("swarm_loc_estimator.watch.server.REQUEST_PATIENCE_S", 1.0)
    asyncio.run(look())


def read_all(connection: socket.socket) -> None:
    """Read until the other side closes."""
    try:
        while connection.recv(4096):
            pass
    except ConnectionResetError:
        pass


@pytest.fixture
def guarded() -> Iterator[WatchServer]:
    served = WatchServer(about(Swarm(), "one"), Access("127.0.0.1", "a secret"), 0, 20.0, lambda *_: None)
    yield served
    served.close()


def test_guesses_of_the_token_are_slowed_down(guarded: WatchServer) -> None:
    answers = [head(guarded, path=f"/?token=guess{k}") for k in range(20)]
    assert ["wait 1 s" in answer for answer in answers[:5]] == [False] * 5
    assert sum("wait 1 s" in answer for answer in answers) >= 12, "guesses are compared at full speed"
    assert "wait 1 s" in head(guarded, path="/?token=a%20secret"), (
        "the right token is accepted during the pause, which reveals it"
    )
    assert " 200 " in head(guarded, path="/?token=a%20secret", client="127.0.0.2")
    time.sleep(1.1)
    assert " 200 " in head(guarded, path="/?token=a%20secret")


def test_an_old_page_that_reconnects_locks_nobody_out(
    guarded: WatchServer, caplog: pytest.LogCaptureFixture
) -> None:
    for query in ("?token=yesterday", "", "?token=yesterday", "?token=") * 5:
        assert "The token is missing or wrong" in head(guarded, path=f"/{query}")
    assert "The token is missing or wrong" in head(guarded, path="/?token=%ff%ED%A0%80")
    assert " 200 " in head(guarded, path="/?token=a%20secret")
    assert not caplog.records


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


def test_a_page_that_is_behind_is_counted_as_slow(server: WatchServer) -> None:
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
