"""The map on disk: one SQLite file in a folder, written a batch at a time, safe against a kill at any instant.

Tables: code (agent, own, kind, id, part, code, sum), every value that an agent (own 0) or the base (own 1) wrote, as it
is shared; state (name, text, sum), the mapper's state (see `state_texts`); total (name, rows, sum), of each of them. A
batch is one transaction, so that what is read back is the base between two of its steps.

Every row has a checksum, and the totals tell of rows that are gone (`checksums`): what a disk altered is left out and
named, never loaded. A file with such faults is kept beside the store, which is written anew (`salvage`).

Write-ahead logging with synchronous=NORMAL: a commit is one write to the log without waiting for the disk. A process
that dies loses nothing that was committed, for the kernel holds it; a power cut may lose the last seconds but never
tears a batch, and what is lost then the agents send again. FULL would wait for the disk at every batch.
"""

import contextlib
import errno
import fcntl
import os
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from kiteline_basestation.store import checksums, salvage
from kiteline_basestation.store.checksums import Row, StoreError
from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_codec.schema import KEYFRAME_KINDS, SUBMAP_KINDS
from kiteline_core.errors import INPUT_FAULTS
from kiteline_core.ids import SEQUENCE_BITS, SubmapId, agent_of_submap

FILE = "map.sqlite"
_LOCK = "lock"
_LEFT_OPEN: list[sqlite3.Connection] = []  # until the process ends: a connection that nothing holds is closed
_BUSY_S = 5.0  # s to wait for a reader of the same file, such as `kiteline export`
_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO}


class DiskError(StoreError):
    """A store that cannot be written now, as its disk is full, read-only or failing."""


@dataclass(slots=True)
class Batch:
    """Changes since the last batch. texts: None removes a text. deleted: submaps whose values are removed."""

    rows: list[Row] = field(default_factory=list)
    gone: list[tuple[int, int, int, int, int]] = field(default_factory=list)  # rows without their codes
    texts: dict[str, str | None] = field(default_factory=dict)
    deleted: list[SubmapId] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.rows or self.gone or self.texts or self.deleted)


def batch_of(saved: SavedMap, held: SavedMap) -> Batch:
    """The changes from the stored map `held` to the map `saved`."""
    out = Batch()
    for agent in sorted(saved.agents.keys() | held.agents.keys()):
        codes, before = (side.agents.get(agent, SavedValues({}, {})) for side in (saved, held))
        for own, (new, old) in enumerate(((codes.received, before.received), (codes.own, before.own))):
            out.gone += [(int(agent), own, key.kind, key.id, key.part) for key in sorted(old.keys() - new.keys())]
            out.rows += [
                (int(agent), own, key.kind, key.id, key.part, new[key])
                for key in sorted(new)
                if old.get(key) != new[key]
            ]
    out.texts.update({name: text for name, text in saved.texts.items() if held.texts.get(name) != text})
    out.texts.update(dict.fromkeys(held.texts.keys() - saved.texts.keys()))
    return out


