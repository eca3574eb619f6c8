"""Work of minutes in a service of systemd: it is not taken for a hang, and a request to stop ends it at once."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

from kiteline_hw.system.process import StopSignal, can_raise, deliver_again, notify

_LIMIT_S = 3600  # s after which even such work counts as hung
_EXTEND_S = 1.0  # s between two requests for more time to start
_EXTENSION_S = 10.0  # s that each of them asks for


class StoppedError(BaseException):
    """SIGTERM or SIGINT came during long work. No Exception: libraries that try several ways go on after one."""


@contextlib.contextmanager
def long_work(stop: StopSignal, what: str) -> Iterator[None]:
    """Do long work after READY=1, in the main thread. Raises StoppedError out of it when a signal comes; `stop` is set.

    what: shown by `systemctl status`. The watchdog, whose pings pause meanwhile, is set to an hour.
    """

    stopped = False

    def on_signal(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        stop.set()
        if not can_raise(frame):
            deliver_again(number, on_signal)
        elif not stopped:  # a second one would interrupt what the first one ends
            stopped = True
            raise StoppedError

    watchdog_us = os.environ.get("WATCHDOG_USEC", "")
    notify(f"STATUS={what}" + (f"\nWATCHDOG_USEC={_LIMIT_S * 1_000_000}" if watchdog_us else ""))
    before = {number: signal.signal(number, on_signal) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        if stop:
            raise StoppedError
        yield
    finally:
        stopped = True  # from here on nothing is left to interrupt
        for number, handler in before.items():
            signal.signal(number, handler)
        notify("STATUS=" + (f"\nWATCHDOG_USEC={watchdog_us}\nWATCHDOG=1" if watchdog_us else ""))


@contextlib.contextmanager
def starting() -> Iterator[None]:
    """Ask systemd for more time, again and again, while a start compiles kernels."""
    done = threading.Event()

    def extend() -> None:
        while not done.is_set():
            notify(f"EXTEND_TIMEOUT_USEC={round(_EXTENSION_S * 1e6)}")
            done.wait(_EXTEND_S)

    if not os.environ.get("NOTIFY_SOCKET"):
        yield
        return
    thread = threading.Thread(target=extend, name="kiteline-start", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
