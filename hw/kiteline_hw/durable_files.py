"""Files that are whole, and the newest, after a crash or a loss of power. It imports nothing but the system's calls."""

import contextlib
import os
import threading
from collections.abc import Callable
from pathlib import Path


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file so that a reader, also after a crash, sees either the old or the new content in full.

    Returns when content and name are on the disk. Makes the folder if need be. Raises OSError; the old file then stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(path.name + ".new")
    try:
        with new.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # else the name may be on the disk before the content: an empty file
        os.replace(new, path)
    except BaseException:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)  # it takes room on a disk that may be full
        raise
    sync_folder(path.parent)


def in_thread(work: Callable[[], None]) -> None:
    """Do a piece of work on a disk that may stall, without waiting for it."""
    threading.Thread(target=work, name="kiteline-disk", daemon=True).start()


def link_newest(link: Path, target: Path) -> None:
    """Let a symbolic link name a file of its folder, if the disk has links and no other file has the link's name."""
    new = link.with_name(link.name + ".new")
    with contextlib.suppress(OSError):
        if link.exists() and not link.is_symlink():
            return
        new.unlink(missing_ok=True)
        new.symlink_to(target.name)
        os.replace(new, link)


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk: else a power cut may bring a replaced file back."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def next_number(path: Path) -> int:
    """The number in a file, plus one, and at least 1; the new number is stored. Survives a crash at any moment.

    Raises OSError if the folder cannot be written, ValueError if the file holds no number.
    """
    try:
        last = int(path.read_text())
    except FileNotFoundError:
        last = 0
    except ValueError as error:
        raise ValueError(f"{path} holds no number: write one there that is higher than any used before") from error
    number = max(last + 1, 1)
    write_atomically(path, f"{number}\n".encode())
    return number
