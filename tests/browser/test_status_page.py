"""The status page over loopback: files, status, websocket, who may look, and that it costs nothing unseen."""

import http.client
import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from kiteline_basestation.grid.grid_view import CodedTile, GridView
from kiteline_basestation.grid.tile_store import Place
from kiteline_basestation.web.server import MAX_UNANSWERED, Handle, address, serve
from kiteline_basestation.web.snapshot import AgentStatus, PageSnapshot
from kiteline_codec.schema import GridTile, messages
from kiteline_core.ids import AgentId


class Base:
    """A base with one agent, whose snapshots are counted."""

    def __init__(self) -> None:
        self.taken = 0
        tile = GridTile(0, 0, 0, 0.1, np.full((64, 64), 3, np.int8))
        grid = GridView(0.1, 1, 0, {Place(0, 0, 0): CodedTile(messages.encode(tile), 4096)})
        agent = AgentStatus(AgentId(5), 9 * 10**9, 70, np.eye(4), np.zeros((2, 3)), 2, 9, 1, 100, 10)
        self.now = PageSnapshot(10**10, 0, (agent,), np.zeros((9, 3)), np.zeros(9, np.uint8), grid, 1)

    def snapshot(self) -> PageSnapshot:
        self.taken += 1
        return self.now


@pytest.fixture
def base() -> Base:
    return Base()


@pytest.fixture
def page(base: Base) -> Iterator[Handle]:
    handle = serve("127.0.0.1", 0, base.snapshot)
    yield handle
    handle.close()


def get(page: Handle, path: str, host: str | None = None) -> tuple[int, str, bytes]:
    at = page.url.removeprefix("http://").rstrip("/")
    connection = http.client.HTTPConnection(at, timeout=5)
    connection.request("GET", path, headers={"Host": host or at})
    answer = connection.getresponse()
    out = answer.status, answer.getheader("Content-Type", ""), answer.read()
    connection.close()
    return out


def live(page: Handle, **options: object) -> ClientConnection:
    return connect(page.url.replace("http", "ws") + "live", open_timeout=5, **options)  # type: ignore[arg-type]


def test_the_page_and_its_parts_are_served_and_nothing_else(page: Handle) -> None:
    code, kind, body = get(page, "/")
    assert code == 200 and kind.startswith("text/html") and b"<canvas" in body
    parts = [p for p in (b"/page.css", b"/page.js", b"/map_canvas.js") if p in body + get(page, "/page.js")[2]]
    assert len(parts) == 3
    for part in parts:
        assert get(page, part.decode())[0] == 200
    assert b"://" not in body.replace(b"http://www.w3.org/2000/svg", b"")  # nothing from other machines
    for path in ("/server.py", "/../messages.py", "/..%2fmessages.py", "/web/", "//etc/passwd"):
        assert get(page, path)[0] == 404


def test_status_as_json(page: Handle) -> None:
    code, kind, body = get(page, "/status.json")
    assert (code, kind) == (200, "application/json")
    found = json.loads(body)
    assert found["agents"][0]["agent"] == 5 and found["agents"][0]["link"] == "live"


def test_a_viewer_gets_status_and_map_then_only_what_is_new(page: Handle, base: Base) -> None:
    with live(page) as viewer:
        totals = {n["label"]: n["value"] for n in json.loads(viewer.recv(5))["totals"]}
        assert totals["Landmarks"] == sum(one.landmarks for one in base.now.agents) > 0
        kinds = [viewer.recv(5)[0] for _ in range(3)]  # type: ignore[index]
        assert kinds == [3, 1, 2]
        assert isinstance(viewer.recv(5), str)  # the map has not changed
        base.now = replace(base.now, points=np.zeros((4, 3)), labels=np.zeros(4, np.uint8), map_revision=2)
        maps: list[bytes] = []
        texts = 0
        while len(maps) < 2 or texts < 4:
            message = viewer.recv(5)
            if isinstance(message, bytes):
                maps.append(message)
            texts += isinstance(message, str)
        assert [m[0] for m in maps] == [3, 1]  # the same grid is not sent again
        assert struct.unpack_from("<I", maps[1], 4)[0] == 4


