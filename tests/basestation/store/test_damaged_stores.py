"""A store that is damaged: nothing wrong is loaded, what is sound is kept, and every fault is named."""

import contextlib
import os
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_basestation.store import checksums
from kiteline_basestation.store.checksums import StoreError, sum_of
from kiteline_basestation.store.saved_map import SavedMap
from kiteline_basestation.store.store import FILE, Batch, DiskError, Store, read, repair
from kiteline_codec.schema import Key
from kiteline_core.ids import AgentId
from tests.basestation.filled_stores import change, filled
from tests.yardstick import slowness


def same_or_told(folder: Path, saved: SavedMap) -> bool:
    """True if a store is read as it was written; False if it tells what is amiss. Fails on anything else."""
    try:
        got = read(folder)
    except StoreError:
        return False
    for agent, codes in got.agents.items():
        for ours, theirs in ((saved.agents[agent].received, codes.received), (saved.agents[agent].own, codes.own)):
            assert all(ours.get(key) == code for key, code in theirs.items()), "an altered value was loaded"
    assert all(saved.texts.get(name) == text for name, text in got.texts.items()), "an altered text was loaded"
    same = (got.agents, got.texts) == (saved.agents, saved.texts)
    assert same or got.faults, "something is missing, and nothing was said"
    return same


