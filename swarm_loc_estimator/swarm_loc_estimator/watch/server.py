"""The server of the page, in a thread of its own: HTML once, then frames over a WebSocket, and commands back.

Passing a frame to the server never blocks, however many or slow the pages are. Browsers of this machine have
access, other clients only with the token.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import json
import logging
import re
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from aiohttp import WSMsgType, web

from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.watch.page import Frame, History, content_security_policy, page

MIN_TOKEN_LENGTH = 8
GUESS_PERIOD_S = 1.0  # After its free guesses a client may send one wrong token per such period [s]
_FREE_GUESSES = 5
MIN_DISTINCT = 5  # Least number of different characters of a token
_BLOCKS = (1, 2, 3, 4), (4, 6, 8, 16)  # Bytes of blocks of IPv4 and IPv6 addresses, from wide to narrow
_SHARES = (8, 8, 16, 256)  # Numbers of parts into which the slots of each such block are divided
_LOCAL_NAMES = {"localhost", "127.0.0.1", "::1"}
_HOST = re.compile(r"(?:\[(?P<v6>[0-9a-f:.]+)\]|(?P<name>[0-9a-z._-]+))(?::[0-9]{1,5})?", re.ASCII)
_WRONG = "The token is missing or wrong: open the address that the log shows, with ?token=."


class AccessError(UserError):
    """An address or a token that cannot be used."""


class WrongTokens:
    """Limits the rate at which clients guess the token.

    Its memory is bounded: addresses share slots by hash, but a block, such as one network's, has only a share
    of those of the wider block: many addresses lock out few others. A repeated token is no guess, so that a
    page which reconnects with an old one does not lock out clients of the same slot.
    """

    def __init__(self) -> None:
        self._slots: dict[int, _Slot] = {}

    def refusal(self, client: str, given: str, token: str) -> str:
        """Reason to refuse what a client gave as token, "" for none, one sentence; "" if it is right."""
        place, guess = _place(client), hash((client, given))
        slot, now_s = self._slots.get(place, _Slot(0.0, 0)), time.monotonic()
        if not given or guess == slot.guess:
            return _WRONG
        if slot.clear_s > now_s + (_FREE_GUESSES - 1) * GUESS_PERIOD_S:
            return f"Too many wrong tokens came from this address: wait {GUESS_PERIOD_S:g} s and try again."
        if hmac.compare_digest(given.encode(errors="replace"), token.encode()):
            return ""
        self._slots[place] = _Slot(max(slot.clear_s, now_s) + GUESS_PERIOD_S, guess)
        return _WRONG


def _place(client: str) -> int:
    """Index of the slot of an IP address; other names are taken for addresses."""
    try:
        address = ipaddress.ip_address(client)
        data = (getattr(address, "ipv4_mapped", None) or address).packed
    except ValueError:
        data = client.encode(errors="replace")
    place = 0
    for length, parts in zip(_BLOCKS[len(data) > 4], _SHARES, strict=True):
        place = place * parts + hash(data[:length]) % parts
    return place


class _Slot(NamedTuple):
    """State of the clients of one slot."""

    clear_s: float  # Time at which their wrong tokens expire [s, monotonic]
    guess: int  # Hash of the last wrong token


@dataclass(frozen=True)
class Access:
    """Decides which requests the server accepts; without a token, only on a loopback address.

    Raises AccessError if the address is reachable from outside without a token, or the token is too short.
    """

    address: str
    token: str = ""
    _wrong_tokens: WrongTokens = field(default_factory=WrongTokens, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.token and not is_loopback(self.address):
            remedy = "set the parameter token, which their browsers must then give as ?token="
            raise AccessError(f"parameter address = '{self.address}' can be reached by others: {remedy}.")
        if self.token and (len(self.token) < MIN_TOKEN_LENGTH or len(set(self.token)) < MIN_DISTINCT):
            need = f"{MIN_TOKEN_LENGTH} characters or more, of which {MIN_DISTINCT} differ"
            raise AccessError(f"parameter token is too weak: it needs {need}.")

    def refusal(self, host: str, origin: str | None, token: str, client: str = "") -> str:
        """Reason to refuse a request by its headers Host and Origin and its ?token=; "" if it is accepted.

        Checks of Origin, which browsers send with a WebSocket, and Host prevent cross-site requests of the
        browser, and DNS rebinding.
        """
        parsed = _HOST.fullmatch(host.lower())
        if not parsed:
            return "The Host header is not a host name with an optional port."
        name = parsed["v6"] or parsed["name"]
        if not self.token and name not in {*_LOCAL_NAMES, self.address}:
            return f"The name '{name}' is not one of this machine's own."
        if origin is not None and origin.lower() not in {f"http://{host}".lower(), f"https://{host}".lower()}:
            return f"Pages of {origin!a} may not use this server."
        return self._wrong_tokens.refusal(client, token, self.token) if self.token else ""


def is_loopback(address: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def free_port() -> int:
    """A port of this machine that is free at present."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