def test_nothing_is_computed_while_nobody_looks(page: Handle, base: Base) -> None:
    time.sleep(0.6)
    assert base.taken == 0
    with live(page) as viewer:
        viewer.recv(5)
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:  # it takes the server a moment to see that the viewer went
        before = base.taken
        time.sleep(0.7)
        if base.taken == before:
            break
    assert base.taken == before


def test_several_viewers_cost_one_snapshot(page: Handle, base: Base) -> None:
    with ExitStack() as stack:
        for viewer in [stack.enter_context(live(page)) for _ in range(4)]:
            viewer.recv(5)
        assert base.taken <= 2


def test_other_sites_and_bent_names_are_refused(page: Handle) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        live(page, origin="http://example.com")
    own = page.url.rstrip("/")
    with live(page, origin=own) as viewer:
        viewer.recv(5)
    assert get(page, "/", host="example.com")[0] == 403
    assert get(page, "/", host="localhost:80")[0] == 200


def test_on_all_interfaces_addresses_and_the_name_of_the_machine_are_answered_alone(base: Base) -> None:
    page = serve("0.0.0.0", 0, base.snapshot)
    try:
        own = socket.gethostname()
        for host in ("10.0.0.1:8080", "[fe80::1]", "[fe80::1]:8080", "localhost", own, f"{own.upper()}.local:8080"):
            assert get(page, "/", host=host)[0] == 200, host
        for host in ("example.com", "10.0.0.1.example.com:8080", f"{own}.example.com"):
            assert get(page, "/status.json", host=host)[0] == 403, host
        assert get(page, "/live", host="example.com")[0] == 403
    finally:
        page.close()


def test_noise_on_the_port_does_no_harm(page: Handle) -> None:
    port = int(page.url.rsplit(":", 1)[1].rstrip("/"))
    for noise in (b"\x00\xff" * 50, b"POST / HTTP/1.1\r\n\r\n", b"GET"):
        with socket.create_connection(("127.0.0.1", port), timeout=5) as s:
            s.sendall(noise)
    assert get(page, "/")[0] == 200


def test_connections_that_ask_nothing_take_up_no_files(page: Handle, capfd: pytest.CaptureFixture[str]) -> None:
    port = int(page.url.rsplit(":", 1)[1].rstrip("/"))
    with ExitStack() as opened:
        viewer = opened.enter_context(live(page))
        many = [opened.enter_context(socket.create_connection(("127.0.0.1", port), timeout=5)) for _ in range(300)]
        assert get(page, "/")[0] == 200
        deadline = time.monotonic() + 3.0
        while (n := sum(map(_is_open, many))) > MAX_UNANSWERED and time.monotonic() < deadline:
            time.sleep(0.05)
        assert n <= MAX_UNANSWERED
        viewer.recv(5)
    assert capfd.readouterr().err == ""


def _is_open(connection: socket.socket) -> bool:
    """True if the other side has not closed a connection that it sends nothing on."""
    connection.setblocking(False)
    try:
        return connection.recv(1) != b""
    except BlockingIOError:
        return True
    except ConnectionResetError:
        return False


def test_closing_ends_viewers_and_thread_and_may_be_repeated(base: Base) -> None:
    handle = serve("127.0.0.1", 0, base.snapshot)
    with live(handle) as viewer:
        viewer.recv(5)
        handle.close()
        handle.close()
    assert not any(t.name == "kiteline-web" for t in threading.enumerate())


def test_a_taken_port_is_an_error_that_names_it(page: Handle, base: Base) -> None:
    port = int(page.url.rsplit(":", 1)[1].rstrip("/"))
    with pytest.raises(OSError) as e:
        serve("127.0.0.1", port, base.snapshot)
    assert e.value.filename == f"127.0.0.1:{port}"


def test_addresses() -> None:
    assert address("0.0.0.0:8080") == ("0.0.0.0", 8080)
    assert address(":8080") == address("8080") == ("127.0.0.1", 8080)
    assert address("[::1]:80") == ("::1", 80)
    for bad in ("here", "a:b", "1.2.3.4:99999", ""):
        with pytest.raises(ValueError, match="expected HOST:PORT"):
            address(bad)
