"""The store returns what was written, in whole batches, also after the writer was killed."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_basestation.store import checksums
from kiteline_basestation.store.checksums import StoreError, sum_of
from kiteline_basestation.store.saved_map import SavedMap, SavedValues, pack, unpack
from kiteline_basestation.store.store import FILE, Batch, DiskError, Store, backup, batch_of, read, repair
from kiteline_codec.schema import GravityAlignment, Key, KeyframeHeader, RefinedLandmarks, WireError
from kiteline_core.ids import SEQUENCE_BITS, AgentId, submap_id
from tests.yardstick import slowness

keys = st.builds(Key, st.integers(0, 255), st.integers(0, 2**62), st.integers(0, 65535))
values = st.dictionaries(keys, st.binary(max_size=30), max_size=4)
codes = st.builds(SavedValues, values, values)
memory = st.dictionaries(st.text("abc/01", min_size=1, max_size=5), st.text(max_size=20), max_size=3)
maps = st.builds(SavedMap, st.dictionaries(st.integers(0, 255).map(AgentId), codes, max_size=3), memory)


def without_nothing(kept: SavedMap) -> SavedMap:
    """A store does not know agents of which it holds no value."""
    return SavedMap({a: c for a, c in kept.agents.items() if c.received or c.own}, kept.texts)


@given(maps)
def test_packing_round_trip(kept: SavedMap) -> None:
    assert unpack(pack(kept)) == kept


@given(st.binary(max_size=80))
def test_any_other_bytes_are_refused(noise: bytes) -> None:
    with pytest.raises(WireError):
        unpack(noise)


def test_a_flipped_bit_is_found() -> None:
    content = bytearray(pack(SavedMap({AgentId(1): SavedValues({Key(3, 5): b"head"}, {})})))
    content[12] ^= 1
    with pytest.raises(WireError, match="damaged"):
        unpack(bytes(content))


@settings(max_examples=25)
@given(maps, maps)
def test_batch_turns_one_map_into_another(tmp_path_factory: pytest.TempPathFactory, a: SavedMap, b: SavedMap) -> None:
    folder = tmp_path_factory.mktemp("store")
    store = Store(folder)
    store.write(batch_of(a, store.load()))
    assert store.load() == without_nothing(a)
    store.write(batch_of(b, store.load()))
    store.close()
    assert read(folder) == without_nothing(b)
    assert read(folder / FILE) == without_nothing(b)


def test_values_of_a_deleted_submap_are_removed(tmp_path: Path) -> None:
    doomed, other = submap_id(3, 1, 0), submap_id(3, 1, 1)
    received = {Key(KeyframeHeader.KIND, s << SEQUENCE_BITS | 5): b"head" for s in (doomed, other)}
    received |= {Key(GravityAlignment.KIND, s): b"level" for s in (doomed, other)}
    own = {Key(RefinedLandmarks.KIND, s << SEQUENCE_BITS | 5): b"depths" for s in (doomed, other)}
    store = Store(tmp_path)
    store.write(batch_of(SavedMap({AgentId(3): SavedValues(received, own)}), SavedMap()))
    store.write(Batch(deleted=[doomed]))
    left = store.load().agents[AgentId(3)]
    store.close()
    assert set(left.received) == {
        Key(KeyframeHeader.KIND, other << SEQUENCE_BITS | 5),
        Key(GravityAlignment.KIND, other),
    }
    assert set(left.own) == {Key(RefinedLandmarks.KIND, other << SEQUENCE_BITS | 5)}


def test_a_store_serves_one_base_and_any_number_of_readers(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.write(Batch(rows=[(1, 0, 3, 7, 0, b"x")]))
    assert read(tmp_path).agents[AgentId(1)].received == {Key(3, 7): b"x"}
    with pytest.raises(StoreError, match="another base"):
        Store(tmp_path)
    store.close()
    Store(tmp_path).close()


def test_file_that_is_no_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no such file"):
        read(tmp_path)
    (tmp_path / FILE).write_bytes(b"hello, I am no database at all")
    with pytest.raises(StoreError, match=r"map\.sqlite"):
        Store(tmp_path)
    (tmp_path / FILE).unlink()
    with sqlite3.connect(tmp_path / FILE) as db:
        db.execute("CREATE TABLE mine (a)")
    db.close()
    with pytest.raises(StoreError, match="no store of a base"):
        read(tmp_path)


def test_other_version_is_refused(tmp_path: Path) -> None:
    Store(tmp_path).close()
    with sqlite3.connect(tmp_path / FILE) as db:
        db.execute("PRAGMA user_version = 99")
    db.close()
    with pytest.raises(StoreError, match="version 99, expected version 5"):
        Store(tmp_path)


def filled(folder: Path, rows: int = 200) -> SavedMap:
    """A closed store of some values and texts."""
    store = Store(folder)
    codes = {Key(3, i): bytes([i % 251]) * (i % 90 + 1) for i in range(rows)}
    texts = {f"state{i}": f"text {i} " * (i % 7 + 1) for i in range(rows // 10)}
    store.write(batch_of(SavedMap({AgentId(1): SavedValues(codes, codes)}, texts), SavedMap()))
    saved = store.load()
    store.close()
    return saved


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


def test_an_altered_value_is_left_out_named_and_kept_aside(tmp_path: Path) -> None:
    saved = filled(tmp_path)
    content = (tmp_path / FILE).read_bytes()
    code = saved.agents[AgentId(1)].received[Key(3, 89)]
    assert content.count(code) >= 1
    (tmp_path / FILE).write_bytes(content.replace(code, code[:-1] + b"?"))
    assert not same_or_told(tmp_path, saved)
    store = Store(tmp_path)
    loaded = store.load()
    assert any("89 of agent 1 was altered on disk: left out" in fault for fault in loaded.faults)
    assert Key(3, 89) not in loaded.agents[AgentId(1)].received and Key(3, 88) in loaded.agents[AgentId(1)].received
    store.write(Batch(rows=[(1, 0, 3, 89, 0, code)]))  # its agent sent it again
    store.close()
    assert read(tmp_path).faults == () and read(tmp_path).agents[AgentId(1)].received[Key(3, 89)] == code
    assert "altered" in (tmp_path / f"{FILE}.damaged-1.txt").read_text()
    assert (tmp_path / f"{FILE}.damaged-1").stat().st_size == len(content)


@pytest.mark.parametrize("moves", range(4))
def test_a_kill_while_a_damaged_store_is_written_anew_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moves: int
) -> None:
    saved = filled(tmp_path)
    content = (tmp_path / FILE).read_bytes()
    code = saved.agents[AgentId(1)].received[Key(3, 89)]
    (tmp_path / FILE).write_bytes(content.replace(code, code[:-1] + b"?"))
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
    saved = filled(tmp_path)
    content = (tmp_path / FILE).read_bytes()
    code = saved.agents[AgentId(1)].received[Key(3, 89)]
    (tmp_path / FILE).write_bytes(content.replace(code, code[:-1] + b"?"))
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
    with sqlite3.connect(tmp_path / FILE) as db:
        db.execute("DELETE FROM code WHERE id = 7")
        db.execute("DELETE FROM state WHERE name = 'state3'")
    db.close()
    faults = read(tmp_path).faults
    assert faults == ("2 rows of table code are missing", "1 rows of table state are missing")


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


def test_a_store_with_views_or_other_tables_is_refused(tmp_path: Path) -> None:
    filled(tmp_path)
    with sqlite3.connect(tmp_path / FILE) as db:
        db.execute("CREATE VIEW mine AS SELECT * FROM code")
    db.close()
    with pytest.raises(StoreError, match="other tables"):
        read(tmp_path)


@pytest.mark.parametrize("column", ["type", "name", "tbl_name", "sql"])
def test_a_schema_whose_text_became_bytes_is_refused(column: str) -> None:
    db = sqlite3.connect(":memory:", isolation_level=None)
    checksums.make_tables(db)
    db.execute("PRAGMA writable_schema = ON")
    db.execute(f"UPDATE sqlite_master SET {column} = CAST({column} AS BLOB) WHERE name = 'code'")
    with pytest.raises(StoreError, match="other tables"):
        checksums.check_tables(db, Path("kept.kiteline"))


def test_a_backup_equals_its_store_also_while_a_base_writes(tmp_path: Path) -> None:
    saved = filled(tmp_path / "store")
    store = Store(tmp_path / "store")
    store.write(Batch(rows=[(2, 0, 3, 1, 0, b"newest")]))
    backup(tmp_path / "store", tmp_path / "copy")
    store.close()
    copy = read(tmp_path / "copy")
    assert copy.agents == {**saved.agents, AgentId(2): SavedValues({Key(3, 1): b"newest"}, {})}
    assert copy.texts == saved.texts and copy.faults == ()
    with pytest.raises(StoreError, match="a store already"):
        backup(tmp_path / "store", tmp_path / "copy")


READ_ONLY = """
import sys
from pathlib import Path
from kiteline_basestation.store.keeper import Keeper
from kiteline_basestation.store.store import read
folder = Path(sys.argv[1])
saved = read(folder)
assert len(saved.agents) == 2 and not saved.faults, saved
keeper = Keeper(folder)
assert keeper.load() == saved
"""


@pytest.mark.parametrize("log", [False, True])
def test_a_store_on_read_only_media_is_read(tmp_path: Path, log: bool) -> None:
    folder = tmp_path / "store"
    filled(folder)
    store = Store(folder)
    store.write(Batch(rows=[(2, 0, 3, 1, 0, b"newest")]))
    if log:  # as after a power cut: the newest batch stands in the write-ahead log
        shutil.copytree(folder, tmp_path / "cut")
    store.close()
    place = tmp_path / "cut" if log else folder
    assert (place / f"{FILE}-wal").exists() == log
    (place / f"{FILE}-shm").unlink(missing_ok=True)
    command = f"mount --bind {place} {place} && mount -o remount,ro,bind {place} && exec {sys.executable} - {place}"
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", command], input=READ_ONLY, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    if "unshare" in done.stderr or "mount" in done.stderr:
        pytest.skip("no file systems can be mounted here")
    assert done.returncode == 0, done.stderr
    assert "not stored until that is mended" in done.stderr


def write_for_ever(folder: str) -> None:
    """Batches in which every value is the number of the batch."""
    store = Store(Path(folder))
    number = 0
    while True:
        number += 1
        text = str(number)
        store.write(Batch(rows=[(1, 0, 3, i, 0, text.encode()) for i in range(300)], texts={"a": text, "b": text}))


def begun(folder: Path) -> bool:
    """Whether a batch stands in a store."""
    try:
        return bool(read(folder).texts)
    except StoreError:
        return False


@pytest.mark.parametrize("delay_s", [0.05, 0.11, 0.17])
def test_a_kill_leaves_a_whole_batch(tmp_path: Path, delay_s: float) -> None:
    process = multiprocessing.get_context("spawn").Process(target=write_for_ever, args=(str(tmp_path),), daemon=True)
    process.start()
    deadline_s = time.monotonic() + 30.0
    while not begun(tmp_path):
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
    time.sleep(delay_s)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    store = Store(tmp_path)
    kept = store.load()
    store.close()
    written = {code.decode() for code in kept.agents[AgentId(1)].received.values()} | set(kept.texts.values())
    assert len(written) == 1
    assert len(kept.agents[AgentId(1)].received) == 300


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
    with sqlite3.connect(tmp_path / FILE) as db:
        db.executescript(sql)
    db.close()
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
    with sqlite3.connect(tmp_path / FILE) as db:
        db.execute("INSERT INTO code VALUES (?, ?, ?, ?, ?, ?, ?)", (*row, sum_of(row[:5], content)))
    db.close()
    saved = read(tmp_path)
    assert saved.agents[AgentId(1)].received == {Key(3, 5, 1): b"head"} and saved.faults
