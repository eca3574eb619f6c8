"""A process and those who watch over it: signals, systemd, the parent that started it, and what survives its end."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import select
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn


class StopSignal:
    """Turns SIGTERM and SIGINT into a flag that a loop asks for, so that logs and sessions are closed in order.

    No threading.Event: its lock may be held by the very `wait` that a signal interrupts, and `set` would wait for ever.
    """

    def __init__(self) -> None:
        self._asked = False
        self._wake, self._waker = os.pipe()
        os.set_blocking(self._waker, False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._asked = True
        with contextlib.suppress(BlockingIOError):
            os.write(self._waker, b"!")

    def __bool__(self) -> bool:
        return self._asked

    def wait(self, seconds: float) -> bool:
        """Sleep, but no longer than until a signal comes; True when one has come."""
        if not self._asked:
            select.select([self._wake], [], [], max(0.0, seconds))
        return self._asked


def exit_on_sigterm() -> None:
    """Turn SIGTERM into SystemExit in the main thread, so that `with` and `finally` close logs and sessions."""

    def leave(number: int, frame: FrameType | None) -> None:
        sys.exit(128 + number)

    signal.signal(signal.SIGTERM, leave)


def leave(status: int) -> NoReturn:
    """End the process now. Logs and sessions must be closed. The interpreter's own end is passed over: it would cancel
    the threads of native libraries (Zenoh's among them) in mid-call, which now and then aborts the process.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def notify(state: str) -> None:
    """Tell systemd, if it started us: READY=1, WATCHDOG=1, STATUS=... (sd_notify(3)). Never raises."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as s:
            s.sendto(state.encode(), "\0" + address[1:] if address.startswith("@") else address)
    except OSError:
        pass  # a watcher that does not listen is no reason to stop flying


class Parent:
    """The process that started this one and holds the other end of stdin and stdout. When it goes, so do we."""

    def __init__(self) -> None:
        self._words: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=self._watch, name="parent-watch", daemon=True).start()

    def _watch(self) -> None:
        rest = b""
        while chunk := os.read(0, 4096):
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                self._words.put(line.decode(errors="replace"))
        os._exit(3)  # no one is left to close down for

    def said(self) -> str | None:
        """The next line that the parent wrote, or None. Never blocks."""
        try:
            return self._words.get_nowait()
        except queue.Empty:
            return None

    def tell(self, event: str, **values: Any) -> None:
        """Write one line of JSON to the parent."""
        try:
            sys.stdout.write(json.dumps({"event": event, **values}) + "\n")
            sys.stdout.flush()
        except (BrokenPipeError, ValueError):
            pass  # it is gone: the watch ends us


def run_child(
    link: str,
    fly_lockstep: Callable[[Parent], None],
    fly_live: Callable[[Parent, StopSignal], None],
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
        parent.tell("error", text=str(error))
        return 2
    return 0


def state_folder() -> Path:
    """Folder for what survives a restart: $XDG_STATE_HOME/kiteline."""
    return Path(os.environ.get("XDG_STATE_HOME", "~/.local/state")).expanduser() / "kiteline"


def print_lines(lines: Iterable[str]) -> None:
    """Print lines on stderr; a closed terminal does not stop the flight."""
    with contextlib.suppress(OSError):
        for line in lines:
            print(line, file=sys.stderr, flush=True)


def next_number(path: Path, least: int = 1) -> int:
    """A number one higher than at the last call with this file, which is made when missing; at least `least`. It
    survives a crash at any moment. Raises OSError when the folder cannot be written, ValueError when the file holds no
    number.
    """
    try:
        last = int(path.read_text())
    except FileNotFoundError:
        last = 0
    except ValueError as error:
        raise ValueError(f"{path} holds no number: write one there that is higher than any used before") from error
    number = max(last + 1, least)
    write_atomically(path, f"{number}\n".encode())
    return number


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file by new content so that a reader or a crash sees either the old or the new one, whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    young = path.with_name(path.name + ".new")
    with young.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(young, path)
