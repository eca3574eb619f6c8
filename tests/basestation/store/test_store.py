"""The store returns what was written, in whole batches, also after the writer was killed."""

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
from kiteline_basestation.store.checksums import StoreError
from kiteline_basestation.store.saved_map import SavedMap, SavedValues, pack, unpack
from kiteline_basestation.store.store import FILE, Batch, Store, backup, batch_of, read
from kiteline_codec.schema import GravityAlignment, Key, KeyframeHeader, RefinedLandmarks, WireError
from kiteline_core.ids import SEQUENCE_BITS, AgentId, submap_id
from tests.basestation.filled_stores import change, filled

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
    with pytest.raises(StoreError, match="a base uses this store"):
        Store(tmp_path)
    store.close()
    Store(tmp_path).close()


@pytest.mark.parametrize("name", ["two words", "a?b#c%20", "two\nlines", "\udcff"])
def test_a_store_in_a_folder_of_any_name(name: str, tmp_path: Path) -> None:
    Store(tmp_path / name).close()
    assert read(tmp_path / name) == SavedMap()
    assert backup(tmp_path / name, tmp_path / f"{name}2") == SavedMap()


def test_file_that_is_no_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no such file"):
        read(tmp_path)
    (tmp_path / FILE).write_bytes(b"hello, I am no database at all")
    with pytest.raises(StoreError, match=r"map\.sqlite"):
        Store(tmp_path)
    (tmp_path / FILE).unlink()
    change(tmp_path, "CREATE TABLE mine (a)")
    with pytest.raises(StoreError, match="no store of a base"):
        read(tmp_path)


def test_other_version_is_refused(tmp_path: Path) -> None:
    Store(tmp_path).close()
    change(tmp_path, "PRAGMA user_version = 99")
    with pytest.raises(StoreError, match="version 99, expected version 5"):
        Store(tmp_path)


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


def test_a_backup_that_no_disk_takes_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(db: sqlite3.Connection, saved: SavedMap) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    filled(tmp_path / "store")
    (tmp_path / "mine").mkdir()
    monkeypatch.setattr(checksums, "write_all", full)
    for folder in ("new/copy", "mine/copy", "mine"):
        with pytest.raises(StoreError, match="disk is full; the backup was not made"):
            backup(tmp_path / "store", tmp_path / folder)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "store"]
    assert not list((tmp_path / "mine").iterdir())


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
