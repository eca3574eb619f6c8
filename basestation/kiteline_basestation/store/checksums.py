"""Rows of the store with their checksums: what a disk altered or lost is found when it is read.

A row's checksum is BLAKE2b of 8 bytes over its key and its content. The totals hold the number of rows and the sum of
their checksums modulo 2^64, so that a row that is gone is missed.
"""

import contextlib
import hashlib
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from kiteline_basestation.store.saved_map import SavedMap, SavedValues, value_name
from kiteline_codec.schema import Key
from kiteline_core.errors import KitelineError
from kiteline_core.ids import MAX_AGENTS, AgentId
from kiteline_core.wording import counted

_APPLICATION = 0x6B6C6D70  # "klmp"
VERSION = 5  # of the tables; a store of another version is refused
_SUM_BYTES = 8
_TABLES = """
CREATE TABLE code (
  agent INTEGER NOT NULL, own INTEGER NOT NULL, kind INTEGER NOT NULL, id INTEGER NOT NULL, part INTEGER NOT NULL,
  code BLOB NOT NULL, sum INTEGER NOT NULL, PRIMARY KEY (agent, own, kind, id, part)
);
CREATE TABLE state (name TEXT PRIMARY KEY, text TEXT NOT NULL, sum INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE total (name TEXT PRIMARY KEY, rows INTEGER NOT NULL, sum INTEGER NOT NULL) WITHOUT ROWID;
INSERT INTO total VALUES ('code', 0, 0), ('state', 0, 0);
"""

Row = tuple[int, int, int, int, int, bytes]
_LIMITS = (MAX_AGENTS - 1, 1, 255, (1 << 63) - 1, 0xFFFF)  # agent, own, kind, id, part


class StoreError(KitelineError):
    """A store that cannot be used. The text says what was found, what was expected and how to mend it."""


class EmptyStoreError(StoreError):
    """A file without tables: a disk that was full left it so."""


def sum_of(key: Sequence[object], content: bytes) -> int:
    """The checksum of a row. key: all columns before its content."""
    named = "/".join(map(repr, key)).encode(errors="replace")
    digest = hashlib.blake2b(named + b"\0" + content, digest_size=_SUM_BYTES, person=b"kiteline-store")
    return int.from_bytes(digest.digest(), "little", signed=True)


def _wrapped(number: int) -> int:
    """A number modulo 2^64 as SQLite holds it."""
    return (number + (1 << 63)) % (1 << 64) - (1 << 63)


def make_tables(db: sqlite3.Connection) -> None:
    """Make the tables of an empty store."""
    if not db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
        marks = f"PRAGMA application_id = {_APPLICATION}; PRAGMA user_version = {VERSION};"
        db.executescript(f"BEGIN; {marks} {_TABLES} COMMIT;")