MAX_VIEWERS = 32
_MAX_COMMAND_BYTES = 4096
_SEND_BUFFER_BYTES = 262144
_HEARTBEAT_S = 10.0
_START_PATIENCE_S = 10.0
REQUEST_PATIENCE_S = 10.0  # Timeout after which a connection that is not a page's WebSocket is closed
_SWEEP_PERIOD_S = 1.0
_LOG_PERIOD_S = 1.0

Command = Mapping[str, Any]
MAX_NOTES = 64  # Maximum number of texts queued for a slow page; the oldest are dropped first
RECEIVED = "+"  # Acknowledgement of a frame by a page
_MAX_ON_THE_WAY = 4  # Unacknowledged frames; more would only age in the buffers of a busy page


class Answer(Protocol):
    """Receives the answer to a command; may be called from any thread."""

    def __call__(self, said: str, *, ok: bool = True) -> None:
        """One sentence, and whether the command was obeyed."""


Connection = web.RequestHandler
OnCommand = Callable[[Command, Answer], None]  # Receives a page's command; called in the server's thread


class ServerError(UserError):
    """The server cannot listen."""


class ServerLoad(NamedTuple):
    """Load of the server."""

    pages: int  # Number of open pages
    slow: int  # Number of these for which frames were dropped since the last report
    left_out: int  # Total number of frames dropped because pages were busy with older ones
    texts_left_out: int  # Total number of texts dropped for the same reason
    refused: int  # Total number of refused requests


class _OneLine(logging.Filter):
    """Passes one record a second, without its traceback: others decide how many requests cannot be read."""

    _next_s = 0.0

    def filter(self, record: logging.LogRecord) -> bool:
        now_s = time.monotonic()
        if now_s < self._next_s:
            return False
        self._next_s = now_s + _LOG_PERIOD_S
        reason = record.exc_info[1] if record.exc_info else ""
        record.msg, record.args, record.exc_info = f"{record.getMessage()} {reason!r:.200}", (), None
        return True


_LOG = logging.getLogger(__name__)
_LOG.addFilter(_OneLine())


