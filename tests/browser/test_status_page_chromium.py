"""The status page in a real browser, where there is one: it draws, writes its numbers, and complains of nothing."""

import base64
import json
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from websockets.sync.client import ClientConnection, connect

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.grid_view import GridView, GridViews
from kiteline_basestation.grid.kept_scan import keep
from kiteline_basestation.grid.scan_grid import ScanGrid
from kiteline_basestation.web.server import serve
from kiteline_basestation.web.snapshot import AgentStatus, PageSnapshot
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from tests.basestation.flat_rooms import box, camera, scan_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")


class Browser:
    """A page of a headless Chromium, driven by its DevTools protocol."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._number = 0
        self.complaints: list[str] = []

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(20))
            if message.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.complaints.append(json.dumps(message["params"])[:400])
            if message.get("id") == self._number:
                assert "error" not in message, message
                found: dict[str, Any] = message["result"]
                return found

    def text(self, script: str) -> str:
        return str(self.call("Runtime.evaluate", expression=script)["result"].get("value"))

    def wait(self, script: str, wanted: str) -> None:
        deadline = time.monotonic() + 20
        while self.text(script) != wanted:
            assert time.monotonic() < deadline, f"{script}: {self.text(script)!r} is not {wanted!r}; {self.complaints}"
            time.sleep(0.1)

    def shot(self) -> np.ndarray:
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return np.asarray(image)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    assert CHROMIUM is not None
    command = [
        CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars",
        "--remote-debugging-port=0", f"--user-data-dir={tmp_path}", "--window-size=1360,820", "about:blank",
    ]  # fmt: skip
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        port = next(m[1] for line in process.stderr if (m := re.search(r"listening on ws://[^:]+:(\d+)/", line)))
        page = next(
            t for t in _targets(int(port)) if t["type"] == "page"
        )  # the port speaks before the first page is there
        with connect(page["webSocketDebuggerUrl"], max_size=None) as socket:
            found = Browser(socket)
            for domain in ("Page", "Runtime", "Log"):
                found.call(f"{domain}.enable")
            yield found
    finally:
        process.terminate()
        process.communicate(timeout=20)


def _targets(port: int) -> Iterator[dict[str, Any]]:
    import urllib.request

    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=5) as answer:
            yield from json.load(answer)
        time.sleep(0.1)


def room() -> PageSnapshot:
    """Two agents in a room: one flies, the other has been silent for half a minute."""
    rng = np.random.default_rng(4)
    floor = np.column_stack([rng.uniform([0, 0], [9, 6], (1500, 2)), rng.normal(0, 0.01, 1500)])
    along, side = rng.uniform(0, 1, 1500), np.arange(1500) % 4
    x, y = np.choose(side, [9 * along, 9 * along, 0, 9]), np.choose(side, [0, 6, 6 * along, 6 * along])
    points = np.concatenate([floor, np.column_stack([x, y, rng.uniform(0.2, 1.8, 1500)])])
    turn = np.linspace(0, 5.0, 60)
    path = np.column_stack([4.5 + 3.2 * np.cos(turn), 3 + 1.9 * np.sin(turn), np.full(60, 1.0)])
    grid = ScanGrid(GridConfig())
    walls = np.array(box(0.0, 0.0, 9.0, 6.0))
    for k, ((px, py, _), heading) in enumerate(zip(path, turn + np.pi / 2, strict=True)):
        kept = keep(grid.config, scan_of(walls, px, py, heading), 100.0)
        assert kept is not None
        grid.put(k, kept, camera(px, py, heading))
    labels = np.repeat(np.array([1, 2], np.uint8), 1500)
    view = GridViews(grid).take()
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # a camera that looks along x
    pose = se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, turn[-1] + np.pi / 2])) @ level, path[-1])
    away = np.eye(4)
    away[:3, 3] = [2.0, 4.5, 1.0]
    s = 10**9
    agents = (
        AgentStatus(AgentId(0), 999 * s, 86, pose, path, 60, 2100, 1, 410_000, 52_000),
        AgentStatus(AgentId(1), 968 * s, -1, away, path[:9] * 0.5 + [1, 3, 0.5], 9, 380, 2, 61_000, 8_000),
    )
    return PageSnapshot(1000 * s, 246 * s, agents, points, labels, view, 1, {"loops": 2, "merges": 1})


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_draws_the_map_and_writes_the_numbers(browser: Browser, tmp_path: Path, scheme: str) -> None:
    now = room()
    tick = 0

    def snapshot() -> PageSnapshot:
        nonlocal tick
        tick += 1
        agents = (replace(now.agents[0], bytes_up=410_000 + 1500 * tick), *now.agents[1:])
        return replace(now, agents=agents, now_ns=now.now_ns + tick * 500_000_000, started_ns=tick * 500_000_000)

    handle = serve("127.0.0.1", 0, snapshot)
    try:
        browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        browser.call("Page.navigate", url=handle.url)
        browser.wait("document.querySelectorAll('article').length", "2")
        browser.wait("document.querySelector('#totals [data-label=Landmarks]').textContent", "2,480")
        browser.wait("document.querySelector('article .quality .value').textContent", "86 %")
        browser.wait("document.querySelectorAll('article .traffic dd')[0].textContent", "3.0 kB/s")
        browser.wait("getComputedStyle(document.getElementById('empty')).display", "none")
        browser.wait("document.querySelector('article .curve').getAttribute('d') !== null", "True")
        image = browser.shot()
        cv2.imwrite(str(tmp_path / f"page-{scheme}.png"), image)
        canvas = image[70:-20, 20:1000]
        assert len(np.unique(canvas.reshape(-1, 3), axis=0)) > 30  # grid, points, paths: not an empty field
        assert (float(image[:40].mean()) > 128) == (scheme == "light")
        assert browser.complaints == []
    finally:
        handle.close()
    browser.wait("document.getElementById('state').textContent", "no connection to the base")


def test_what_is_old_is_shown_as_old_and_another_base_starts_afresh(browser: Browser) -> None:
    """Agents of a base that was gone stayed "live", and beside those of the next one."""
    now = room()
    handle = serve("127.0.0.1", 0, lambda: now)
    browser.call("Page.navigate", url=handle.url)
    browser.wait("document.querySelectorAll('article').length", "2")
    browser.wait("document.body.classList.contains('stale')", "False")
    port = int(handle.url.rsplit(":", 1)[1].rstrip("/"))
    handle.close()
    browser.wait("document.body.classList.contains('stale')", "True")
    browser.wait("/ (1|2|3) s old/.test(document.getElementById('since').textContent)", "True")
    other = replace(now, agents=now.agents[1:], now_ns=now.started_ns + 10**9)
    handle = serve("127.0.0.1", port, lambda: other)
    try:
        browser.wait("document.body.classList.contains('stale')", "False")
        browser.wait("[...document.querySelectorAll('article .name')].map(n => n.textContent).join()", "Agent 1")
        other = replace(other, agents=())
        browser.wait("document.querySelectorAll('article').length", "0")
        browser.wait("document.getElementById('none').hidden", "False")
    finally:
        handle.close()


def test_units_places_and_troubles_are_written(browser: Browser) -> None:
    now = room()
    first, second = now.agents
    failed = replace(second, agent=AgentId(5), last_packet_ns=now.now_ns, path=second.path[:0])
    now = replace(
        now, agents=(replace(first, own_unit=True), replace(second, T_w_c=None, path=second.path[:0]), failed),
        troubles=("store maps: not written: the disk is full",), own_unit=True, grid=replace(now.grid, others=1),
    )  # fmt: skip
    handle = serve("127.0.0.1", 0, lambda: now)
    try:
        browser.call("Page.navigate", url=handle.url)
        browser.wait("document.querySelectorAll('article').length", "3")
        browser.wait("document.getElementById('troubles').innerText", "store maps: not written: the disk is full")
        browser.wait("[...document.querySelectorAll('.pose dt')].map(n => n.textContent).slice(0, 5).join()",
                     "x,y,z,heading,x, m")  # fmt: skip
        browser.wait("document.getElementById('storeys').innerText", "grid: the main one of 2 storeys")
        browser.wait("document.querySelectorAll('.note')[0].textContent.startsWith('Own unit of length')", "True")
        browser.wait("document.querySelectorAll('.note')[1].textContent.startsWith('Not placed')", "True")
        browser.wait("document.querySelectorAll('.note')[2].textContent", "Tracking failed: the position is a guess.")
        browser.wait("document.querySelectorAll('.quality .value')[2].clientHeight"
                     " === document.querySelectorAll('.quality .value')[0].clientHeight", "True")  # fmt: skip
        now = replace(now, agents=now.agents[1:], points=now.points[:0], labels=now.labels[:0], grid=GridView(0.05),
                      map_revision=2)  # fmt: skip
        browser.wait("document.getElementById('empty').innerText", "No map has a place in the world yet")
        now = replace(now, agents=(), troubles=())
        browser.wait("document.getElementById('troubles').hidden", "True")
        browser.wait("document.getElementById('empty').innerText", "Waiting for the first keyframe")
    finally:
        handle.close()


def test_keyboard_and_screen_reader(browser: Browser) -> None:
    now = room()
    tick = 0

    def snapshot() -> PageSnapshot:
        nonlocal tick
        tick += 1
        return replace(now, now_ns=now.now_ns + tick * 10**9)

    handle = serve("127.0.0.1", 0, snapshot)
    try:
        browser.call("Page.navigate", url=handle.url)
        browser.wait("document.querySelectorAll('article').length", "2")
        browser.text("""
            window.said = 0;
            for (const live of document.querySelectorAll("[role=status], [role=alert], output"))
                new MutationObserver(() => { said += 1; })
                    .observe(live, {childList: true, characterData: true, subtree: true});""")
        before = browser.text("document.getElementById('since').textContent")
        browser.wait(f"document.getElementById('since').textContent !== {before!r}", "True")
        assert browser.text("said") == "0"  # the time that the base runs is not read out twice a second
        browser.text("document.querySelectorAll('.name')[1].focus()")
        for kind in ("keyDown", "keyUp"):
            browser.call("Input.dispatchKeyEvent", type=kind, key="Enter", windowsVirtualKeyCode=13, text="\r")
        browser.wait("[...document.querySelectorAll('.name')].map(n => n.ariaPressed).join()", "false,true")
        browser.text("document.getElementById('fit').click()")
        browser.wait("[...document.querySelectorAll('.name')].map(n => n.ariaPressed).join()", "false,false")
        assert browser.text("document.activeElement === document.querySelectorAll('.name')[1]") == "True"
        assert browser.complaints == []
    finally:
        handle.close()


@pytest.mark.parametrize(("width", "height"), [(390, 844), (740, 360), (1000, 700), (1360, 820)])
def test_nothing_overlaps(browser: Browser, width: int, height: int) -> None:
    """On a phone the legend lay over the map; on its side the map left nothing to scroll by."""
    now = room()
    handle = serve("127.0.0.1", 0, lambda: now)
    try:
        browser.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=True)
        browser.call("Page.navigate", url=handle.url)
        browser.wait("document.querySelectorAll('article').length", "2")
        browser.text("document.getElementById('where').textContent = '-12.34, -56.78 m'")
        overlapping = """
            const boxes = ['tools', 'legend', 'where'].map((id) => document.getElementById(id).getBoundingClientRect());
            boxes.some((a, i) => boxes.slice(i + 1).some((b) =>
                a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom))"""
        assert (
            browser.text("(() => {" + overlapping.replace("boxes.some((a, i)", "return boxes.some((a, i)") + "})()")
            == "False"
        )
        browser.text("document.getElementById('state').textContent = 'no connection to the base'")
        browser.text("document.getElementById('since').textContent = '· data 23 min 12 s old'")
        for wide in ("#link", "header", "main", ".quality .value"):
            right = f"document.querySelector('{wide}').getBoundingClientRect().right"
            assert browser.text(f"{right} <= innerWidth") == "True", wide
        assert browser.text("document.documentElement.scrollWidth <= innerWidth") == "True"
        lowest = "document.getElementById('canvas').getBoundingClientRect().bottom"
        assert width > 820 or browser.text(f"{lowest} < innerHeight - 40") == "True"
    finally:
        handle.close()
