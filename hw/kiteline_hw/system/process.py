"""Signals, systemd, the pipe to the parent process, and the folder for what survives a restart."""

import contextlib
import json
import os
import queue
import select
import signal
import socket
import sys
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from kiteline_core.errors import KitelineError

_LLVM = f"{os.sep}llvmlite{os.sep}"  # in the paths of frames that hold native objects
_PATIENCE_S = 1.5  # s until a user is told what is waited for
_MOST_LINES = 200  # lines that wait for a terminal: half an hour of them
_LAST_LINES_S = 0.5  # s that a terminal may take for the last ones
_AGAIN_S = 0.01  # s until a handler that could not raise is called again


class StopSignal:
    """Turns SIGTERM and SIGINT into a flag that a loop reads, so that logs and sessions are closed in order.

    It is no threading.Event: a signal may interrupt `wait` while it holds the event's lock, and `set` would deadlock.
    """

    def __init__(self) -> None:
        self._received = False
        self._wake, self._waker = os.pipe()
        os.set_blocking(self._waker, False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)

    def set(self) -> None:
        """Set the flag, as a signal does."""
        self._received = True
        with contextlib.suppress(BlockingIOError):
            os.write(self._waker, b"!")

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.set()

    def __bool__(self) -> bool:
        return self._received

    def wait(self, seconds: float) -> bool:
        """Sleep until a signal comes or the time is over; True if a signal has come."""
        if not self._received:
            select.select([self._wake], [], [], max(0.0, seconds))
        return self._received


def can_raise(frame: FrameType | None) -> bool:
    """True if an exception raised by a signal handler in this frame reaches its callers and breaks nothing.

    A callback of a native library and a finaliser swallow it, and an object of LLVM that is half freed is freed twice.
    """
    while frame is not None:
        code = frame.f_code
        if code.co_name == "__del__" or _LLVM in code.co_filename or code.co_filename == weakref.__file__:
            return False
        frame = frame.f_back
    return True


def deliver_again(number: int, handler: Callable[[int, FrameType | None], None]) -> None:
    """Call a signal's handler again a moment later, by SIGALRM: where it was called it could not raise."""
    signal.signal(signal.SIGALRM, lambda _, frame: handler(number, frame))
    signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)


def exit_on_sigterm() -> None:
    """Turn SIGTERM into SystemExit in the main thread, so that `with` and `finally` close logs and sessions."""

    def on_signal(number: int, frame: FrameType | None) -> None:
        if not can_raise(frame):
            return deliver_again(number, on_signal)
        sys.exit(128 + number)

    signal.signal(signal.SIGTERM, on_signal)


def outlive_terminal() -> None:
    """Go on when the terminal closes, as at the end of an SSH session over bad Wi-Fi: a flight does not end with it."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)


def exit_now(status: int) -> NoReturn:
    """End the process now, after logs and sessions were closed.

    The interpreter's own shutdown is skipped: it would cancel threads of native libraries such as Zenoh in mid-call,
    which sometimes aborts the process.
    """
    for stream in (sys.stdout, sys.stderr) if _writer is None else (sys.stdout,):
        with contextlib.suppress(OSError, ValueError):  # a file on a full disk, a closed pipe
            stream.flush()
    os._exit(status)


def notify(state: str) -> None:
    """Send READY=1, WATCHDOG=1 or STATUS=... to systemd if it started this process (sd_notify(3)). Never raises."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as s:
            s.sendto(state.encode(), "\0" + address[1:] if address.startswith("@") else address)
    except OSError:
        pass  # no reason to stop flying


class Parent:
    """The parent process at the other end of stdin and stdout. This process ends when the parent does."""

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=self._watch, name="parent-watch", daemon=True).start()

    def _watch(self) -> None:
        rest = b""
        while chunk := os.read(0, 4096):
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                self._lines.put(line.decode(errors="replace"))
        os._exit(3)  # nobody would read the results

    def next_line(self) -> str | None:
        """The next line that the parent wrote, or None. Never blocks."""
        try:
            return self._lines.get_nowait()
        except queue.Empty:
            return None

    def send_event(self, event: str, **values: Any) -> None:
        """Write one line of JSON to the parent."""
        try:
            sys.stdout.write(json.dumps({"event": event, **values}) + "\n")
            sys.stdout.flush()
        except (BrokenPipeError, ValueError):
            pass  # the parent is gone: `_watch` ends this process


