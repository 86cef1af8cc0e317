"""The page: its frames, its server, and viewers elsewhere."""

import asyncio
import base64
import gzip
import json
import re
import socket
import struct
import time
from collections.abc import Iterator
from configparser import ConfigParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree as ET

import aiohttp
import numpy as np
import pytest
from core_messages import SECOND, odometry_bytes
from hypothesis import given
from hypothesis import strategies as st
from page_frames import unpack
from processor_wait import THIS_THREAD, waited_s
from ruamel.yaml import YAML

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import OCCUPANCY_GRID, ODOMETRY, POSE_STAMPED, CdrError, encode
from swarm_loc_estimator.common.messages.poses import encode_pose_stamped
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.identification.memory import Identities
from swarm_loc_estimator.mapping.messages import MAX_CELLS, decode_occupancy_grid
from swarm_loc_estimator.offline.export import write_mcap
from swarm_loc_estimator.offline.recorded_bag import MapReader
from swarm_loc_estimator.offline.replay import AerialImages, replay
from swarm_loc_estimator.offline.report.report import recorded
from swarm_loc_estimator.sensors.aerial import AerialRows
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


PACKAGE = Path(__file__).parents[2]
VIEWERS = PACKAGE / "viewers"
NODES_WITHOUT_DIAGNOSTICS = {
    *("droplet_steering", "eight_steering", "markers"),
    *("droplet_world", "epuck_world", "pushbot_world"),
}


def node_names() -> set[str]:
    """Names of all nodes of the packages that report on /diagnostics."""
    named = re.compile(r'super\(\).__init__\(\s*"(\w+)", (\w+Parameters)')
    sources = [
        path
        for package in ("estimator", "vision", "drivers")
        for path in (PACKAGE.parent / f"swarm_loc_{package}" / f"swarm_loc_{package}").rglob("*.py")
    ]
    found = {match[1] for path in sources for match in named.finditer(path.read_text(encoding="utf-8"))}
    return found - NODES_WITHOUT_DIAGNOSTICS - {"calibrate_laser"}  # that is a command


def test_shipped_layouts_show_what_is_published() -> None:
    rviz = YAML(typ="safe").load((VIEWERS / "swarm.rviz").read_text(encoding="utf-8"))[
        "Visualization Manager"
    ]
    topics = {one["Topic"]["Value"] for one in rviz["Displays"] if "Topic" in one}
    assert topics == {"swarm/markers", "map"}
    assert rviz["Global Options"]["Fixed Frame"] == "map"
    layout = json.loads((VIEWERS / "foxglove.json").read_text(encoding="utf-8"))
    assert layout["configById"][layout["layout"]["first"]]["topics"]["/swarm/markers"]["visible"]


def test_plotjuggler_draws_fields_of_swarm_poses() -> None:
    definition = (PACKAGE.parent / "swarm_loc_msgs" / "msg" / "SwarmPose.msg").read_text(encoding="utf-8")
    fields = set(re.findall(r"^[a-z0-9\[\]]+ (\w+)\s", definition, re.MULTILINE))
    curves = list(ET.parse(VIEWERS / "plotjuggler.xml").iter("curve"))  # noqa: S314
    names = [curve.get(key) for curve in curves for key in ("name", "curve_x", "curve_y") if curve.get(key)]
    drawn = [name for name in names if name and name.startswith("/")]
    assert len(drawn) > len(curves) / 2
    for name in drawn:
        matched = re.fullmatch(r"/swarm/poses/robots\[[0-4]\]/(\w+)(\[\d\])?", name)
        assert matched, name
        assert matched[1] in fields, name


@pytest.mark.parametrize("name", sorted(node_names()))
def test_each_node_that_reports_has_one_group_in_diagnostic_aggregator(name: str) -> None:
    settings = YAML(typ="safe").load((VIEWERS / "analyzers.yaml").read_text(encoding="utf-8"))
    groups = settings["analyzers"]["ros__parameters"]
    groups.pop("path")
    matching = [
        group for group, keys in groups.items() if any(part in f"robot1/{name}" for part in keys["contains"])
    ]
    assert len(matching) == 1, (name, matching)


def test_files_for_viewers_are_installed() -> None:
    setup = ConfigParser()
    setup.read(PACKAGE / "setup.cfg")
    installed = setup["options.data_files"]["share/swarm_loc_estimator/viewers"].split()
    assert sorted(installed) == sorted(f"viewers/{path.name}" for path in VIEWERS.iterdir())


SWARM = Swarm(robots=(Robot("a", start=(0.0, 0.0, 0.0)), Robot("b", start=(1.0, 0.0, 0.0))))


def grid_bytes(
    cells: np.ndarray[Any, np.dtype[np.int8]], stamp_ns: int = 0, frame: str = "map", resolution: float = 0.5
) -> bytes:
    height, width = cells.shape
    origin = {"position": {"x": -1.0, "y": 2.0}, "orientation": {"z": np.sin(0.1), "w": np.cos(0.1)}}
    info = {"resolution": resolution, "width": width, "height": height, "origin": origin}
    message = {"header": {"stamp": stamp_ns, "frame_id": frame}, "info": info, "data": cells.reshape(-1)}
    return encode(message, OCCUPANCY_GRID)


@given(st.integers(1, 9), st.integers(1, 9), st.text("abé/", max_size=7), st.integers(0, 2**31 * SECOND - 1))
def test_a_map_is_read_as_it_was_written(height: int, width: int, frame: str, stamp_ns: int) -> None:
    cells = np.arange(height * width, dtype=np.int8).reshape(height, width) - 1
    found = decode_occupancy_grid(grid_bytes(cells, stamp_ns, frame))
    assert (found.stamp_ns, found.frame_id, found.resolution) == (stamp_ns, frame, 0.5)
    assert found.origin == pytest.approx((-1.0, 2.0, 0.2))
    np.testing.assert_array_equal(found.cells, cells)


