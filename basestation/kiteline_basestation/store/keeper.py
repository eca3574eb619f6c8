"""Writes the station to the store from a thread of its own.

The loop gathers changes a few times a second, and only once the last batch is written. A slow disk so makes larger
batches and does not delay the loop.
"""

import contextlib
import queue
import threading
from pathlib import Path

from kiteline_basestation.exchange.map_cache_planner import is_cached_key
from kiteline_basestation.station import Station
from kiteline_basestation.store.checksums import EmptyStoreError, StoreError
from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_basestation.store.state_texts import StateWriter, texts_of
from kiteline_basestation.store.store import FILE, Batch, DiskError, Store, batch_of, read
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema.owners import submap_of
from kiteline_core.ids import SubmapId
from kiteline_hw.system import process

WRITE_NS = 250_000_000  # ns between two batches: a crash loses at most these, and the agents send them again
_LOOK_S = 1.0  # s between two looks at the file while nothing is to be written
_RETRY_S = 1.0  # s until a batch that could not be written is tried again
_CLOSE_S = 10.0  # s that the last batch may take


class Keeper:
    """Keeps a store up to date with a station. Raises StoreError if the store cannot be opened.

    A disk that is full, read-only or failing only keeps it from being written: that is tried again and again.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._store: Store | None = None
        try:
            self._store = Store(folder)
        except DiskError as error:
            _say(f"store: {error}; the map is not stored until that is mended")
        self._writer = StateWriter()
        self._deleted: set[SubmapId] = set()
        self._written_ns = -(1 << 62)
        self._batches: queue.SimpleQueue[Batch | None] = queue.SimpleQueue()
        self._writing = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="kiteline-store", daemon=True)
        self.batches = 0
        self.fault: str | None = None  # why the last batch is not written yet
        self._thread.start()

    @property
    def idle(self) -> bool:
        """True if all batches are written, and the file is where it belongs."""
        return self._writing == 0 and self.fault is None

    def load(self) -> SavedMap:
        """Read what earlier processes saved."""
        if self._store is not None:
            return self._store.load()
        if (self._folder / FILE).exists():
            with contextlib.suppress(EmptyStoreError):
                return read(self._folder)
        return SavedMap()

    def begin(self, station: Station, saved: SavedMap, held: SavedMap) -> None:
        """Begin with a station that was restored from `saved`, in a store that holds `held`."""
        self._put(batch_of(saved, held))
        self._deleted = set(station.mapper.deleted)
        station.track_changes()

    def write_changes(self, station: Station, now_ns: int) -> None:
        """Hand a batch to the thread, if the last one is written and old enough."""
        if now_ns - self._written_ns >= WRITE_NS and self.idle:
            self._written_ns = now_ns
            self._put(self._gather(station))

    def _gather(self, station: Station) -> Batch:
        """Changes since the last batch."""
        assert station.changed is not None
        fresh = station.mapper.deleted - self._deleted
        self._deleted |= fresh
        batch = Batch(texts=self._writer.changes(station.mapper.state()), deleted=sorted(fresh))
        for (agent, own, key), code in station.changed.items():
            channel = station.channels[agent]
            if code is None and isinstance(channel, CodedChannel):
                # the agent may have begun a new session since it wrote the value
                code = channel.own_value(key) if own else channel.endpoint.received.value(key)
            if code is not None and (not self._deleted or submap_of(key) not in self._deleted):
                batch.rows.append((int(agent), int(own), key.kind, key.id, key.part, code))
            elif code is None and own:
                batch.gone.append((int(agent), 1, key.kind, key.id, key.part))  # it was removed
        station.changed.clear()
        return batch

    def _put(self, batch: Batch) -> None:
        if batch:
            self._writing += 1
            self.batches += 1
            self._batches.put(batch)

    def _next_batch(self) -> Batch | None:
        """Wait for the next batch, or until the store has to be put back: then an empty one. None at the end."""
        while True:
            with contextlib.suppress(queue.Empty):
                return self._batches.get(timeout=_LOOK_S)
            if self._store is not None and self._store.displaced:
                return Batch()

    def _run(self) -> None:
        while (batch := self._next_batch()) is not None:
            self.fault = None
            while True:
                try:
                    if self._store is None:
                        self._store = Store(self._folder)
                    if self._store.displaced:
                        self._store.put_back()
                        _say(f"store: {self._store.path}: it was deleted or moved, and is written anew")
                    self._store.write(batch)
                    break
                except StoreError as error:
                    if self.fault is None:
                        _say(f"store: {error}; trying again")
                    self.fault = str(error)
                if self._closing.wait(_RETRY_S):
                    return
            if self.fault is not None:
                _say("store: written again")
            self.fault = None
            if batch:  # an empty one was not counted
                self._writing -= 1

    def close(self, station: Station) -> bool:
        """Write all that is left, and close the store. False if it could not be written; that is said."""
        if station.changed is not None:
            self._put(self._gather(station))
        if self._store is not None and self._store.displaced:
            self._batches.put(Batch())
        self._batches.put(None)
        self._thread.join(_CLOSE_S)
        self._closing.set()
        self._thread.join(_RETRY_S)
        if not self._thread.is_alive() and self._store is not None:
            self._store.close()
        if not self.idle:
            _say(f"store: the newest part of the map is not stored: {self.fault or 'the disk is too slow'}")
        return self.idle


def _say(line: str) -> None:
    process.print_lines([line])


def snapshot(station: Station, before: SavedMap) -> SavedMap:
    """The whole map of a station. before: what it was restored from. Imports must have been tracked."""
    agents = {}
    for agent, channel in sorted(station.channels.items()):
        if isinstance(channel, CodedChannel):
            end = channel.endpoint
            old = before.agents.get(agent, SavedValues({}, {}))
            own = {key: code for key, code in channel.own_values().items() if not is_cached_key(key)}
            changed = (station.changed or {}).items()
            imported = {key: code for (a, _, key), code in changed if a == agent and code is not None}
            agents[agent] = SavedValues({**old.received, **imported, **end.earlier_values(), **end.peer_values()}, own)
    return SavedMap(agents, texts_of(station.mapper.state()))