def check_tables(db: sqlite3.Connection, path: Path) -> None:
    """Check that a file is a store of this version, with its tables and nothing else. Raises StoreError."""
    application, version = (db.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version"))
    found = _schema(db)
    if not found:
        raise EmptyStoreError(f"{path}: empty; expected a store that a base has begun")
    if (application, version) != (_APPLICATION, VERSION):
        what = f"version {version}" if application == _APPLICATION else "no store of a base"
        raise StoreError(
            f"{path}: {what}, expected version {VERSION}; begin an empty store and import logs of this version"
        )
    with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as made:
        make_tables(made)
        expected = _schema(made)
    if found != expected:
        raise StoreError(f"{path}: other tables than a store has: damaged, or changed by someone; put a backup there")


def _schema(db: sqlite3.Connection) -> list[tuple[Any, ...]]:
    """The tables, in one order; a flipped bit may have made one of the texts bytes."""
    found = map(tuple, db.execute("SELECT type, name, tbl_name, ifnull(sql, '') FROM sqlite_master"))
    return sorted(found, key=repr)


class Changes:
    """Changes of a transaction; the totals follow at its end."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db
        self._rows = {"code": 0, "state": 0}  # by which the totals change
        self._sums = {"code": 0, "state": 0}

    def __enter__(self) -> "Changes":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            return
        for table, change in self._rows.items():
            rows, total = self._db.execute("SELECT rows, sum FROM total WHERE name = ?", (table,)).fetchone()
            self._db.execute(
                "UPDATE total SET rows = ?, sum = ? WHERE name = ?",
                (rows + change, _wrapped(total + self._sums[table]), table),
            )

    def remove_code(self, where: str, values: Sequence[int]) -> None:
        """Remove rows. where: a condition with parameters."""
        self._removed("code", self._db.execute(f"DELETE FROM code WHERE {where} RETURNING sum", values))

    def put_code(self, row: Row) -> None:
        """Put a value in place of an older one."""
        self.remove_code("agent = ? AND own = ? AND kind = ? AND id = ? AND part = ?", row[:5])
        added = sum_of(row[:5], row[5])
        self._db.execute("INSERT INTO code VALUES (?, ?, ?, ?, ?, ?, ?)", (*row, added))
        self._added("code", added)

    def put_text(self, name: str, text: str | None) -> None:
        """Put a text in place of an older one; None only removes it."""
        self._removed("state", self._db.execute("DELETE FROM state WHERE name = ? RETURNING sum", (name,)))
        if text is not None:
            added = sum_of((name,), text.encode())
            self._db.execute("INSERT INTO state VALUES (?, ?, ?)", (name, text, added))
            self._added("state", added)

    def _added(self, table: str, added: int) -> None:
        self._rows[table] += 1
        self._sums[table] += added

    def _removed(self, table: str, rows: sqlite3.Cursor) -> None:
        for (gone,) in rows.fetchall():
            self._rows[table] -= 1
            self._sums[table] -= gone


def read_all(db: sqlite3.Connection, path: Path) -> SavedMap:
    """Every sound row of a store; its faults name the others."""
    faults: list[str] = []
    agents: dict[AgentId, tuple[dict[Key, bytes], dict[Key, bytes]]] = {}
    texts: dict[str, str] = {}
    db.text_factory = lambda data: data.decode(errors="replace")
    db.execute("BEGIN")  # all tables as they stand at one moment
    try:
        found = _structure(db)
        if found != "ok":
            faults.append(f"{path.name} is damaged ({found})")
        count = total = 0
        columns = "agent, own, kind, id, part, code, sum"
        for row in _rows(db, columns, "code", "rowid", faults):
            count += 1
            if not _is_value(row) or sum_of(row[:5], row[5]) != row[6]:
                faults.append(f"{_row_name(row)} was altered on disk: left out")
                continue
            agent, own, kind, number, part, code, own_sum = row
            total += own_sum
            agents.setdefault(AgentId(agent), ({}, {}))[own][Key(kind, number, part)] = code
        faults += _missed(db, "code", count, total, faults)
        count = total = 0
        altered: list[str] = []
        for name, text, own_sum in _rows(db, "name, text, sum", "state", "name", altered):
            count += 1
            if not isinstance(text, str) or sum_of((name,), text.encode(errors="replace")) != own_sum:
                altered.append(f"state {name!r} was altered on disk: left out")
                continue
            total += own_sum
            texts[name] = text
        faults += [*altered, *_missed(db, "state", count, total, altered)]
    finally:
        if db.in_transaction:
            with contextlib.suppress(sqlite3.DatabaseError):
                db.execute("ROLLBACK")
    return SavedMap({a: SavedValues(*agents[a]) for a in sorted(agents)}, texts, tuple(faults))


def _is_value(row: Sequence[Any]) -> bool:
    """True if a row has the types and ranges that a base writes; SQLite keeps any type in any column."""
    fits = all(type(n) is int and 0 <= n <= limit for n, limit in zip(row[:5], _LIMITS))
    return fits and type(row[5]) is bytes


def _structure(db: sqlite3.Connection) -> str:
    try:
        return str(db.execute("PRAGMA integrity_check(1)").fetchone()[0])
    except sqlite3.DatabaseError as error:
        return str(error)


def _rows(db: sqlite3.Connection, columns: str, table: str, order: str, faults: list[str]) -> Iterator[tuple[Any, ...]]:
    """The rows of a table from its beginning; behind a page that cannot be read, from its end."""
    seen = set[object]()
    for direction in ("ASC", "DESC"):
        try:
            for row in db.execute(f"SELECT {order}, {columns} FROM {table} NOT INDEXED ORDER BY {order} {direction}"):
                if row[0] in seen:
                    return
                seen.add(row[0])
                yield row[1:]
            return
        except sqlite3.DatabaseError as error:
            if direction == "ASC":
                faults.append(f"not all of table {table} can be read ({error})")


def _missed(db: sqlite3.Connection, table: str, count: int, total: int, faults: Sequence[str]) -> list[str]:
    """A fault if rows are missing, or the totals are altered."""
    try:
        found = db.execute("SELECT rows, sum FROM total WHERE name = ?", (table,)).fetchone()
    except sqlite3.DatabaseError:
        found = None
    rows, expected = found or (None, None)
    if rows is not None and isinstance(rows, int) and rows > count:
        return [f"{counted(rows - count, 'row')} of table {table} missing"]
    if rows == count and (faults or expected == _wrapped(total)):
        return []
    return [f"table {table} has {counted(count, 'row')}, and its totals say {rows}: altered on disk"]


def _row_name(row: Sequence[Any]) -> str:
    agent, own, kind, number, part = row[:5]
    writer = "of the base for agent" if own else "of agent"
    if isinstance(kind, int) and isinstance(number, int) and isinstance(part, int):
        return f"{value_name(Key(kind, number, part))} {writer} {agent}"
    return f"value {number!r} {writer} {agent!r}"


def write_all(db: sqlite3.Connection, saved: SavedMap) -> None:
    """Write a whole map into empty tables."""
    with db:
        db.execute("BEGIN IMMEDIATE")
        with Changes(db) as changes:
            for agent, values in saved.agents.items():
                for own, codes in enumerate((values.received, values.own)):
                    for key, code in codes.items():
                        changes.put_code((int(agent), own, key.kind, key.id, key.part, code))
            texts: Mapping[str, str] = saved.texts
            for name, text in texts.items():
                changes.put_text(name, text)
