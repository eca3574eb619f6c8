"""Signals, systemd, and the pipe to the parent."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from kiteline_hw.system import process


def test_notify_with_and_without_systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    process.notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    process.notify("READY=1")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as s:
        s.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        process.notify("WATCHDOG=1")
        assert s.recv(64) == b"WATCHDOG=1"


def run(code: str, **options: object) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen(
        [sys.executable, "-c", "from kiteline_hw.system import process\n" + code],
        env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip


def test_a_signal_sets_the_flag_and_ends_a_wait() -> None:
    with run("s = process.StopSignal(); print(bool(s), flush=True); print(s.wait(20), bool(s), flush=True)") as child:
        assert child.stdout.readline() == b"False\n"
        child.send_signal(signal.SIGTERM)
        assert child.stdout.readline() == b"True True\n"


def test_a_child_reads_lines_and_ends_with_its_parent() -> None:
    code = (
        "import time\np = process.Parent(); p.send_event('ready', n=1)\n"
        "while (word := p.next_line()) is None: time.sleep(0.01)\np.send_event('heard', word=word); time.sleep(60)"
    )
    with run(code) as child:
        assert child.stdout.readline() == b'{"event": "ready", "n": 1}\n'
        child.stdin.write(b"frames_over\n")
        child.stdin.flush()
        assert child.stdout.readline() == b'{"event": "heard", "word": "frames_over"}\n'
        child.stdin.close()
        assert child.wait(10.0) == 3


def test_exit_flushes_the_output() -> None:
    with run("print('last'); process.exit_now(7)") as child:
        assert child.communicate()[0] == b"last\n"
        assert child.returncode == 7


def test_a_stop_signal_at_any_time() -> None:
    """Also into the middle of a `wait`, thousands of times: a lock that the interrupted wait holds would end it all."""
    code = (
        "import os, signal\n"
        "from kiteline_hw.system.process import StopSignal\n"
        "stop = StopSignal()\n"
        "signal.signal(signal.SIGALRM, stop._on_signal)\n"
        "signal.setitimer(signal.ITIMER_REAL, 2e-4, 2e-4)\n"
        "for _ in range(4000):\n"
        "    stop._asked = False\n"
        "    stop.wait(1e-5)\n"
        "signal.setitimer(signal.ITIMER_REAL, 0)\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
        "assert stop and stop.wait(60.0)\n"
    )
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        timeout=30,
        capture_output=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stderr
