"""Processes: signals, children, memory and notices."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest

from kiteline_core.errors import KitelineError
from kiteline_hw.system import process
from kiteline_hw.system.memory import clean_mappings
from kiteline_hw.system.notices import Notices


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


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    with pytest.raises(KitelineError, match=r"no home folder .*: set HOME, or XDG_STATE_HOME"):
        process.state_folder()
    assert process.home_path("~nobody/flight.mcap") == Path("~nobody/flight.mcap")
    monkeypatch.setenv("XDG_STATE_HOME", "/var/own")
    assert process.state_folder() == Path("/var/own/kiteline")


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


LONG_WORK = """
import os, signal, time
from kiteline_hw.system.long_work import StoppedError, long_work

def signal_me():
    os.kill(os.getpid(), signal.SIGTERM)
    sum(range(100))

class Native:
    def __del__(self):
        signal_me()

def native():
    Native()

def several_ways():
    try:
        signal_me()
    except Exception:
        pass

stop = process.StopSignal()
try:
    with long_work(stop, "reading"):
        {work}()
        time.sleep(30)
except StoppedError:
    print("stopped", bool(stop))
"""


@pytest.mark.parametrize("work", ["signal_me", "native", "several_ways"])
def test_a_signal_ends_long_work_wherever_it_arrives(work: str) -> None:
    with run(LONG_WORK.format(work=work)) as child:
        assert child.communicate(timeout=20)[0] == b"stopped True\n"


def test_no_exception_is_raised_into_callbacks_of_native_code() -> None:
    """ctypes swallows it; an object of LLVM that is half freed is freed twice."""
    held: dict[str, object] = {}
    code = "def free(frame):\n    return can_raise(frame())\n"
    exec(compile(code, "/venv/llvmlite/binding/ffi.py", "exec"), {"can_raise": process.can_raise}, held)
    free = held["free"]
    assert callable(free)
    assert not free(sys._getframe) and process.can_raise(sys._getframe())


MEMORY = """
import numpy as np
from kiteline_hw.system.memory import rss_mib
before = rss_mib()
block = np.ones(64 << 17)  # 64 MiB
held = rss_mib()
del block
print(before, held, rss_mib())
"""


def test_resident_memory() -> None:
    """In a process of its own: here, memory that other tests freed may be returned at any time."""
    done = subprocess.run([sys.executable, "-c", MEMORY], check=True, capture_output=True, text=True)
    before_mib, held_mib, after_mib = map(float, done.stdout.split())
    assert 60.0 < held_mib - before_mib < 70.0
    assert after_mib < before_mib + 10.0


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="the system does not report its mappings")
def test_startup_memory_is_released() -> None:
    code = (
        "import cv2, numpy as np\nfrom kiteline_hw.system.memory import release_memory, rss_mib\n"
        "image = np.arange(40000, dtype=np.uint8).reshape(200, 200)\nwanted = cv2.GaussianBlur(image, (5, 5), 1.0)\n"
        "before = rss_mib()\nrelease_memory()\nprint(before - rss_mib())\n"
        "assert (cv2.GaussianBlur(image, (5, 5), 1.0) == wanted).all()\nimport zlib, decimal\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) > 10.0


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not report resident memory")
def test_freed_arrays_are_returned_to_the_system() -> None:
    """Arrays of growing size, with small ones between them that stay alive."""
    code = (
        "import numpy as np\nfrom kiteline_hw.system.memory import return_large_arrays, rss_mib\n"
        "return_large_arrays()\nkept = []\nbefore = rss_mib()\n"
        "for k in range(60):\n"
        "    a, small = np.ones((k + 1) << 16), np.ones(3000)\n    b = np.ones((k + 1) << 15)\n"
        "    kept.append(np.ones(3000))\n    del a, small\ndel b\n"
        "print(rss_mib() - before)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 5.0  # 1.4 MiB are still in use; of a heap left to itself some 40 MiB stay


def test_only_unchanged_pages_of_files_are_dropped() -> None:
    def mapping(first: int, mode: str, name: str, **sizes: int) -> str:
        head = f"{first:x}-{first + 0x1000:x} {mode} 00000000 fe:00 7 {name}\n"
        known = {"Rss": 4, "Shared_Dirty": 0, "Private_Dirty": 0, "Anonymous": 0, **sizes}
        return head + "".join(f"{key}: {value} kB\n" for key, value in known.items()) + "VmFlags: rd mr mw me\n"

    smaps = "".join(
        (
            mapping(0x10000, "r-xp", "/lib/code.so"),
            mapping(0x20000, "r--p", "/lib/code.so", Private_Dirty=4, Anonymous=4),
            mapping(0x30000, "rw-p", "/lib/code.so"),
            mapping(0x40000, "r-xp", ""),
            mapping(0x50000, "r-xp", "[vdso]"),
            mapping(0x60000, "r--p", "/a folder/data (1).so"),
        )
    )
    assert clean_mappings(smaps) == [(0x10000, 0x11000), (0x60000, 0x61000)]


def test_a_line_that_a_thread_adds_while_lines_are_taken_is_not_lost() -> None:
    notices = Notices()
    notices.say("log", "log: the disk is full")
    add = notices._new.append  # as far as a thread came that says something now
    assert notices.take() == ["log: the disk is full"]
    add("rig: the disk is full")
    assert notices.take() == ["rig: the disk is full"]
    assert notices.take() == []


def test_a_loop_waits_for_no_terminal_that_takes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "_writer", None)
    monkeypatch.setattr(process, "_LAST_LINES_S", 0.1)
    end, terminal = os.pipe()
    os.set_blocking(terminal, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(terminal, b"." * 4096)
    os.set_blocking(terminal, True)
    with open(terminal, "w") as held, open(end, "rb") as reader:
        monkeypatch.setattr(sys, "stderr", held)
        begin_s = time.monotonic()
        with process.without_waiting_for_terminal():
            for n in range(10_000):
                process.print_lines([f"line {n}"])
        process.print_lines(["last"])
        assert time.monotonic() - begin_s < 2.0
        said = b""
        while not said.endswith(b"last\n"):
            said += reader.read1(1 << 16)
    lines = said.lstrip(b".").decode().splitlines()
    assert lines[-200:] == [*(f"line {n}" for n in range(9801, 10_000)), "last"]
    assert len(lines) <= 201  # one was under way


def test_lines_are_printed_in_order_where_the_terminal_takes_them(capsys: pytest.CaptureFixture[str]) -> None:
    with process.without_waiting_for_terminal():
        process.print_lines(["a", "b"])
        process.print_lines(["c"])
    process.print_lines(["d"])
    assert capsys.readouterr().err == "a\nb\nc\nd\n"


def test_a_process_whose_terminal_takes_nothing_ends(tmp_path: Path) -> None:
    end, terminal = os.openpty()
    termios.tcflow(terminal, termios.TCOOFF)  # as Ctrl-S does
    code = "with process.without_waiting_for_terminal(): process.print_lines(['a line'] * 3)\nprocess.exit_now(3)"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", "from kiteline_hw.system import process\n" + code]
    with subprocess.Popen(command, env=environment, stderr=terminal) as program:
        try:
            assert program.wait(20.0) == 3
        finally:
            program.kill()
    for one in (end, terminal):
        os.close(one)