def run_child(
    link: str,
    fly_lockstep: Callable[[Parent], None],
    fly_live: Callable[[Parent, StopSignal], object],
    expected: tuple[type[Exception], ...],
) -> int:
    """Fly as a child process, in lock-step if the link says so. Returns the exit status.

    expected: errors that a user can mend; they are sent to the parent as one line.
    """
    parent = Parent()
    try:
        if link.startswith("lockstep:"):
            exit_on_sigterm()  # a process that waits at the barrier polls no flag
            fly_lockstep(parent)
        else:
            fly_live(parent, StopSignal())
    except expected as error:
        parent.send_event("error", text=str(error))
        return 2
    return 0


def is_stopped(pid: int | None) -> bool:
    """True if a process was stopped by a signal (SIGSTOP) and does not run; False where the system does not tell."""
    try:
        return Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[0] in (b"T", b"t")
    except (OSError, IndexError):
        return False


def state_folder() -> Path:
    """Folder for what survives a restart: a service's $STATE_DIRECTORY, else that of the user. Raises KitelineError."""
    of_service = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(of_service) if of_service else user_folder("XDG_STATE_HOME", "~/.local/state")


def user_folder(variable: str, default: str) -> Path:
    """kiteline's folder in the one that a variable names, else in the usual one of a user. Raises KitelineError."""
    folder = home_path(os.environ.get(variable) or default)
    if str(folder).startswith("~"):
        raise KitelineError(f"this user has no home folder for {default}/kiteline: set HOME, or {variable}")
    return folder / "kiteline"


def home_path(text: str) -> Path:
    """A path whose ~ or ~USER at the beginning is a home folder; as it stands where there is no such user."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        return Path(text)


class _LineWriter:
    """Prints lines on stderr in a thread: a terminal that is held (Ctrl-S), or a pipe that nobody reads, lets a write
    wait without end. The newest lines wait in memory.
    """

    def __init__(self) -> None:
        self._lines = deque[str](maxlen=_MOST_LINES)
        self._ended = False
        self._wake = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="kiteline-terminal", daemon=True)
        self._thread.start()

    def put(self, lines: Iterable[str]) -> None:
        """Have lines printed. Never blocks."""
        with self._wake:
            self._lines.extend(lines)
            self._wake.notify()

    def end(self) -> bool:
        """Wait a moment for the last lines; False if the terminal does not take them."""
        with self._wake:
            self._ended = True
            self._wake.notify()
        self._thread.join(_LAST_LINES_S)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._lines or self._ended)
                if not self._lines:
                    return
                line = self._lines.popleft()
            with contextlib.suppress(OSError, ValueError):
                print(line, file=sys.stderr, flush=True)


_writer: _LineWriter | None = None  # of `print_lines`, where it waits for no terminal


@contextlib.contextmanager
def without_waiting_for_terminal() -> Iterator[None]:
    """Let `print_lines` not wait: for a loop that flies. A terminal that is held at the end is not awaited later."""
    global _writer
    writer = _writer = _LineWriter()
    try:
        yield
    finally:
        if writer.end():
            _writer = None


def print_lines(lines: Iterable[str]) -> None:
    """Print lines on stderr; a closed terminal does not stop the flight."""
    if _writer is not None:
        _writer.put(lines)
        return
    with contextlib.suppress(OSError):
        for line in lines:
            print(line, file=sys.stderr, flush=True)


@contextlib.contextmanager
def told_if_slow(text: str) -> Iterator[None]:
    """Print a line on stderr if the block takes long."""
    timer = threading.Timer(_PATIENCE_S, print_lines, [[text]])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def kept_folder(name: str) -> Path:
    """The folder for files of `name` that outlive its logs."""
    return state_folder() / name
