"""The keeper writes batches in order, repeats failed writes and does not block the loop."""

import itertools
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.station import Import, Station
from kiteline_basestation.store import checksums
from kiteline_basestation.store import keeper as keeper_module
from kiteline_basestation.store.checksums import StoreError
from kiteline_basestation.store.keeper import WRITE_NS, Keeper
from kiteline_basestation.store.saved_map import SavedMap
from kiteline_basestation.store.store import FILE, Batch, Store, read
from kiteline_codec.channel import CodedChannel, coded_channel
from kiteline_codec.schema import KeyframeHeader, messages
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.resumption import agent_session
from kiteline_core.ids import AgentId

MakeFlight = Callable[..., Any]


class FlightSummary:
    """A station that hears of one keyframe a step, and its keeper."""

    def __init__(self, flight: Any, folder: Path) -> None:
        self.flight = flight
        self.station = Station(BaseConfig(), lambda agent: CodedChannel(SyncConfig(), 1))
        self.keeper = Keeper(folder)
        self.keeper.begin(self.station, SavedMap(), SavedMap())

    def step(self, n: int) -> None:
        codes = tuple((messages.key(r), messages.encode(r)) for r in self.flight.records[n])
        self.station.step({}, (), n * WRITE_NS, [Import(self.flight.agent, codes)])
        self.keeper.write_changes(self.station, n * WRITE_NS)


def kept_heads(folder: Path) -> int:
    return sum(key.kind == KeyframeHeader.KIND for codes in read(folder).agents.values() for key in codes.received)


def test_failed_writes_are_repeated(
    make_flight: MakeFlight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(keeper_module, "_RETRY_S", 0.02)
    flown, write, refused = FlightSummary(make_flight(keyframes=6, turns=0.1), tmp_path), Store.write, []

    def sometimes(store: Store, batch: Batch) -> None:
        if len(refused) < 3:
            refused.append(batch)
            raise StoreError("the disk is full")
        write(store, batch)

    monkeypatch.setattr(Store, "write", sometimes)
    for n in range(6):
        flown.step(n)
        time.sleep(0.01)
    flown.keeper.close(flown.station)
    assert refused[0] is refused[1] is refused[2], "the same batch is tried again"
    assert kept_heads(tmp_path) == 6
    assert capsys.readouterr().err.count("the disk is full") == 1


def test_slow_disk_does_not_block_the_loop(
    make_flight: MakeFlight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown, write, go = FlightSummary(make_flight(keyframes=12, turns=0.2), tmp_path), Store.write, threading.Event()

    def slow(store: Store, batch: Batch) -> None:
        go.wait(20.0)
        write(store, batch)

    monkeypatch.setattr(Store, "write", slow)
    for n in range(12):
        flown.step(n)  # returns while the first batch is still being written
    assert flown.keeper.batches == 1
    go.set()
    flown.keeper.close(flown.station)
    assert flown.keeper.batches == 2
    assert kept_heads(tmp_path) == 12


def test_what_an_agent_wrote_before_it_restarted_is_stored(make_flight: MakeFlight, tmp_path: Path) -> None:
    """While the disk is stuck, changes of two sessions of the agent wait for one batch."""
    base_end = coded_channel(1, peer=AgentId(0))
    station, keeper = Station(BaseConfig(), lambda agent: base_end), Keeper(tmp_path)
    keeper.begin(station, SavedMap(), SavedMap())
    clock = itertools.count(0, WRITE_NS)
    for boot in (1, 2):
        agent_end, packets = coded_channel(agent_session(boot, boot)), ()
        for record in make_flight(keyframes=6, turns=0.1, boot=boot).all_records():
            agent_end.put(record)
        for now_ns in itertools.islice(clock, 40):
            agent_end.receive(packets, now_ns)
            packets = dict(station.step({AgentId(0): agent_end.poll(now_ns)}, (), now_ns).packets)[AgentId(0)]
    assert keeper.close(station)
    assert kept_heads(tmp_path) == 12


@pytest.mark.parametrize("left", [b"", b"header"])
def test_a_first_start_on_a_full_disk_begins_the_store_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: bytes
) -> None:
    monkeypatch.setattr(keeper_module, "_RETRY_S", 0.02)
    begin, full = checksums.make_tables, threading.Event()
    full.set()

    def make_tables(db: sqlite3.Connection) -> None:
        if full.is_set():
            if left:
                db.execute("VACUUM")  # writes the first page, without tables
            raise sqlite3.OperationalError("database or disk is full")
        begin(db)

    monkeypatch.setattr(checksums, "make_tables", make_tables)
    keeper = Keeper(tmp_path)
    assert keeper.load() == SavedMap()
    full.clear()
    station = Station(BaseConfig(), lambda agent: CodedChannel(SyncConfig(), 1))
    keeper.begin(station, SavedMap(texts={"name": "text"}), SavedMap())
    assert keeper.close(station)
    assert read(tmp_path).texts["name"] == "text"


def delete_folder(folder: Path) -> None:
    shutil.rmtree(folder)


def delete_file(folder: Path) -> None:
    """Alone: what SQLite keeps beside it stays, and does not belong to a new file of that name."""
    (folder / FILE).unlink()


def move_folder(folder: Path) -> None:
    folder.rename(folder.with_name("moved"))


@pytest.mark.parametrize("take_away", [delete_folder, delete_file, move_folder])
@pytest.mark.parametrize("when", ["written", "idle", "at the end"])
def test_a_store_that_is_deleted_or_moved_meanwhile_is_written_anew(
    make_flight: MakeFlight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    take_away: Callable[[Path], None], when: str,
) -> None:  # fmt: skip
    monkeypatch.setattr(keeper_module, "_LOOK_S", 0.02 if when == "idle" else 20.0)
    folder = tmp_path / "store"
    flown = FlightSummary(make_flight(keyframes=6, turns=0.1), folder)
    for n in range(6):
        if n == 3:
            take_away(folder)
            if when == "idle":
                wait_for((folder / FILE).exists)
        if n < 3 or when != "at the end":
            flown.step(n)
            wait_for(lambda: flown.keeper.idle)
    assert flown.keeper.close(flown.station)
    assert kept_heads(folder) == (3 if when == "at the end" else 6)
    assert not read(folder).faults
    assert capsys.readouterr().err.count("was deleted or moved") == 1
    Store(folder).close()  # its lock is free
    if take_away is move_folder:
        assert not read(tmp_path / "moved").faults
        assert kept_heads(tmp_path / "moved") == 3


def test_a_store_in_the_place_of_one_that_was_moved_stays_as_it_is(
    make_flight: MakeFlight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(keeper_module, "_CLOSE_S", 0.5)
    folder = tmp_path / "store"
    flown = FlightSummary(make_flight(keyframes=6, turns=0.1), folder)
    flown.step(0)
    wait_for(lambda: flown.keeper.idle)
    move_folder(folder)
    other = Store(folder)
    other.write(Batch(texts={"name": "text"}))
    flown.step(1)
    wait_for(lambda: flown.keeper.fault is not None)
    assert not flown.keeper.close(flown.station)
    assert "another file is in the place" in capsys.readouterr().err
    assert read(folder) == SavedMap(texts={"name": "text"})  # its write-ahead log, too, is still there
    other.close()


def wait_for(ready: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + 20.0
    while not ready():
        assert time.monotonic() < deadline_s
        time.sleep(0.005)
