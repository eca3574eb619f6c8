"""Stores with some values."""

import sqlite3
from contextlib import closing
from pathlib import Path

from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_basestation.store.store import FILE, Store, batch_of
from kiteline_codec.schema import Key
from kiteline_core.ids import AgentId


def filled(folder: Path, rows: int = 200) -> SavedMap:
    """A closed store of some values and texts."""
    store = Store(folder)
    codes = {Key(3, i): bytes([i % 251]) * (i % 90 + 1) for i in range(rows)}
    texts = {f"state{i}": f"text {i} " * (i % 7 + 1) for i in range(rows // 10)}
    store.write(batch_of(SavedMap({AgentId(1): SavedValues(codes, codes)}, texts), SavedMap()))
    saved = store.load()
    store.close()
    return saved


def change(folder: Path, sql: str) -> None:
    """Alter the file of a store behind the base's back."""
    with closing(sqlite3.connect(folder / FILE)) as db:
        db.executescript(sql)
