"""The status page's server: static files, /status.json and a websocket, in a thread of its own.

It listens on the loopback address by default, serves only the files beside this module, and refuses pages of other
sites (Origin) and names that are not this machine's (Host): whoever owns one can let it lead here, and read the page
in a visitor's browser (DNS rebinding). An address cannot be taken so. Who only opens connections takes up neither files
of the process nor the places of viewers.
"""

import asyncio
import ipaddress
import json
import logging
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.asyncio.server import serve as websocket_serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from kiteline_basestation.grid.grid_view import GridView, differences
from kiteline_basestation.web.messages import map_messages, status, tiles_message
from kiteline_basestation.web.snapshot import PageSnapshot

STATUS_PERIOD_S = 0.5  # s between two status messages: numbers that change faster cannot be read
MAP_PERIOD_S = 1.0  # s between two maps at least: they are a hundred times larger
RATE_SPAN_S = 2.0  # s over which byte rates are taken: two heartbeats
MAX_VIEWERS = 16  # browsers at a time; each costs up to 100 kB/s
MAX_UNANSWERED = 64  # connections without an answer yet; of more the oldest is closed, as each takes a file of the base
TILES_A_MESSAGE = 64  # tiles of 4 kB
LIVE_PATH = "/live"

_FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/map_canvas.js": ("map_canvas.js", "text/javascript; charset=utf-8"),
}
_POLICY = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; base-uri 'none'"


