"""Temporary storage on disk: an unlinked file, which vanishes with this process."""

import os
import tempfile
import threading
from pathlib import Path

_LEAST_BLOCK_BYTES = 64
_MOST_WAITING_BYTES = 4 << 20  # bytes that wait for a disk: minutes of keyframes
_RETRY_S = 0.5  # s until what the disk refused is tried again


class SpillFile:
    """Stores bytes in an unlinked file of a folder. Never raises: failures are returned as None and counted.

    Bytes take a block of one of some sizes, an eighth apart, so that freed blocks serve again.
    """

    def __init__(self, folder: Path, *, beside: bool = False) -> None:
        """beside: written by a thread, so that `put` waits for no disk that stalls. What waits can be read."""
        self.failures = 0
        self._free: dict[int, list[int]] = {}  # positions of freed blocks, by their size
        self._size = 0
        self._file: _File | _BesideFile | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            fd, name = tempfile.mkstemp(dir=folder)
            self._file = _BesideFile(fd) if beside else _File(fd)
            os.unlink(name)
        except OSError:
            self.failures += 1

    def put(self, data: bytes) -> int | None:
        """Store bytes. Returns their position; None if the disk refuses them, or is too slow."""
        size = _block_bytes(len(data))
        free = self._free.get(size)
        offset = free[-1] if free else self._size
        if self._file is None or not self._file.write(data, offset):
            self.failures += 1
            return None
        if free:
            free.pop()
        else:
            self._size += size
        return offset

    def free(self, offset: int, n_bytes: int) -> None:
        """Let others take the place of `n_bytes` that were stored at a position."""
        if self._file is not None:
            self._file.drop(offset)
        self._free.setdefault(_block_bytes(n_bytes), []).append(offset)

    def get(self, offset: int, n_bytes: int) -> bytes | None:
        """The bytes at a position; None if they cannot be read."""
        data = None if self._file is None else self._file.read(offset, n_bytes)
        if data is None or len(data) != n_bytes:
            self.failures += 1
            return None
        return data

    def close(self) -> None:
        """Release the disk space. May be called twice."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __del__(self) -> None:
        self.close()


class _File:
    """A file that is written at once."""

    def __init__(self, fd: int) -> None:
        self._fd = fd

    def write(self, data: bytes, offset: int) -> bool:
        """Write bytes at a position. False if the disk does not take them all."""
        try:
            return os.pwrite(self._fd, data, offset) == len(data)
        except OSError:
            return False

    def read(self, offset: int, n_bytes: int) -> bytes | None:
        """The bytes at a position; fewer at the end of the file."""
        try:
            return os.pread(self._fd, n_bytes, offset)
        except OSError:
            return None

    def drop(self, offset: int) -> None:
        """Nothing waits."""

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)


class _BesideFile:
    """A file that a thread writes. What waits for the disk stays in memory, where it is read and replaced."""

    def __init__(self, fd: int) -> None:
        self._file = _File(fd)
        self._waiting: dict[int, bytes] = {}  # by position, which no two share; the first one is written next
        self._bytes = 0  # of them
        self._wake = threading.Condition()
        self._closed = threading.Event()
        threading.Thread(target=self._run, name="kiteline-spill", daemon=True).start()

    def write(self, data: bytes, offset: int) -> bool:
        """Have bytes written at a position. False if too much waits already. Never blocks."""
        with self._wake:
            if self._bytes + len(data) > _MOST_WAITING_BYTES:
                return False
            self._waiting[offset] = data
            self._bytes += len(data)
            self._wake.notify()
        return True

    def read(self, offset: int, n_bytes: int) -> bytes | None:
        """The bytes at a position, on the disk or not; fewer at the end of the file."""
        with self._wake:
            waiting = self._waiting.get(offset)
        return self._file.read(offset, n_bytes) if waiting is None else waiting

    def drop(self, offset: int) -> None:
        """Bytes at a position need not be written any more."""
        with self._wake:
            self._bytes -= len(self._waiting.pop(offset, b""))

    def close(self) -> None:
        """Have the file closed, which nothing reads any more. Never blocks."""
        with self._wake:
            self._closed.set()
            self._wake.notify()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._waiting or self._closed.is_set())
                if self._closed.is_set():
                    break
                offset, data = next(iter(self._waiting.items()))
            if not self._file.write(data, offset):
                self._closed.wait(_RETRY_S)
                continue
            with self._wake:
                if self._waiting.get(offset) is data:  # else it was dropped, or replaced, while it was written
                    self._bytes -= len(self._waiting.pop(offset))
        self._file.close()


def _block_bytes(n_bytes: int) -> int:
    """Size of the block that bytes are stored in; nothing has one, too, since a position is of one block."""
    step = max(_LEAST_BLOCK_BYTES, 1 << max(0, n_bytes.bit_length() - 4))
    return -(-max(1, n_bytes) // step) * step
