"""Bytes kept on disk for as long as this process lives: a file without a name, so that nothing is left behind."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

_CLOSED = -1


class SpillFile:
    """Keeps bytes in a nameless file of a folder. Never raises: what cannot be done is refused and counted."""

    def __init__(self, folder: Path) -> None:
        self.failures = 0
        self._size = 0
        self._file = _CLOSED
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file, name = tempfile.mkstemp(dir=folder)
            os.unlink(name)
        except OSError:
            self.failures += 1

    def put(self, data: bytes) -> int | None:
        """Keep bytes. Returns where they stand; None when the disk does not take them."""
        where = self._size
        try:
            if self._file == _CLOSED or os.pwrite(self._file, data, where) != len(data):
                raise OSError
        except OSError:
            self.failures += 1
            return None
        self._size += len(data)
        return where

    def get(self, where: int, n_bytes: int) -> bytes | None:
        """The bytes that stand there; None when the disk does not give them."""
        try:
            data = os.pread(self._file, n_bytes, where) if self._file != _CLOSED else b""
        except OSError:
            data = b""
        if self._file != _CLOSED and len(data) == n_bytes:
            return data
        self.failures += 1
        return None

    def close(self) -> None:
        """Give the disk back. May be called twice."""
        if self._file != _CLOSED:
            os.close(self._file)
            self._file = _CLOSED

    def __del__(self) -> None:
        self.close()
