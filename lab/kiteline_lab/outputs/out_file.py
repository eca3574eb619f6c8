"""Files that are either complete or absent: written under another name and renamed at the end."""

import fcntl
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from kiteline_hw.durable_files import write_atomically
from kiteline_hw.logs.mcap_log import LogWriter
from kiteline_hw.ports import SourceError

_ROOM = "free some room, or name a place on another disk"


def expect_writable(path: Path) -> None:
    """Raise SourceError if no file of this name can be written: for programs that take long before they write."""
    if path.is_dir() or not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise SourceError(f"{path}: cannot be written: expected a file name in a folder that exists and may be written")


def expect_nothing_lost(log: LogWriter, path: Path) -> None:
    """Raise SourceError where a disk did not take a part of a log that is of use as a whole only."""
    if log.dropped:
        raise SourceError(f"{path.parent}: {log.why}: {_ROOM}")


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that is complete, or stays what it was; into a pipe or a device as it comes. Raises OSError."""
    if not _written_as_it_comes(path, content):
        write_atomically(path.resolve(), content)  # of a link, what it leads to


def _written_as_it_comes(path: Path, content: bytes) -> bool:
    """Write into a pipe or a device; False if there is none. Makes the folder if need be. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_file() or not path.exists():
        return False
    path.write_bytes(content)
    return True


def expect_new(paths: Iterable[Path], *, force: bool) -> None:
    """Raise SourceError when one of these files is there already (unless force)."""
    there = [str(path) for path in paths if path.is_file()]
    if there and not force:
        exist = "exists" if len(there) == 1 else "exist"
        raise SourceError(f"{', '.join(there)} {exist} already: name another place, or overwrite with --force")


def write_files(folder: Path, contents: Mapping[str, bytes], *, force: bool) -> list[Path]:
    """Write files by their names in a folder, all of them or none; returns where they are.

    Raises SourceError when one is there already (unless force) or its folder may not be written, OSError.
    """
    paths = {folder / name: content for name, content in contents.items()}
    expect_new(paths, force=force)
    with ExitStack() as stack:
        for path, content in paths.items():
            if not _written_as_it_comes(path, content):
                write_atomically(stack.enter_context(whole_file(path.resolve(), force=True)), content)
    return list(paths)


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Lock a folder, made if need be, against other flights. Raises SourceError if one leaves its results there."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with suppress(OSError):  # of a disk that has no locks
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise SourceError(f"{folder}: another flight writes there: name another folder, or wait") from None
        yield
    finally:
        os.close(lock)


@contextmanager
def whole_file(path: Path, *, force: bool) -> Iterator[Path]:
    """Give a name to write to; the file becomes `path` when the block succeeds, and is removed when it fails.

    Raises SourceError when `path` is there already (unless force), or its folder is not or may not be written.
    """
    if path.exists() and not force:
        raise SourceError(f"{path} exists already: choose another name, or overwrite it with --force")
    expect_writable(path)
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
