"""Files that a full or failing disk does not leave half written: pieces are appended whole or not at all."""

import contextlib
import errno
import os
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

_MOST_BYTES = 32 << 20  # bytes that wait for a disk: 5 to 10 s of a stereo camera's images
_MOST_LINE_BYTES = 64 << 10  # of a file of lines: half a minute of poses
_RETRY_S = 0.5  # s until a piece that the disk refused is tried again
_CLOSE_S = 5.0  # s that a disk may take for what waits at the end


class WholeFile:
    """A new file to which pieces are appended. After a write that fails it ends where it ended before.

    Raises OSError if it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.size = 0
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)
        self._links = os.fstat(self._fd).st_nlink  # 0 from the beginning where a file system does not count names

    @property
    def closed(self) -> bool:
        """True after `close`."""
        return self._fd < 0

    @property
    def deleted(self) -> bool:
        """True if the file has no name any more."""
        return self._fd < 0 or os.fstat(self._fd).st_nlink < self._links

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

    def end(self) -> None:
        """The same."""
        self.close()


class BesideFile:
    """A WholeFile that is written by a thread of its own: a loop that flies does not wait for a disk that stalls.

    Pieces wait in memory in their order, one that the disk refuses until it is taken. A file that is deleted before it
    is ended takes no more. Raises OSError if the file cannot be created.
    """

    def __init__(self, path: Path, most_bytes: int = _MOST_BYTES) -> None:
        """most_bytes: of pieces that may wait."""
        self._file = WholeFile(path)
        self._most_bytes = most_bytes
        self._pieces: deque[bytes] = deque()
        self._bytes = 0  # of them
        self._fault: tuple[int, str] | None = None  # why the oldest piece is not written yet
        self._wake = threading.Condition()
        self._ended = False  # no piece follows
        self._closing = threading.Event()  # a piece that is refused now is given up, and those behind it
        self._thread = threading.Thread(target=self._run, name="kiteline-log", daemon=True)
        self._thread.start()

    @property
    def closed(self) -> bool:
        """True after `end` or `close`."""
        return self._ended

    @property
    def unwritten(self) -> int:
        """Pieces that are not on the disk yet; after `close`: lost."""
        return len(self._pieces)

    @property
    def fault(self) -> OSError:
        """Why pieces wait."""
        return OSError(*(self._fault or (errno.ETIMEDOUT, "the disk does not answer")))

    @property
    def waits_for(self) -> str:
        """Why the disk takes nothing at present; "" if it does, or may be about to, or the file was deleted."""
        is_late = self._most_bytes and (self._fault is not None or 2 * self._bytes > self._most_bytes)
        return str(self.fault.strerror) if is_late else ""

    def write(self, data: bytes) -> int:
        """Append a piece. Raises OSError if too much waits already. Never blocks."""
        with self._wake:
            if self._pieces and self._bytes + len(data) > self._most_bytes:
                raise self.fault
            self._pieces.append(data)
            self._bytes += len(data)
            self._wake.notify()
        return len(data)

    def flush(self) -> None:
        """Nothing waits but for the disk."""

    def end(self) -> None:
        """Have the file closed once all is written. Never blocks."""
        with self._wake:
            self._ended = True
            self._wake.notify()

    def close(self) -> None:
        """End the file, and wait for the disk for some seconds. May be called twice."""
        self.close_all([self])

    @staticmethod
    def close_all(files: "Sequence[BesideFile]") -> None:
        """Close files of one disk, which is awaited for some seconds in all."""
        until_s = time.monotonic() + _CLOSE_S
        for file in files:
            file.end()
            file._closing.set()
        for file in files:
            file._thread.join(max(0.0, until_s - time.monotonic()))

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._pieces or self._ended)
                if not self._pieces:
                    break
                data = self._pieces[0]
            try:
                if self._file.deleted and not self._ended:
                    raise FileNotFoundError(errno.ENOENT, "the file was deleted while it was written")
                self._file.write(data)
            except OSError as error:
                self._fault = error.errno or 0, error.strerror or str(error)
                if self._file.deleted:  # it gives room only once it is closed
                    self._most_bytes = 0  # nothing waits for it any more
                    break
                if self._closing.is_set():
                    break
                self._closing.wait(_RETRY_S)
                continue
            with self._wake:
                self._fault = None
                self._pieces.popleft()
                self._bytes -= len(data)
        self._file.close()


class FileToCome:
    """A BesideFile that a thread creates: a disk that stalls lets that wait, too.

    done: whether it is created, or cannot be. file: None if it cannot.
    """

    def __init__(self, path: Path) -> None:
        self.done = False
        self.file: BesideFile | None = None
        self._path = path
        self._unused = threading.Event()
        self._decided = threading.Event()  # whether it is used or not
        self._thread = threading.Thread(target=self._run, name="kiteline-log-part", daemon=True)
        self._thread.start()

    def take(self) -> BesideFile | None:
        """The file, once it is done. The caller ends it."""
        self._decided.set()
        return self.file

    def remove(self) -> None:
        """Remove the file, which is not used: now, or once it is created. Waits for the disk for some seconds."""
        self._unused.set()
        self._decided.set()
        self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            self.file = BesideFile(self._path)
        self.done = True
        self._decided.wait()
        if self.file is not None and self._unused.is_set():
            self.file.end()
            with contextlib.suppress(OSError):
                self._path.unlink()


class LineFile:
    """A new file of text lines. Never raises: lines that are not written are counted.

    lost: lines. why: of the first one; "" if none was lost.
    """

    def __init__(self, path: Path, *, beside: bool = False) -> None:
        """beside: written by a thread, see BesideFile."""
        self.lost = 0
        self.why = ""
        self._file: WholeFile | BesideFile | None = None
        try:
            self._file = BesideFile(path, _MOST_LINE_BYTES) if beside else WholeFile(path)
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
            self._lose(1, error)
            return
        self.lost += 1

    def _lose(self, lines: int, error: OSError) -> None:
        self.why = self.why or f"{self._path}: {error.strerror or error}"
        self.lost += lines

    def close(self) -> None:
        """Close the file. May be called twice."""
        file, self._file = self._file, None
        if file is None:
            return
        file.close()
        if isinstance(file, BesideFile) and file.unwritten:
            self._lose(file.unwritten, file.fault)
