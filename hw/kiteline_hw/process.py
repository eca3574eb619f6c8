"""A process and those who watch over it: signals, systemd, the parent that started it, its memory."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import threading
from types import FrameType
from typing import Any

_MIB = 1024.0 * 1024.0


class StopSignal:
    """Turns SIGTERM and SIGINT into a flag that a loop asks for, so that logs and sessions are closed in order."""

    def __init__(self) -> None:
        self._event = threading.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._event.set()

    def __bool__(self) -> bool:
        return self._event.is_set()

    def wait(self, seconds: float) -> bool:
        """Sleep, but no longer than until a signal comes; True when one has come."""
        return self._event.wait(max(0.0, seconds))

    def set(self) -> None:
        """Ask for the end, as a signal would."""
        self._event.set()


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


def end_with_parent() -> None:
    """End this process as soon as the parent that holds the other end of stdin is gone, however it went."""

    def watch() -> None:
        while os.read(0, 4096):
            pass
        os._exit(3)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


def tell_parent(event: str, **values: Any) -> None:
    """Write one line of JSON to stdout for the process that started this one."""
    try:
        sys.stdout.write(json.dumps({"event": event, **values}) + "\n")
        sys.stdout.flush()
    except (BrokenPipeError, ValueError):
        pass


def rss_mib() -> float:
    """Resident memory of this process in MiB; 0 where the system does not tell."""
    try:
        with open("/proc/self/statm", "rb") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / _MIB
    except (OSError, ValueError, IndexError):
        return 0.0
