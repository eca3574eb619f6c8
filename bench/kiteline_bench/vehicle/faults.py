"""Faults in the field: cameras and a flight controller unplugged and back, a line that carries garbage."""

import contextlib
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np

from kiteline_agent.runtime.flight_log import estimate_from_json
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.vehicle.agent_process import BACK, OUT, command, start
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.sim.autopilot import ModelledAutopilot

_CAMERA_S = "4,6"  # s after the warm start: without cameras from, to
_LINE_S, _AWAY_S, _GARBAGE_S, _LAST_S = 13.0, 6.0, 10.0, 6.0  # s until the controller goes, and of what follows
_START_S = 120.0


class _Line:
    """A modelled ArduPilot at a pseudo terminal that can vanish, or send garbage. path: where the agent finds it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.model = ModelledAutopilot("ardupilot")
        self.garbage = False
        self._ends: tuple[int, int] | None = None
        self._rng = np.random.default_rng(5)
        self._over = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self.plug()
        self._thread.start()

    def plug(self) -> None:
        master, slave = os.openpty()
        os.set_blocking(master, False)
        self._path.unlink(missing_ok=True)
        self._path.symlink_to(os.ttyname(slave))
        with self._lock:
            self._ends = master, slave

    def unplug(self) -> None:
        self._path.unlink(missing_ok=True)
        with self._lock:
            for end in self._ends or ():
                os.close(end)
            self._ends = None

    def _serve(self) -> None:
        while not self._over.wait(0.005):
            with self._lock, contextlib.suppress(OSError):
                if self._ends is None:
                    continue
                master, now_ns = self._ends[0], time.monotonic_ns()
                try:
                    data = os.read(master, 4096)
                except BlockingIOError:
                    data = b""
                if self.garbage:
                    os.write(master, self._rng.bytes(40))
                    continue
                for answer in self.model.receive(data, now_ns) + self.model.poll(now_ns):
                    os.write(master, answer)

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self.unplug()


def run(bench: Bench) -> list[Bar]:
    """One flight with all faults, one after the other."""
    bench.say("a flight with faults")
    folder = bench.folder / "faults"
    folder.mkdir(parents=True, exist_ok=True)
    text, device = folder / "agent.txt", folder / "ttyACM0"
    line = _Line(device)
    with contextlib.ExitStack() as stack:
        stack.callback(line.close)
        options = ["--mavlink", f"serial:{device}:921600", "--no-imu", "--axes", "urf", "--log", str(folder)]
        agent = start(stack, command(bench.source("room_flight.mcap"), _CAMERA_S, options), text)
        end_s = time.monotonic() + _START_S
        while BACK not in text.read_text() and agent.poll() is None and time.monotonic() < end_s:
            time.sleep(0.1)
        time.sleep(_LINE_S - _AWAY_S)
        line.unplug()
        time.sleep(_AWAY_S)
        line.plug()
        time.sleep(_LAST_S)
        line.garbage = True
        time.sleep(_GARBAGE_S)
        line.garbage = False
        time.sleep(_LAST_S)
        alive = agent.poll() is None
        agent.send_signal(signal.SIGTERM)
        agent.wait(20.0)
    said = text.read_text()
    last = (said.strip().splitlines() or ["nothing was said"])[-1]
    goes_on = is_true("the flight", "goes on", alive, "" if alive else f"the agent ended: {last[:100]}")
    return [*_said(said), goes_on, *_tracked(said, folder)]


def _said(text: str) -> list[Bar]:
    lines = text.splitlines()
    bars = []
    for name, word, wanted in (
        ("cameras unplugged", "was unplugged", 2),
        ("cameras back", "images again after", 2),
        ("controller unplugged", "the device is missing", 1),
        ("controller back", "is open", 1),
        ("garbage: controller silent", "flight controller: silent", 1),
        ("garbage over: controller back", "flight controller: is back", 1),
    ):
        found = [line for line in lines if word in line]
        bars.append(is_true(f"{name}: said", f"{wanted} times" if wanted > 1 else "once", len(found) == wanted,
                            f"{len(found)} times"))  # fmt: skip
    return bars


def _tracked(text: str, folder: Path) -> list[Bar]:
    """When tracking came back after the cameras, and the longest gap without cameras' faults.

    An agent that ended before a fault was over meets no bar.
    """
    times = {key: int(line.split(key)[1]) for line in text.splitlines() for key in (OUT, BACK) if key in line}
    back_ns = times.get(BACK, 2**63)
    estimates = []
    for newest in sorted((folder / "agent0").glob("boot*.mcap"), key=os.path.getmtime)[-1:]:
        with LogReader(newest) as log:
            estimates = [estimate_from_json(m.json()) for m in log.messages(["/estimate"])]
    after = [e for e in estimates if e.t_ns > back_ns]
    first = next((e.t_ns for e in after if e.tracked), None)
    took_s = (first - after[0].t_ns) * 1e-9 if first is not None else float("inf")
    late = np.array([e.t_ns for e in estimates if e.t_ns > back_ns + 5_000_000_000])
    gap_ms = float(np.diff(late).max()) * 1e-6 if len(late) > 1 else float("inf")
    lost = sum(not e.tracked for e in after[20:])
    return [
        at_most("first image after the cameras' return to a tracked frame", took_s, 1.0, "s", 2),
        at_most("longest gap between frames while the line fails", gap_ms, 200.0, "ms", 0),
        is_true("frames not tracked meanwhile", "0", lost == 0 and bool(after[20:]), f"{lost} of {len(after)}"),
    ]
