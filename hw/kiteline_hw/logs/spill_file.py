"""Temporary storage on disk: an unlinked file, which vanishes with this process."""

import os
import tempfile
from pathlib import Path

_LEAST_BLOCK_BYTES = 64


class SpillFile:
    """Stores bytes in an unlinked file of a folder. Never raises: failures are returned as None and counted.

    Bytes take a block of one of some sizes, an eighth apart, so that freed blocks serve again.
    """

    def __init__(self, folder: Path) -> None:
        self.failures = 0
        self._free: dict[int, list[int]] = {}  # positions of freed blocks, by their size
        self._size = 0
        self._file: int | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file, name = tempfile.mkstemp(dir=folder)
            os.unlink(name)
        except OSError:
            self.failures += 1

    def put(self, data: bytes) -> int | None:
        """Store bytes. Returns their position; None if the disk refuses them."""
        size = _block_bytes(len(data))
        free = self._free.get(size)
        offset = free[-1] if free else self._size
        try:
            if self._file is None or os.pwrite(self._file, data, offset) != len(data):
                raise OSError
        except OSError:
            self.failures += 1
            return None
        if free:
            free.pop()
        else:
            self._size += size
        return offset

    def free(self, offset: int, n_bytes: int) -> None:
        """Let others take the place of `n_bytes` that were stored at a position."""
        self._free.setdefault(_block_bytes(n_bytes), []).append(offset)

    def get(self, offset: int, n_bytes: int) -> bytes | None:
        """The bytes at a position; None if they cannot be read."""
        try:
            data = os.pread(self._file, n_bytes, offset) if self._file is not None else b""
        except OSError:
            data = b""
        if self._file is not None and len(data) == n_bytes:
            return data
        self.failures += 1
        return None

    def close(self) -> None:
        """Release the disk space. May be called twice."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def __del__(self) -> None:
        self.close()


def _block_bytes(n_bytes: int) -> int:
    """Size of the block that bytes are stored in."""
    step = max(_LEAST_BLOCK_BYTES, 1 << max(0, n_bytes.bit_length() - 4))
    return -(-n_bytes // step) * step
