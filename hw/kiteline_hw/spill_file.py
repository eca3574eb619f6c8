"""Bytes kept on disk for as long as this process lives: a file without a name, so that nothing is left behind."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import IO


class SpillFile:
    """Keeps bytes in a nameless file of a folder. Never raises: what cannot be done is refused and counted."""

    def __init__(self, folder: Path) -> None:
        self.failures = 0
        self._size = 0
        self._file: IO[bytes] | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115 - closed by `close`, or with the process
        except OSError:
            self.failures += 1

    def put(self, data: bytes) -> int | None:
        """Keep bytes. Returns where they stand; None when the disk does not take them."""
        if self._file is None:
            return None
        where = self._size
        try:
            self._file.seek(where)
            if self._file.write(data) != len(data):
                self.failures += 1
                return None
        except OSError:
            self.failures += 1
            return None
        self._size += len(data)
        return where

    def get(self, where: int, n_bytes: int) -> bytes | None:
        """The bytes that stand there; None when the disk does not give them."""
        if self._file is None:
            return None
        try:
            self._file.seek(where)
            data = self._file.read(n_bytes)
        except OSError:
            data = b""
        if len(data) == n_bytes:
            return data
        self.failures += 1
        return None

    def close(self) -> None:
        """Give the disk back. May be called twice."""
        if self._file is not None:
            self._file.close()
            self._file = None
