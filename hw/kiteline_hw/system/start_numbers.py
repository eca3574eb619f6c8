"""Numbers of starts: ids, sessions and nonces are made of them, so none may come twice.

They are kept in one file of two slots. A start writes the older slot in place, which takes no room on a full disk, and
waits for the disk before its number is used: a cut leaves the other slot. A file that is lost, or that came with a
cloned card to another machine, begins at numbers drawn at random; so does a start whose number cannot be kept.
"""

import contextlib
import errno
import fcntl
import json
import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Protocol

from kiteline_core.ids import MAX_BOOTS, MAX_SUBMAPS

NAME = "start"  # of the file
_SLOT_BYTES = 512  # a sector: written as a whole by most disks
_ORIGINS = 1 << 14  # orders that a file begins at


@dataclass(frozen=True, slots=True)
class Start:
    """One start. order: above those before it. boot: of ids, 0 to MAX_BOOTS - 1. submap: number of its first submap.

    kept: "" or why it is not on disk.
    """

    order: int
    boot: int
    submap: int = 0
    kept: str = ""


class StateFolder(Protocol):
    """A folder on a disk that may lose at a power cut what was not synchronised. All but `lock` raise OSError."""

    def lock(self) -> AbstractContextManager[None]: ...
    def read(self, name: str) -> bytes | None: ...
    def write(self, name: str, offset: int, data: bytes) -> None: ...
    def sync(self, name: str) -> None: ...
    def rename(self, old: str, new: str) -> None: ...
    def sync_names(self) -> None: ...


class StartNumbers:
    """The numbers of one agent's or base's starts. machine: identity of this computer. draw: random, below a number."""

    def __init__(self, folder: StateFolder, machine: str, draw: Callable[[int], int] = secrets.randbelow) -> None:
        self._folder, self._machine, self._draw = folder, machine, draw

    def next(self, least_order: int = 1) -> Start:
        """The numbers of this start. least_order: of the order, whatever is kept. Never raises OSError.

        The first submap is always drawn: should a boot come again, its ids most likely differ all the same.
        """
        return replace(self._next_kept(least_order), submap=self._draw(MAX_SUBMAPS // 2))

    def _next_kept(self, least_order: int) -> Start:
        try:
            with self._folder.lock():
                return self._next(least_order)
        except OSError as error:
            last = None
            with contextlib.suppress(OSError):
                last = self._last()
            drawn = self._drawn(0 if last is None else last[0].order, least_order)
            return replace(drawn, kept=error.strerror or str(error))

    def _next(self, least_order: int) -> Start:
        last = self._last()
        if last is None:
            start = self._drawn(0, least_order)
            content = b"".join(_slot(s, self._machine) for s in (start, replace(start, order=start.order - 1)))
            self._folder.write(NAME + ".new", 0, content)
            self._folder.sync(NAME + ".new")
            self._folder.rename(NAME + ".new", NAME)
            self._folder.sync_names()
            return start
        before, slot, machine = last
        start = Start(max(before.order + 1, least_order), (before.boot + 1) % MAX_BOOTS)
        if machine != self._machine:
            start = self._drawn(before.order, least_order)
        self._folder.write(NAME, (1 - slot) * _SLOT_BYTES, _slot(start, self._machine))
        self._folder.sync(NAME)
        return start

    def _drawn(self, above: int, least_order: int) -> Start:
        """Numbers that no other start has but by chance."""
        return Start(max(above + 1 + self._draw(_ORIGINS), least_order), self._draw(MAX_BOOTS))

    def raise_to(self, order: int) -> None:
        """Keep an order that the other side made this start take. Never raises OSError."""
        with contextlib.suppress(OSError), self._folder.lock():
            last = self._last()
            if last is not None and last[0].order < order:
                start = replace(last[0], order=order)
                self._folder.write(NAME, (1 - last[1]) * _SLOT_BYTES, _slot(start, last[2]))
                self._folder.sync(NAME)

    def _last(self) -> tuple[Start, int, str] | None:
        """The newest start, its slot, and the machine that it was on; None if no slot is sound."""
        content = self._folder.read(NAME) or b""
        found = [(*read, i) for i in (0, 1) if (read := _read(content[i * _SLOT_BYTES :][:_SLOT_BYTES])) is not None]
        if not found:
            return None
        start, machine, slot = max(found, key=lambda entry: entry[0].order)
        return start, slot, machine


def _slot(start: Start, machine: str) -> bytes:
    text = json.dumps({"order": start.order, "boot": start.boot, "machine": machine})
    digest = blake2b(text.encode(), digest_size=8).hexdigest()
    return f"{text} {digest}".encode().ljust(_SLOT_BYTES - 1) + b"\n"


def _read(slot: bytes) -> tuple[Start, str] | None:
    text, _, digest = slot.decode(errors="replace").rstrip().rpartition(" ")
    if not text or blake2b(text.encode(), digest_size=8).hexdigest() != digest:
        return None
    try:
        held = json.loads(text)
        return Start(int(held["order"]), int(held["boot"]) % MAX_BOOTS), str(held["machine"])
    except (ValueError, KeyError, TypeError):
        return None


class DiskFolder:
    """A folder of this computer."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes out. Raises OSError if the folder cannot be made."""
        self._path.mkdir(parents=True, exist_ok=True)
        fd = os.open(self._path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX)
            yield
        finally:
            os.close(fd)

    def read(self, name: str) -> bytes | None:
        """The content of a file; None if there is none."""
        try:
            return (self._path / name).read_bytes()
        except FileNotFoundError:
            return None

    def write(self, name: str, offset: int, data: bytes) -> None:
        """Write into a file, which is made if need be."""
        fd = os.open(self._path / name, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            if os.pwrite(fd, data, offset) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        finally:
            os.close(fd)

    def sync(self, name: str) -> None:
        """Wait until the content of a file is on the disk."""
        self._sync(self._path / name, os.O_RDONLY)

    def rename(self, old: str, new: str) -> None:
        """Give a file another name, in place of one that has it."""
        os.replace(self._path / old, self._path / new)

    def sync_names(self) -> None:
        """Wait until the names in the folder, and its own, are on the disk."""
        for folder in (self._path, self._path.parent):
            self._sync(folder, os.O_RDONLY | os.O_DIRECTORY)

    @staticmethod
    def _sync(path: Path, flags: int) -> None:
        fd = os.open(path, flags | os.O_CLOEXEC)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def machine_identity(root: Path = Path("/")) -> str:
    """A digest of serial number and network cards: it differs on another computer that runs a copy of the card."""
    found = []
    for name in ("proc/device-tree/serial-number", "sys/class/dmi/id/product_uuid", "etc/machine-id"):
        with contextlib.suppress(OSError):
            found.append((root / name).read_bytes())
    for card in sorted((root / "sys/class/net").glob("*")):
        with contextlib.suppress(OSError, ValueError):
            address = (card / "address").read_text().strip()
            if (card / "device").exists() and not int(address[:2], 16) & 2:  # no address drawn at random
                found.append(address.encode())
    return blake2b(b"\0".join(found), digest_size=8).hexdigest()


def numbers_in(folder: Path) -> StartNumbers:
    """The numbers that are kept in a folder of this computer."""
    return StartNumbers(DiskFolder(folder), machine_identity())
