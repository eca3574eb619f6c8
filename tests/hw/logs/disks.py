"""Disks that are full, stall, or create no files."""

import errno
import os
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest


class SmallDisk:
    """Takes so many bytes, also of a write that does not fit, and then no more until there is room again."""

    def __init__(self, room: int) -> None:
        self.room = room
        self._pwrite = os.pwrite

    def pwrite(self, fd: int, data: bytes, offset: int) -> int:
        if self.room <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        n = self._pwrite(fd, bytes(data)[: self.room], offset)
        self.room -= n
        return n


class StalledDisk:
    """Answers no write until it is let go."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.go = threading.Event()
        self._pwrite = os.pwrite
        monkeypatch.setattr(os, "pwrite", self.pwrite)

    def pwrite(self, fd: int, data: bytes, offset: int) -> int:
        assert threading.current_thread() is not threading.main_thread()
        self.go.wait(10.0)
        return self._pwrite(fd, data, offset)


class SlowFolder:
    """Opens files whose name fits only once it may, or not at all."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, part: str, error: OSError | None = None) -> None:
        self.go, self.tries = threading.Event(), 0
        self._open, self._part, self._error = os.open, part, error
        monkeypatch.setattr(os, "open", self.open)

    def open(self, path: Any, *more: Any, **named: Any) -> int:
        if self._part in str(path):
            self.tries += 1
            assert self.go.wait(20.0)
            if self._error is not None:
                raise self._error
        return self._open(path, *more, **named)


def until(met: Callable[[], bool]) -> None:
    end_s = time.monotonic() + 5.0
    while not met():
        assert time.monotonic() < end_s
        time.sleep(0.005)
