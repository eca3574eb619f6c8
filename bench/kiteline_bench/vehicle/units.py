"""The services: what systemd's own checkers say, and how an agent ends."""

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from kiteline_bench.harness.bars import Bar, Bench, at_most, environment, is_true, run_command
from kiteline_hw.logs.mcap_log import LEFT, LogReader
from kiteline_lab.units.unit_files import shipped_folder

UNITS = ("kiteline-agent.service", "kiteline-base.service")
_SCORE, _STOP_S = 2.0, 1.0
_READY_S, _FLOWN_S = 120.0, 3.0


def run(bench: Bench) -> list[Bar]:
    """Check the units, then stop an agent in flight."""
    return [*_checked(bench), *_stopped(bench)]


def _checked(bench: Bench) -> list[Bar]:
    program = shutil.which("systemd-analyze")
    if program is None:
        bench.more.append("Units not checked: systemd-analyze is not installed here (Debian package systemd).")
        return []
    bars = []
    for unit in UNITS:
        path = str(shipped_folder() / unit)
        said = run_command([program, "verify", "--man=no", path], 60.0)
        lines = (said.stdout + said.stderr).strip().splitlines()
        bars.append(is_true(f"{unit}: systemd-analyze verify", "silent", not lines, "; ".join(lines[:2]) or "silent"))
        said = run_command([program, "security", "--offline=true", "--no-pager", path], 60.0)
        score = re.search(r"Overall exposure level for \S+: ([\d.]+)", said.stdout)
        bars.append(at_most(f"{unit}: exposure", float(score[1]) if score else 10.0, _SCORE, "", 1))
    return bars


def _stopped(bench: Bench) -> list[Bar]:
    bench.say("an agent is stopped in flight")
    folder = bench.folder / "units"
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        told = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        address = Path(folder) / "notify"
        address.unlink(missing_ok=True)
        told.bind(str(address))
        told.settimeout(_READY_S)
        out = stack.enter_context((folder / "agent.txt").open("wb"))
        agent = subprocess.Popen(
            [sys.executable, "-m", "kiteline_cli", "agent", bench.source("room_flight.mcap"), "--log", str(folder)],
            env=environment(NOTIFY_SOCKET=str(address), STATE_DIRECTORY=str(folder / "state")), stdout=out, stderr=out,
        )  # fmt: skip
        stack.callback(agent.wait)
        stack.callback(agent.kill)
        while b"READY=1" not in told.recv(4096):
            pass
        time.sleep(_FLOWN_S)
        agent.send_signal(signal.SIGTERM)
        begin_s = time.monotonic()
        agent.wait(timeout=20.0)
        took_s = time.monotonic() - begin_s
    newest = max((folder / "agent0").glob("boot*.mcap"), key=os.path.getmtime)
    with LogReader(newest) as log:
        whole, images = log.cut is None, sum(1 for _ in log.messages((LEFT,)))
    return [
        at_most("SIGTERM to the end of the agent", took_s, _STOP_S, "s", 2),
        is_true("its log", "closed", whole and agent.returncode == 0 and images > 0,
                f"{'closed' if whole else 'cut'}, {images} images"),
    ]  # fmt: skip