@settings(max_examples=60)
@given(st.data())
def test_no_flipped_bit_is_loaded_silently(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("store")
    saved = filled(folder)
    content = bytearray((folder / FILE).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    (folder / FILE).write_bytes(content)
    same_or_told(folder, saved)


def altered(folder: Path) -> tuple[SavedMap, bytes]:
    """A store of which one value was altered on disk: what was written, and that value."""
    saved = filled(folder)
    code = saved.agents[AgentId(1)].received[Key(3, 89)]
    content = (folder / FILE).read_bytes()
    assert code in content
    (folder / FILE).write_bytes(content.replace(code, code[:-1] + b"?"))
    return saved, code


def test_an_altered_value_is_left_out_named_and_kept_aside(tmp_path: Path) -> None:
    saved, code = altered(tmp_path)
    size = (tmp_path / FILE).stat().st_size
    assert not same_or_told(tmp_path, saved)
    store = Store(tmp_path)
    loaded = store.load()
    assert any("89 of agent 1 was altered on disk: left out" in fault for fault in loaded.faults)
    assert Key(3, 89) not in loaded.agents[AgentId(1)].received and Key(3, 88) in loaded.agents[AgentId(1)].received
    store.write(Batch(rows=[(1, 0, 3, 89, 0, code)]))  # its agent sent it again
    store.close()
    assert read(tmp_path).faults == () and read(tmp_path).agents[AgentId(1)].received[Key(3, 89)] == code
    assert "altered" in (tmp_path / f"{FILE}.damaged-1.txt").read_text()
    assert (tmp_path / f"{FILE}.damaged-1").stat().st_size == size


@pytest.mark.parametrize("moves", range(4))
def test_a_kill_while_a_damaged_store_is_written_anew_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moves: int
) -> None:
    altered(tmp_path)
    (tmp_path / f"{FILE}-wal").touch()
    replace, left = os.replace, [moves]

    def killed(old: Path, new: Path) -> None:
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        replace(old, new)

    store = Store(tmp_path)
    monkeypatch.setattr(os, "replace", killed)
    with contextlib.suppress(KeyboardInterrupt):
        store.load()
    store._lock.close()
    monkeypatch.setattr(os, "replace", replace)
    again = Store(tmp_path)
    loaded = again.load()
    again.close()
    assert Key(3, 88) in loaded.agents[AgentId(1)].received and Key(3, 89) not in loaded.agents[AgentId(1)].received
    assert read(tmp_path).faults == () and (tmp_path / f"{FILE}.damaged-1").exists()
    assert not list(tmp_path.glob("*.fresh"))


def test_a_store_that_was_written_anew_and_could_not_be_opened_is_opened_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved, code = altered(tmp_path)
    sent_again = Batch(rows=[(1, own, 3, 89, 0, code) for own in (0, 1)])
    store = Store(tmp_path)

    def full(_: Path) -> sqlite3.Connection:
        raise DiskError("full")

    with monkeypatch.context() as disk:
        disk.setattr("kiteline_basestation.store.store._open", full)
        store.load()
        with pytest.raises(DiskError):
            store.write(sent_again)
    store.write(sent_again)
    store.close()
    assert read(tmp_path) == SavedMap(saved.agents, saved.texts)
    assert len(list(tmp_path.glob("*.damaged-?"))) == 1


def test_a_folder_without_a_store_is_not_repaired_into_an_empty_one(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "mistyped"):
        with pytest.raises(StoreError, match="no such file"):
            repair(folder)
    assert not list(tmp_path.iterdir())
    saved = filled(tmp_path)
    assert repair(tmp_path) == repair(tmp_path / FILE) == SavedMap(saved.agents, saved.texts)


def test_rows_that_are_gone_are_missed(tmp_path: Path) -> None:
    filled(tmp_path)
    change(tmp_path, "DELETE FROM code WHERE id = 7; DELETE FROM state WHERE name = 'state3'")
    faults = read(tmp_path).faults
    assert faults == ("2 rows of table code missing", "1 row of table state missing")


def test_what_is_left_of_a_damaged_file_is_taken(tmp_path: Path) -> None:
    saved = filled(tmp_path, 2000)
    content = bytearray((tmp_path / FILE).read_bytes())
    content[len(content) // 2 : len(content) // 2 + 8192] = bytes(8192)
    (tmp_path / FILE).write_bytes(content)
    store = Store(tmp_path)
    loaded = store.load()
    store.close()
    left = sum(len(codes.received) + len(codes.own) for codes in loaded.agents.values())
    assert 2000 < left < 4000 and loaded.faults
    assert read(tmp_path).agents == loaded.agents and read(tmp_path).faults == ()
    assert loaded.agents != saved.agents


@pytest.mark.parametrize("column", ["type", "name", "tbl_name", "sql"])
def test_a_schema_whose_text_became_bytes_is_refused(column: str) -> None:
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as db:
        checksums.make_tables(db)
        db.execute("PRAGMA writable_schema = ON")
        db.execute(f"UPDATE sqlite_master SET {column} = CAST({column} AS BLOB) WHERE name = 'code'")
        with pytest.raises(StoreError, match="other tables"):
            checksums.check_tables(db, Path("kept.kiteline"))


HOSTILE_SCHEMAS = [
    "CREATE VIEW more AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i FROM n",
    "DROP TABLE state; CREATE VIEW state AS SELECT hex(zeroblob(1000000000)) AS name, 1 AS text",
    "CREATE TRIGGER t AFTER INSERT ON code BEGIN DELETE FROM state; END",
    "CREATE TABLE other (a, b AS (hex(zeroblob(1000000000))))",
    "CREATE INDEX i ON code (hex(code))",
]


@pytest.mark.parametrize("sql", HOSTILE_SCHEMAS)
def test_a_store_with_views_triggers_or_computed_columns_is_refused(tmp_path: Path, sql: str) -> None:
    store = Store(tmp_path)
    store.write(Batch(rows=[(1, 0, 3, 5, 0, b"head")]))
    store.close()
    change(tmp_path, sql)
    begin = time.process_time()
    with pytest.raises(StoreError, match="other tables"):
        read(tmp_path)
    with pytest.raises(StoreError, match="other tables"):
        Store(tmp_path)
    assert time.process_time() - begin < 1.0 * slowness()


@pytest.mark.parametrize(
    "row",
    [("a", 0, 3, 5, 0, b"x"), (1, 7, 3, 5, 0, b"x"), (1, 0, 300, 5, 0, b"x"), (1, 0, 3, -5, 0, b"x"),
     (1, 0, 3, 5, 1 << 40, b"x"), (1, 0, 3, 5, 0, "text"), (1.5, 0, 3, 5, 0, b"x"), (99, 0, 3, 5, 0, b"x")],
)  # fmt: skip
def test_rows_that_no_base_writes_are_left_out(tmp_path: Path, row: tuple[object, ...]) -> None:
    """Their checksum may be right: whoever wrote them can compute it."""
    store = Store(tmp_path)
    store.write(Batch(rows=[(1, 0, 3, 5, 1, b"head")]))
    store.close()
    content = row[5] if isinstance(row[5], bytes) else str(row[5]).encode()
    with closing(sqlite3.connect(tmp_path / FILE, isolation_level=None)) as db:
        db.execute("INSERT INTO code VALUES (?, ?, ?, ?, ?, ?, ?)", (*row, sum_of(row[:5], content)))
    saved = read(tmp_path)
    assert saved.agents[AgentId(1)].received == {Key(3, 5, 1): b"head"} and saved.faults