def test_bytes_that_are_no_map_are_refused() -> None:
    whole = grid_bytes(np.zeros((3, 4), np.int8))
    for length in range(len(whole)):
        with pytest.raises(CdrError):
            decode_occupancy_grid(whole[:length])
    with pytest.raises(CdrError):
        decode_occupancy_grid(whole + bytes(8))
    with pytest.raises(CdrError):
        decode_occupancy_grid(grid_bytes(np.zeros((1, 4), np.int8), resolution=float("nan")))
    with pytest.raises(CdrError, match=f"a map of {MAX_CELLS + 1} x 1 cells"):
        decode_occupancy_grid(grid_bytes(np.zeros((1, MAX_CELLS + 1), np.int8)))


@given(st.lists(st.integers(0, 3), min_size=1, max_size=80))
def test_maps_are_thinned_out_and_the_newest_is_kept(later_s: list[int]) -> None:
    data = grid_bytes(np.zeros((2, 2), np.int8))
    reader, log_ns = MapReader(SWARM, max_bytes=10 * len(data)), 0
    for step_s in later_s:
        log_ns += step_s * SECOND
        reader.add(MessageBatch.of([SerializedMessage(0, data, log_ns)]))
    kept = [one.log_ns for one in reader.maps()]
    assert 1 <= len(kept) <= 11
    assert kept == sorted(kept)
    assert kept[-1] == log_ns
    assert len(later_s) > 10 or len(kept) == len(later_s)


def test_who_is_who_comes_to_the_image_in_which_it_was_so() -> None:
    images = AerialImages()
    stamps, numbers = np.array([1, 1, 2]), np.array([0, 1, 0])
    pose, nothing = np.arange(9.0).reshape(3, 3), np.zeros(3, np.int64)
    images.add(AerialRows(nothing - 1, stamps, numbers, pose, np.zeros((3, 3, 3)), nothing))
    for probability in (0.5, 0.9):  # what is known changes
        images.note(Identities(1, np.array([1, -1]), np.array([probability, 0.3])))
    images.note(Identities(7, np.array([0, 1]), np.array([1.0, 1.0])))
    first, second = images.images()
    assert (first.stamp_ns, first.robot.tolist(), first.probability.tolist()) == (1, [-1, 0], [0.0, 0.9])
    assert (second.stamp_ns, second.robot.tolist(), second.probability.tolist()) == (2, [-1], [0.0])
    assert first.position.tolist() == [[0.0, 1.0], [3.0, 4.0]]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots that stand, a map that grows, and goals."""
    path = tmp_path_factory.mktemp("bags") / "mapped"
    stamps_ns = np.arange(1, 41) * SECOND // 10
    with BagWriter(path) as writer:
        for robot in SWARM.robots:
            writer.add_topic(f"{robot.name}/odom", ODOMETRY)
            writer.add_topic(f"{robot.name}/goal", POSE_STAMPED)
        writer.add_topic("map", OCCUPANCY_GRID)
        for k, now_ns in enumerate(stamps_ns.tolist()):
            for robot in SWARM.robots:
                writer.write(f"{robot.name}/odom", now_ns, odometry_bytes("a", now_ns))
            if k % 10 == 5:
                writer.write("map", now_ns, grid_bytes(np.full((2, 3), k, np.int8)))
                goal = encode_pose_stamped("map", stamps_ns[k : k + 1], np.array([[k, 1.0, 0.5]]))[0]
                writer.write(f"{'ab'[k == 25]}/goal", now_ns, goal)
        writer.write("map", now_ns, b"no map")
    return path


def test_map_and_goals_of_a_bag_come_to_viewers_and_to_the_page(bag: Path, tmp_path: Path) -> None:
    result = replay(bag, SWARM, keep_sightings=True)
    assert [int(one.grid.cells[0, 0]) for one in result.maps] == [5, 15, 25, 35]
    assert "1 messages of maps or goals are malformed." in result.remarks
    write_mcap(result, tmp_path / "new" / "run.mcap")
    with BagReader(tmp_path / "new" / "run.mcap") as reader:
        found: dict[str, list[bytes]] = {}
        for topic, _, _, data in reader.messages(["map", "a/goal", "b/goal"]):
            found.setdefault(topic, []).append(bytes(data))
    assert [int(decode_occupancy_grid(data).cells[0, 0]) for data in found["map"]] == [5, 15, 25, 35]
    assert (len(found["a/goal"]), len(found["b/goal"])) == (3, 1)
    frames = frames_of(recorded(result))
    maps = [(header, columns) for header, columns in frames if header["kind"] == "map"]
    assert [header["origin"] for header, _ in maps] == [pytest.approx([-1.0, 2.0, 0.2])] * 4
    assert [columns["cells"].tolist() for _, columns in maps] == [[k] * 6 for k in (5, 15, 25, 35)]
    goals = [columns for header, columns in frames if header["kind"] == "goals"]
    assert [dict(zip(one["robot"].tolist(), one["x"].tolist(), strict=True)) for one in goals] == [
        {0: 5.0},
        {0: 15.0},
        {0: 15.0, 1: 25.0},
        {0: 35.0, 1: 25.0},
    ]


def frames_of(text: str) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    data = gzip.decompress(base64.b64decode(text))
    at = 4 + struct.unpack_from("<I", data)[0]
    json.loads(data[4:at])
    frames = []
    while at < len(data):
        header, columns = unpack(data[at:])
        frames.append((header, columns))
        header_end = 4 + struct.unpack_from("<I", data, at)[0]
        at += header_end + sum(-(-one.nbytes // 8) * 8 for one in columns.values())
    return frames
