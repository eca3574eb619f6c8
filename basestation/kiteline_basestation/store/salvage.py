"""Files of a store that were damaged or taken away, or cannot be written: read as they are, written anew."""

import contextlib
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path

from kiteline_basestation.store import checksums
from kiteline_basestation.store.saved_map import SavedMap
from kiteline_hw.durable_files import sync_folder

_BESIDE = ("-wal", "-shm")  # files that SQLite keeps beside a database


@contextlib.contextmanager
def reader(file: Path, busy_s: float) -> Iterator[sqlite3.Connection]:
    """A connection that only reads.

    SQLite wants to write beside a database with a write-ahead log. Where it cannot, the file is read as it is, or with
    its log from a copy in the temporary folder. Raises sqlite3.Error, OSError.
    """
    with contextlib.ExitStack() as stack:
        try:
            db = _connected(file, "mode=ro", busy_s)
        except sqlite3.OperationalError:
            log = file.with_name(file.name + "-wal")
            if not log.exists() or log.stat().st_size == 0:
                db = _connected(file, "mode=ro&immutable=1", busy_s)
            else:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kiteline-store-")))
                for path in (file, log):
                    shutil.copyfile(path, folder / path.name)
                db = _connected(folder / file.name, "mode=rw", busy_s)
        stack.callback(db.close)
        yield db


def _connected(file: Path, how: str, busy_s: float) -> sqlite3.Connection:
    db = sqlite3.connect(f"{file.absolute().as_uri()}?{how}", uri=True, timeout=busy_s, isolation_level=None)
    try:
        db.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except BaseException:
        db.close()
        raise
    return db


def write_new(path: Path, saved: SavedMap) -> None:
    """Write a store of a map, all of it or nothing, and wait for the disk. Raises OSError, sqlite3.Error."""
    with _new(path) as db:
        checksums.make_tables(db)
        checksums.write_all(db, saved)


def put_back(path: Path, db: sqlite3.Connection) -> None:
    """Copy an open database, whose file has lost its name, to where it was. Raises OSError, sqlite3.Error."""
    with _new(path) as copy:
        db.backup(copy)
        copy.execute("PRAGMA journal_mode = DELETE")
        for end in _BESIDE:  # they would be read as belonging to the new file
            path.with_name(path.name + end).unlink(missing_ok=True)


@contextlib.contextmanager
def _new(path: Path) -> Iterator[sqlite3.Connection]:
    """An empty database that takes its name once it is whole and on the disk, or leaves nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(path.name + ".new")
    new.unlink(missing_ok=True)
    try:
        with contextlib.closing(sqlite3.connect(new, isolation_level=None)) as db:
            yield db
        os.replace(new, path)
    finally:
        new.unlink(missing_ok=True)
    sync_folder(path.parent)


def renew(path: Path, saved: SavedMap) -> Path:
    """Put a new file with a map in the place of a damaged one, which is kept. Returns where."""
    write_new(fresh(path), saved)
    kept = _exchange(path)
    with contextlib.suppress(OSError):
        kept.with_name(kept.name + ".txt").write_text("".join(f"{fault}\n" for fault in saved.faults))
    sync_folder(path.parent)
    return kept


def finish(path: Path) -> None:
    """Go on with a `renew` that was cut short, if one was: its new file is whole as soon as it has its name."""
    if fresh(path).exists():
        _exchange(path)
        sync_folder(path.parent)


def fresh(path: Path) -> Path:
    """The file that is to take the place of a damaged one."""
    return path.with_name(path.name + ".fresh")


def _exchange(path: Path) -> Path:
    """Move a damaged file away, as far as it is there, and the new one into its place. Returns where it is kept."""
    number = 1
    while (kept := path.with_name(f"{path.name}.damaged-{number}")).exists():
        number += 1
    for end in ("", *_BESIDE):
        with contextlib.suppress(FileNotFoundError):
            os.replace(path.with_name(path.name + end), kept.with_name(kept.name + end))
    os.replace(fresh(path), path)
    return kept
