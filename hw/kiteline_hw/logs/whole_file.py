"""Files that a full or failing disk does not leave half written: pieces are appended whole or not at all."""

import contextlib
import os
from pathlib import Path


class WholeFile:
    """A new file to which pieces are appended. After a write that fails it ends where it ended before.

    Raises OSError if it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.size = 0
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)

    @property
    def closed(self) -> bool:
        """True after `close`."""
        return self._fd < 0

    def write(self, data: bytes) -> int:
        """Append a piece. Raises OSError if the disk does not take all of it."""
        view, at = memoryview(data), self.size
        try:
            while view:
                n = os.pwrite(self._fd, view, at)
                view, at = view[n:], at + n
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self.size)  # else the next piece is written over the rest
            raise
        self.size = at
        return len(data)

    def flush(self) -> None:
        """Nothing waits: every piece is with the operating system."""

    def close(self) -> None:
        """Close the file. May be called twice."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            with contextlib.suppress(OSError):
                os.close(fd)


class LineFile:
    """A new file of text lines. Never raises: lines that are not written are counted.

    lost: lines. why: of the first one; "" if none was lost.
    """

    def __init__(self, path: Path) -> None:
        self.lost = 0
        self.why = ""
        self._file: WholeFile | None = None
        try:
            self._file = WholeFile(path)
        except OSError as error:
            self.why = f"{path}: {error.strerror or error}"
        self._path = path

    def write(self, line: str) -> None:
        """Append a line; an empty one is none."""
        if not line:
            return
        try:
            if self._file is not None:
                self._file.write(line.encode())
                return
        except OSError as error:
            self.why = self.why or f"{self._path}: {error.strerror or error}"
        self.lost += 1

    def close(self) -> None:
        """Close the file. May be called twice."""
        if self._file is not None:
            self._file.close()