class Store:
    """One base's store. Raises StoreError. Everything after the constructor may be called from another thread."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE
        self._folder = folder
        self._lock = _take(folder)
        self._damaged: SavedMap | None = None  # what is left of a damaged file that could not be written anew yet
        self._renewed = False  # its file was, and is not open yet
        try:
            with _explained(self.path):
                salvage.finish(self.path)
            self._connect()
        except BaseException:
            self._lock.close()
            raise

    def _connect(self) -> None:
        self._db = _open(self.path)
        with _explained(self.path):
            self._file = self.path.stat()

    @property
    def displaced(self) -> bool:
        """True if the file was deleted or moved: SQLite writes on in it, where nobody finds it."""
        return self._damaged is None and not _names(self.path, self._file)

    def put_back(self) -> None:
        """Write the store anew where its file was deleted or moved. Raises StoreError."""
        with _explained(self.path):
            if self.path.exists():
                raise StoreError(
                    f"{self.path}: another file is in the place of this base's: move it away, or start the base again"
                )
            if not _names(self._folder / _LOCK, os.fstat(self._lock.fileno())):
                lock = _take(self._folder)
                self._lock.close()
                self._lock = lock
            salvage.put_back(self.path, self._db)
            self._db.close()  # which removes, by their names, the files that SQLite keeps beside a database
            self._connect()

    def load(self) -> SavedMap:
        """Read the whole store. If it has faults, it is written anew from what is sound, as soon as the disk allows."""
        with _explained(self.path):
            saved = checksums.read_all(self._db, self.path)
        if saved.faults:
            self._damaged = saved
            with contextlib.suppress(StoreError):
                self._renew()
        return saved

    def _renew(self) -> None:
        """Write a damaged store anew; the damaged file is kept beside it."""
        if self._damaged is not None:
            with _explained(self.path):
                self._db.close()
                if not self._renewed:
                    salvage.renew(self.path, self._damaged)
                    self._renewed = True
            self._connect()
            self._damaged = None

    def write(self, batch: Batch) -> None:
        """Write a batch, all of it or nothing."""
        self._renew()
        with _explained(self.path), self._db:
            self._db.execute("BEGIN IMMEDIATE")
            with checksums.Changes(self._db) as changes:
                for submap in batch.deleted:
                    self._delete(changes, submap)
                for row in batch.gone:
                    changes.remove_code("agent = ? AND own = ? AND kind = ? AND id = ? AND part = ?", row)
                for values in batch.rows:
                    changes.put_code(values)
                for name, text in batch.texts.items():
                    changes.put_text(name, text)

    def _delete(self, changes: checksums.Changes, submap: SubmapId) -> None:
        agent, first, end = int(agent_of_submap(submap)), submap << SEQUENCE_BITS, (submap + 1) << SEQUENCE_BITS
        for own in (0, 1):
            for kind in KEYFRAME_KINDS:
                changes.remove_code(
                    "agent = ? AND own = ? AND kind = ? AND id >= ? AND id < ?", (agent, own, int(kind), first, end)
                )
            for kind in SUBMAP_KINDS:
                changes.remove_code(
                    "agent = ? AND own = ? AND kind = ? AND id = ?", (agent, own, int(kind), int(submap))
                )

    def close(self) -> None:
        """Close the database and unlock the folder."""
        if self.displaced:  # SQLite would remove the write-ahead log of the file that took its name
            _LEFT_OPEN.append(self._db)
        else:
            with contextlib.suppress(sqlite3.Error):
                self._db.close()
        self._lock.close()


def _names(path: Path, file: os.stat_result) -> bool:
    """True if a path names a file, or a disk that fails does not tell."""
    try:
        return os.path.samestat(path.stat(), file)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True


def read(path: Path) -> SavedMap:
    """Read a store, also while its base runs, and from read-only media. Raises StoreError.

    path: its folder, or the file in it. What the disk altered is left out and named in `faults`.
    """
    file = path / FILE if path.is_dir() else path
    if not file.is_file():
        raise StoreError(f"{file}: no such file; expected what `kiteline base --store DIR` keeps in DIR")
    with _explained(file), salvage.reader(file, _BUSY_S) as db:
        checksums.check_tables(db, file)
        return checksums.read_all(db, file)


def backup(path: Path, out: Path) -> SavedMap:
    """Copy a store, also while its base runs. out: a folder without a store. Returns what the copy holds."""
    file, copy = path / FILE if path.is_dir() else path, out / FILE
    if copy.exists():
        raise StoreError(f"{copy}: there is a store already; expected a new folder")
    saved, made = read(path), _missing_folders(out)
    try:
        salvage.write_new(copy, saved)
    except (OSError, sqlite3.Error) as error:
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise StoreError(f"{copy}: {error}; the backup was not made") from None
    if read(out) != SavedMap(saved.agents, saved.texts):
        raise StoreError(f"{copy}: the copy differs from {file}: is its disk sound?")
    return saved


def _missing_folders(folder: Path) -> list[Path]:
    """A folder and those above it that are not there yet, innermost first."""
    return [place for place in (folder, *folder.parents) if not place.exists()]


def repair(folder: Path) -> SavedMap:
    """Write a store with faults anew, from what is sound. Returns what it holds, with its faults. Raises StoreError."""
    folder = folder if folder.is_dir() else folder.parent
    if not any((folder / name).exists() for name in (FILE, salvage.fresh(folder / FILE).name)):
        raise StoreError(f"{folder / FILE}: no such file; expected what `kiteline base --store DIR` keeps in DIR")
    store = Store(folder)
    try:
        saved = store.load()
        store.write(Batch())  # raises if it could not be written
    finally:
        store.close()
    return saved


def _take(folder: Path) -> IO[bytes]:
    """Lock a folder for this process, until the file is closed or the process ends."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / _LOCK).open("wb")
    except OSError as error:
        kind = DiskError if error.errno in _DISK else StoreError
        raise kind(f"{folder}: {error.strerror or error}; a store is a folder that can be written") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        raise StoreError(
            f"{folder}: a base uses this store: stop it first, or give each base its own --store"
        ) from None
    return lock


def _open(path: Path) -> sqlite3.Connection:
    with _explained(path):
        db = sqlite3.connect(path, timeout=_BUSY_S, isolation_level=None, check_same_thread=False)
        try:
            if db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                checksums.check_tables(db, path)
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = NORMAL")
            checksums.make_tables(db)
        except BaseException:
            db.close()
            raise
    return db


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn errors of SQLite and of files into StoreErrors that say how to mend them."""
    try:
        yield
    except sqlite3.OperationalError as error:
        raise DiskError(f"{path}: {error}; expected a disk with room left that can be written") from error
    except (sqlite3.DatabaseError, UnicodeDecodeError, *INPUT_FAULTS) as error:
        raise StoreError(f"{path}: {error}; expected a store of `kiteline base`: put a backup in its place") from error
    except OSError as error:
        raise DiskError(f"{path}: {error.strerror or error}") from error