class WatchServer:
    """Serves the page, with at most `rate` frames of a kind per second to each; port 0 is any free one.

    Raises ServerError if the port is taken, or the address is not this machine's.
    """

    def __init__(
        self, about: dict[str, Any], access: Access, port: int, rate: float, on_command: OnCommand
    ) -> None:
        self._about = about
        self._access = access
        self._rate = rate
        self._on_command = on_command
        self._history = History()
        self._viewers: set[Viewer] = set()
        self._sockets: set[Connection] = set()
        self._gone = Counter[str]()  # Dropped messages of closed pages
        self._refused = 0
        self._known_left_out: dict[int, int] = {}
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(
            lambda _, about: _LOG.error(about["message"], exc_info=about.get("exception"))
        )
        application = web.Application()
        application.router.add_get("/", self._on_page)
        application.router.add_get("/socket", self._on_socket)
        application.on_shutdown.append(self._close_all)
        self._runner = web.AppRunner(application, access_log=None, shutdown_timeout=1.0, logger=_LOG)
        self._listening = threading.Event()
        self._faults: list[OSError] = []
        self._thread = threading.Thread(target=self._run, args=(port,), name="watch_server", daemon=True)
        self._thread.start()
        self._listening.wait(_START_PATIENCE_S)
        for fault in self._faults:
            self._thread.join()
            reason = fault.strerror or fault
            raise ServerError(f"parameter port = {port}: {access.address} cannot be listened on: {reason}.")
        self.port: int = self._runner.addresses[0][1]

    @property
    def url(self) -> str:
        """URL of the page."""
        host = self._access.address if is_loopback(self._access.address) else socket.gethostname()
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/" + (f"?token={self._access.token}" if self._access.token else "")

    @property
    def has_viewers(self) -> bool:
        """Whether any page is open."""
        return bool(self._viewers)

    @property
    def selected(self) -> set[int]:
        """Indices of the robots whose numbers are shown."""
        return {viewer.selected for viewer in tuple(self._viewers)} - {-1}

    def load(self) -> ServerLoad:
        """The present load; `slow` counts since the last call."""
        counts = {id(viewer): viewer.left_out for viewer in tuple(self._viewers)}
        slow = sum(count["frames"] > self._known_left_out.get(key, 0) for key, count in counts.items())
        self._known_left_out = {key: count["frames"] for key, count in counts.items()}
        left_out = (self._gone, *counts.values())
        frames, texts = (sum(one[kind] for one in left_out) for kind in ("frames", "texts"))
        return ServerLoad(len(counts), slow, frames, texts, self._refused)

    def publish(self, frame: Frame) -> None:
        """Send a frame to the pages; may be called from any thread."""
        self._loop.call_soon_threadsafe(self._take, frame)

    def send_text(self, message: dict[str, Any], robot: int | None = None) -> None:
        """Send a message to the pages, or to those that show a robot; may be called from any thread."""
        self._loop.call_soon_threadsafe(self._note, message, robot)

    def close(self) -> None:
        """Stop the server and close all connections."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()

    def _take(self, frame: Frame) -> None:
        if self._history.add(frame):
            self._note({"kind": "reset"}, None)
        for viewer in self._viewers:
            viewer.offer(frame)

    def _note(self, message: dict[str, Any], robot: int | None) -> None:
        for viewer in self._viewers:
            if robot is None or viewer.selected == robot:
                viewer.note(message)

    def _run(self, port: int) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._runner.setup())
            self._loop.run_until_complete(web.TCPSite(self._runner, self._access.address, port).start())
            self._listening.set()
            self._close_slow_requests({})
            self._loop.run_forever()
        except OSError as error:
            self._faults.append(error)
        finally:
            self._loop.run_until_complete(self._runner.cleanup())
            self._loop.run_until_complete(self._loop.shutdown_asyncgens())
            self._loop.close()
            self._listening.set()

    def _close_slow_requests(self, known: Mapping[Connection, float]) -> None:
        """Close connections that have not become a WebSocket in time, now and once a second.

        `known` are pending connections, and when each was first seen [s].
        """
        now_s = self._loop.time()
        connections = self._runner.server.connections if self._runner.server else []
        waiting = {one: known.get(one, now_s) for one in connections if one not in self._sockets}
        for connection, since_s in waiting.items():
            if now_s >= since_s + REQUEST_PATIENCE_S and connection.transport:
                connection.transport.abort()
        self._loop.call_later(_SWEEP_PERIOD_S, self._close_slow_requests, waiting)

    def _check(self, request: web.Request) -> None:
        hosts, origins = (request.headers.getall(name, []) for name in ("Host", "Origin"))
        refusal = self._access.refusal(
            hosts[0] if len(hosts) == 1 else "",
            " and ".join(origins) if origins else None,
            request.query.get("token", ""),
            request.remote or "",
        )
        if refusal:
            self._refused += 1
            raise web.HTTPForbidden(text=refusal)

    async def _on_page(self, request: web.Request) -> web.Response:
        self._check(request)
        headers = {
            "Content-Security-Policy": content_security_policy(),
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
        return web.Response(text=page(), content_type="text/html", headers=headers)

    async def _on_socket(self, request: web.Request) -> web.WebSocketResponse:
        self._check(request)
        if len(self._viewers) >= MAX_VIEWERS:
            self._refused += 1
            raise web.HTTPServiceUnavailable(text=f"{MAX_VIEWERS} pages are open, which is the limit.")
        socket = web.WebSocketResponse(
            heartbeat=_HEARTBEAT_S, max_msg_size=_MAX_COMMAND_BYTES, writer_limit=_SEND_BUFFER_BYTES
        )
        await socket.prepare(request)
        viewer = Viewer(socket, self._rate)
        past = self._history.frames()
        self._viewers.add(viewer)
        self._sockets.add(request.protocol)
        sending = asyncio.ensure_future(self._send(socket, viewer, past))
        try:
            async for message in socket:
                if message.type == WSMsgType.TEXT:
                    self._on_text(viewer, message.data)
        finally:
            self._viewers.discard(viewer)
            self._sockets.discard(request.protocol)
            self._gone += viewer.left_out
            sending.cancel()
        return socket

    async def _send(self, socket: web.WebSocketResponse, viewer: Viewer, past: list[Frame]) -> None:
        """Send everything to a page until its connection breaks, which also ends its reader."""
        try:
            await socket.send_str(json.dumps(self._about))
            await viewer.send_past(past)
            await viewer.keep_sending()
        except ConnectionError:
            await socket.close()

    def _on_text(self, viewer: Viewer, text: str) -> None:
        if text == RECEIVED:
            viewer.on_received()
            return

        def answer(said: str, *, ok: bool = True) -> None:
            self._loop.call_soon_threadsafe(viewer.note, {"kind": "said", "text": said, "ok": ok})

        command = read_command(text)
        if command is None:
            answer("The page's command cannot be read.", ok=False)
        elif not -1 <= command["robot"] < len(self._about["names"]):
            answer(f"There is no robot number {command['robot']}.", ok=False)
        elif command["do"] == "select":
            viewer.selected = command["robot"]
        else:
            self._on_command(command, answer)

    async def _close_all(self, _application: web.Application) -> None:
        """Close the connections, which notifies the pages."""
        for viewer in tuple(self._viewers):
            await viewer.close()


def read_command(text: str) -> Command | None:
    """A command with the text `do` and the integer `robot`, -1 by default; None if invalid."""
    try:
        command = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(command, dict):
        return None
    command.setdefault("robot", -1)
    is_valid = isinstance(command.get("do"), str) and type(command["robot"]) is int
    return command if is_valid else None


class Viewer:
    """Sends to one page; a slow page gets fewer frames, and its queues are bounded."""

    def __init__(self, socket: web.WebSocketResponse, rate: float) -> None:
        self._socket = socket
        self._period_s = 1.0 / rate
        self._newest: dict[str, Frame] = {}
        self._notes: deque[str] = deque(maxlen=MAX_NOTES)
        self._wake = asyncio.Event()
        self._on_the_way = 0
        self.selected = -1  # Index of the robot whose numbers the page shows; -1: none
        # Frames replaced by newer ones while the page was busy, and texts dropped from the full queue
        self.left_out = Counter[str]()

    def offer(self, frame: Frame) -> None:
        """Queue a frame, replacing an older one of its kind."""
        if frame.kind in self._newest and self._on_the_way >= _MAX_ON_THE_WAY:
            self.left_out["frames"] += 1
        self._newest[frame.kind] = frame
        self._wake.set()

    def note(self, message: dict[str, Any]) -> None:
        """Queue a text."""
        if len(self._notes) == MAX_NOTES:
            self.left_out["texts"] += 1
        self._notes.append(json.dumps(message))
        self._wake.set()

    def on_received(self) -> None:
        """Handle the page's acknowledgement of a frame."""
        self._on_the_way -= 1
        self._wake.set()

    async def send_past(self, frames: Iterable[Frame]) -> None:
        """Send the history from before the page was opened."""
        for frame in frames:
            while self._on_the_way >= _MAX_ON_THE_WAY:
                self._wake.clear()
                await self._wake.wait()
            await self._send(frame)
        self._wake.set()

    async def keep_sending(self) -> None:
        """Send until the connection breaks."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            began_s = time.monotonic()
            while self._notes:
                await self._socket.send_str(self._notes.popleft())
            if self._on_the_way >= _MAX_ON_THE_WAY:
                continue  # the page's next text wakes this up
            frames, self._newest = self._newest, {}
            for frame in frames.values():
                await self._send(frame)
            if frames:
                await asyncio.sleep(max(0.0, began_s + self._period_s - time.monotonic()))

    async def _send(self, frame: Frame) -> None:
        self._on_the_way += 1
        await self._socket.send_bytes(frame.data)

    async def close(self) -> None:
        """End the connection."""
        await self._socket.close()
