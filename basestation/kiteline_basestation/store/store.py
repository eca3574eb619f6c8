"""The map on disk: one SQLite file in a folder, written a batch at a time, safe against a kill at any instant.

Tables: code (agent, own, kind, id, part, code), every value that an agent (own 0) or the base (own 1) wrote, as it is
shared; state (name, text), the mapper's state (see `state_texts`). A batch is one transaction, so that what is read
back is the base between two of its steps.

Write-ahead logging with synchronous=NORMAL: a commit is one write to the log without waiting for the disk. A process
that dies loses nothing that was committed, for the kernel holds it; a power cut may lose the last seconds but never
tears a batch, and what is lost then the agents send again. FULL would wait for the disk at every batch.
"""

from __future__ import annotations

import contextlib
import fcntl
import sqlite3
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_codec.schema import KEYFRAME_KINDS, SUBMAP_KINDS, Key
from kiteline_core.errors import KitelineError
from kiteline_core.ids import SEQUENCE_BITS, AgentId, SubmapId, agent_of_submap

FILE = "map.sqlite"
_APPLICATION = 0x6B6C6D70  # "klmp"
_VERSION = 3  # of the tables; a store of another version is refused
_BUSY_S = 5.0  # s to wait for a reader of the same file, such as `kiteline export`
_TABLES = """
CREATE TABLE code (
  agent INTEGER NOT NULL, own INTEGER NOT NULL, kind INTEGER NOT NULL, id INTEGER NOT NULL, part INTEGER NOT NULL,
  code BLOB NOT NULL, PRIMARY KEY (agent, own, kind, id, part)
);
CREATE TABLE state (name TEXT PRIMARY KEY, text TEXT NOT NULL) WITHOUT ROWID;
"""


def submap_of(key: Key) -> SubmapId | None:
    """The submap that a value concerns; None if it concerns no submap."""
    if key.kind in KEYFRAME_KINDS:
        return SubmapId(key.id >> SEQUENCE_BITS)
    return SubmapId(key.id) if key.kind in SUBMAP_KINDS else None


Row = tuple[int, int, int, int, int, bytes]


class StoreError(KitelineError):
    """A store that cannot be used. The text says what was found, what was expected and how to mend it."""


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
        self._lock = _take(folder)
        try:
            self._db = _open(self.path, make=True)
        except BaseException:
            self._lock.close()
            raise

    def load(self) -> SavedMap:
        """Read the whole store."""
        with _explained(self.path):
            return _read(self._db)

    def write(self, batch: Batch) -> None:
        """Write a batch, all of it or nothing."""
        with _explained(self.path), self._db:
            self._db.execute("BEGIN IMMEDIATE")
            for submap in batch.deleted:
                self._delete(submap)
            self._db.executemany(
                "DELETE FROM code WHERE agent = ? AND own = ? AND kind = ? AND id = ? AND part = ?", batch.gone
            )
            self._db.executemany("INSERT OR REPLACE INTO code VALUES (?, ?, ?, ?, ?, ?)", batch.rows)
            written = [(name, text) for name, text in batch.texts.items() if text is not None]
            self._db.executemany("INSERT OR REPLACE INTO state VALUES (?, ?)", written)
            gone = [(name,) for name, text in batch.texts.items() if text is None]
            self._db.executemany("DELETE FROM state WHERE name = ?", gone)

    def _delete(self, submap: SubmapId) -> None:
        agent, first, end = agent_of_submap(submap), submap << SEQUENCE_BITS, (submap + 1) << SEQUENCE_BITS
        for own in (0, 1):
            for kind in KEYFRAME_KINDS:
                self._db.execute(
                    "DELETE FROM code WHERE agent = ? AND own = ? AND kind = ? AND id >= ? AND id < ?",
                    (int(agent), own, int(kind), first, end),
                )
            for kind in SUBMAP_KINDS:
                self._db.execute(
                    "DELETE FROM code WHERE agent = ? AND own = ? AND kind = ? AND id = ?",
                    (int(agent), own, int(kind), int(submap)),
                )

    def close(self) -> None:
        """Close the database and unlock the folder."""
        with contextlib.suppress(sqlite3.Error):
            self._db.close()
        self._lock.close()


def read(path: Path) -> SavedMap:
    """Read a store, also while its base runs. path: its folder, or the file in it. Raises StoreError."""
    file = path / FILE if path.is_dir() else path
    if not file.is_file():
        raise StoreError(f"{file}: no such file; expected what `kiteline base --store DIR` keeps in DIR")
    db = _open(file, make=False)
    try:
        with _explained(file):
            return _read(db)
    finally:
        db.close()


def _take(folder: Path) -> IO[bytes]:
    """Lock a folder for this process, until the file is closed or the process ends."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / "lock").open("wb")
    except OSError as error:
        raise StoreError(f"{folder}: {error.strerror or error}; a store is a folder that can be written") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        raise StoreError(f"{folder}: another base uses this store; give each its own --store") from None
    return lock


def _open(path: Path, make: bool) -> sqlite3.Connection:
    with _explained(path):
        db = sqlite3.connect(path, timeout=_BUSY_S, isolation_level=None, check_same_thread=False)
        try:
            tables = db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
            application, version = (
                db.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version")
            )
            if tables and (application, version) != (_APPLICATION, _VERSION):
                what = f"version {version}" if application == _APPLICATION else "no store of a base"
                raise StoreError(
                    f"{path}: {what}, expected version {_VERSION}; begin an empty store and import the agents' logs"
                )
            if not make and not tables:
                raise StoreError(f"{path}: empty; expected a store that a base has begun")
            if make:
                db.execute("PRAGMA journal_mode = WAL")
                db.execute("PRAGMA synchronous = NORMAL")
            if make and not tables:
                marks = f"PRAGMA application_id = {_APPLICATION}; PRAGMA user_version = {_VERSION};"
                db.executescript(f"BEGIN; {marks} {_TABLES} COMMIT;")
            found = db.execute("PRAGMA quick_check(1)").fetchone()[0]
            if found != "ok":
                raise StoreError(f"{path}: damaged ({found}); put a copy in its place, or begin an empty store")
        except BaseException:
            db.close()
            raise
    return db


def _read(db: sqlite3.Connection) -> SavedMap:
    agents: dict[AgentId, tuple[dict[Key, bytes], dict[Key, bytes]]] = {}
    db.execute("BEGIN")  # both tables as they stand at one moment
    try:
        for agent, own, kind, number, part, code in db.execute("SELECT agent, own, kind, id, part, code FROM code"):
            agents.setdefault(AgentId(agent), ({}, {}))[own][Key(kind, number, part)] = code
        texts: Mapping[str, str] = dict(db.execute("SELECT name, text FROM state"))
    finally:
        db.execute("COMMIT")
    return SavedMap({agent: SavedValues(*agents[agent]) for agent in sorted(agents)}, texts)


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn errors of SQLite into StoreErrors that say how to mend them."""
    try:
        yield
    except sqlite3.DatabaseError as error:
        raise StoreError(f"{path}: {error}; expected a store of `kiteline base`, on a disk with room left") from error