def address(text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, or of :PORT and PORT on loopback. Raises ValueError."""
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        raise ValueError(f"{text!r} is no address: expected HOST:PORT, such as 127.0.0.1:8080")
    return host.strip("[]") or "127.0.0.1", int(port)


class Handle:
    """A running server."""

    def __init__(self, page: "_Page", thread: threading.Thread, url: str) -> None:
        self._page = page
        self._thread = thread
        self.url = url

    def close(self) -> None:
        """Close all connections and wait until the thread ends. May be called twice."""
        self._page.stop()
        self._thread.join(5.0)


def serve(host: str, port: int, snapshot: Callable[[], PageSnapshot]) -> Handle:
    """Serve the page until close(). Port 0: a free one, see Handle.url. Raises OSError if it cannot listen."""
    page = _Page(snapshot)
    thread = threading.Thread(target=page.run, args=(host, port), name="kiteline-web", daemon=True)
    thread.start()
    page.started.wait()
    if page.error is not None:
        thread.join()
        raise OSError(page.error.errno, page.error.strerror or str(page.error), f"{host}:{port}")
    shown = f"[{host}]" if ":" in host else host
    return Handle(page, thread, f"http://{shown}:{page.port}/")


class _Connection(ServerConnection):
    """A connection to the page. unanswered: all those without an answer yet, of this page, in order of arrival."""

    def __init__(self, unanswered: "dict[_Connection, None]", *args: Any, **options: Any) -> None:
        self._unanswered = unanswered
        super().__init__(*args, **options)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the place of the oldest one if there are too many."""
        super().connection_made(transport)
        self._unanswered[self] = None
        if len(self._unanswered) > MAX_UNANSWERED:
            oldest = next(iter(self._unanswered))
            oldest.was_answered()
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave the place to others."""
        self.was_answered()
        super().connection_lost(exc)

    def was_answered(self) -> None:
        """Count no more among those without an answer. May be called twice."""
        self._unanswered.pop(self, None)


class _Page:
    def __init__(self, snapshot: Callable[[], PageSnapshot]) -> None:
        self.started = threading.Event()
        self.error: OSError | None = None
        self.port = 0
        self._snapshot = snapshot
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end: asyncio.Event | None = None
        self._local = True
        self._names: frozenset[str] = frozenset()  # by which this machine is called
        self._viewers = 0
        self._recent: list[tuple[float, PageSnapshot]] = []  # the last RATE_SPAN_S of snapshots, shared by all viewers

    def run(self, host: str, port: int) -> None:
        """The thread."""
        asyncio.run(self._serve(host, port))

    def stop(self) -> None:
        loop, end = self._loop, self._end
        if loop is not None and end is not None and not loop.is_closed():
            loop.call_soon_threadsafe(end.set)

    async def _serve(self, host: str, port: int) -> None:
        self._loop = asyncio.get_running_loop()
        self._end = asyncio.Event()
        self._local = host == "localhost" or _is_loopback(host)
        own = socket.gethostname().lower()
        self._names = frozenset({"localhost"} if self._local else {"localhost", own, f"{own}.local", host.lower()})
        log = logging.Logger("kiteline.web", logging.CRITICAL)  # no traceback for a port scan
        self._loop.set_exception_handler(lambda loop, context: None)  # nor one a connection, where files are used up
        connection: Any = partial(_Connection, {})
        try:
            server = await websocket_serve(
                self._view, host, port, process_request=self._answer, compression=None, max_size=1024, logger=log,
                close_timeout=1.0, create_connection=connection,
            )  # fmt: skip
        except OSError as e:
            self.error = e
            self.started.set()
            return
        async with server:
            self.port = server.sockets[0].getsockname()[1]
            self.started.set()
            await self._end.wait()

    # -- HTTP --------------------------------------------------------------------------------------------------------

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        host = request.headers.get("Host", "")
        name = host.rsplit(":", 1)[0].strip("[]") if not host.endswith("]") else host.strip("[]")
        if not (name.lower() in self._names or (_is_loopback(name) if self._local else _is_address(name))):
            names = f"its address, or to {' or '.join(sorted(self._names))}"
            text = f"this page answers to {'localhost' if self._local else names} only\n"
            return _response(HTTPStatus.FORBIDDEN, text.encode())
        path = request.path.split("?", 1)[0]
        if path == LIVE_PATH:
            origin = request.headers.get("Origin")
            if origin is not None and origin.partition("://")[2] != host:
                return _response(HTTPStatus.FORBIDDEN, b"pages of other sites are refused\n")
            if self._viewers >= MAX_VIEWERS:
                return _response(HTTPStatus.SERVICE_UNAVAILABLE, b"too many viewers\n")
            return None
        if path == "/status.json":
            now, before = self._snapshots()
            return _response(HTTPStatus.OK, _json(now, before), "application/json")
        if path in _FILES:
            name, kind = _FILES[path]
            return _response(HTTPStatus.OK, (Path(__file__).parent / name).read_bytes(), kind)
        return _response(HTTPStatus.NOT_FOUND, b"nothing here; the page is at /\n")

    # -- websocket ---------------------------------------------------------------------------------------------------

    async def _view(self, viewer: ServerConnection) -> None:
        if isinstance(viewer, _Connection):
            viewer.was_answered()
        self._viewers += 1
        try:
            await self._show(viewer)
        except ConnectionClosed:
            pass
        finally:
            self._viewers -= 1
            if self._viewers == 0:
                self._recent.clear()

    async def _show(self, viewer: ServerConnection) -> None:
        revision: tuple[int, int] | None = None
        held = GridView(1.0)
        map_s = -MAP_PERIOD_S
        while True:
            now, before = self._snapshots()
            await viewer.send(_json(now, before).decode())
            changed = (now.map_revision, now.layout) != revision or now.grid is not held
            if changed and time.monotonic() - map_s >= MAP_PERIOD_S:
                revision, map_s = (now.map_revision, now.layout), time.monotonic()
                for message in map_messages(now):
                    await viewer.send(message)
                async for message in self._tiles(held, now.grid):
                    await viewer.send(message)
                held = now.grid
            try:
                async with asyncio.timeout(STATUS_PERIOD_S):
                    await viewer.recv()  # a page sends nothing; this notices when it closes
                    await asyncio.sleep(STATUS_PERIOD_S)
            except TimeoutError:
                pass

    @staticmethod
    async def _tiles(held: GridView, now: GridView) -> AsyncIterator[bytes]:
        """Messages of the changed tiles; between two of them other viewers have their turn."""
        places = differences(held, now)
        for k in range(0, len(places), TILES_A_MESSAGE):
            yield tiles_message(now, places[k : k + TILES_A_MESSAGE])
            await asyncio.sleep(0)

    def _snapshots(self) -> tuple[PageSnapshot, PageSnapshot | None]:
        """The newest snapshot, taken at most twice a period for all viewers, and an older one for rates."""
        now_s = time.monotonic()
        if not self._recent or now_s - self._recent[-1][0] >= 0.5 * STATUS_PERIOD_S:
            self._recent.append((now_s, self._snapshot()))
        while len(self._recent) > 2 and now_s - self._recent[1][0] > RATE_SPAN_S:
            self._recent.pop(0)
        return self._recent[-1][1], self._recent[0][1] if len(self._recent) > 1 else None


def _is_loopback(host: str) -> bool:
    return _is_address(host) and ipaddress.ip_address(host).is_loopback


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _json(now: PageSnapshot, before: PageSnapshot | None) -> bytes:
    return json.dumps(status(now, before), separators=(",", ":"), allow_nan=False).encode()


def _response(code: HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8") -> Response:
    headers = Headers()
    headers["Content-Type"] = kind
    headers["Content-Length"] = str(len(body))
    headers["Cache-Control"] = "no-cache"
    headers["Content-Security-Policy"] = _POLICY
    headers["X-Content-Type-Options"] = "nosniff"
    headers["Connection"] = "close"
    return Response(code.value, code.phrase, headers, body)
