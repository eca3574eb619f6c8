"""What the base has on disk: the store, written beside the loop by a thread of its own; and maps that are imported.

The loop gathers what changed, a few times a second and only when the last batch is written; the thread writes it. So a
slow disk makes batches larger and holds nobody up.
"""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from kiteline_basestation.exchange.map_cache_planner import is_copy
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job
from kiteline_basestation.runtime import flight_log
from kiteline_basestation.station import Import, Station
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.saved_map import Codes, SavedMap, unpack
from kiteline_basestation.store.state import Scribe
from kiteline_basestation.store.store import FILE, Batch, Store, StoreError, batch_of, read, submap_of
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import Key, record_log
from kiteline_core.ids import AgentId, SubmapId
from kiteline_hw.logs.mcap_log import LogMessage, LogReader

KEEP_NS = 250_000_000  # ns between two batches: what a crash may cost, and the agents send again
_RETRY_S = 1.0  # s until a batch that could not be written is tried again
_CLOSE_S = 10.0  # s that the last batch may take
_IMPORT_VALUES = 200  # of an agent's log in one step, so that the loop goes on


class Keeper:
    """Keeps a station in a store. Raises StoreError where the store cannot be opened."""

    def __init__(self, folder: Path) -> None:
        self._store = Store(folder)
        self._scribe = Scribe()
        self._deleted: set[SubmapId] = set()
        self._kept_ns = -(1 << 62)
        self._batches: queue.SimpleQueue[Batch | None] = queue.SimpleQueue()
        self._writing = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="kiteline-store", daemon=True)
        self._thread.start()
        self.batches = 0

    @property
    def idle(self) -> bool:
        """Whether all that was handed to the thread is written."""
        return self._writing == 0

    def load(self) -> SavedMap:
        """What earlier bases kept."""
        return self._store.load()

    def begin(self, station: Station, kept: SavedMap, held: SavedMap) -> None:
        """From here on keep a station that began with `kept`, in a store that holds `held`."""
        self._put(batch_of(kept, held))
        self._deleted = set(station.mapper.deleted)
        station.note_changes()

    def keep_at_times(self, station: Station, now_ns: int) -> None:
        """Hand a batch to the thread, if the last one is long ago and written."""
        if now_ns - self._kept_ns >= KEEP_NS and self.idle:
            self._kept_ns = now_ns
            self._put(self._gather(station))

    def _gather(self, station: Station) -> Batch:
        """What changed since the last batch."""
        assert station.touched is not None
        fresh = station.mapper.deleted - self._deleted
        self._deleted |= fresh
        batch = Batch(memory=self._scribe.changes(station.mapper.memory()), deleted=sorted(fresh))
        for (agent, ours, key), code in station.touched.items():
            channel = station.channels[agent]
            if code is None and isinstance(channel, CodedChannel):
                code = channel.endpoint.own_value(key) if ours else channel.endpoint.peer_value(key)
            if code is not None and (not self._deleted or submap_of(key) not in self._deleted):
                batch.rows.append((int(agent), int(ours), key.kind, key.id, key.part, code))
            elif code is None and ours:
                batch.gone.append((int(agent), 1, key.kind, key.id, key.part))  # it was taken back
        station.touched.clear()
        return batch

    def _put(self, batch: Batch) -> None:
        if batch:
            self._writing += 1
            self.batches += 1
            self._batches.put(batch)

    def _run(self) -> None:
        while (batch := self._batches.get()) is not None:
            told = False
            while True:
                try:
                    self._store.write(batch)
                    break
                except StoreError as error:
                    if not told:
                        print(f"store: {error}; trying again", file=sys.stderr)
                    told = True
                if self._closing.wait(_RETRY_S):
                    return
            self._writing -= 1

    def close(self, station: Station) -> None:
        """Keep all that is there, and give the store back."""
        if station.touched is not None:
            self._put(self._gather(station))
        self._batches.put(None)
        self._thread.join(_CLOSE_S)
        self._closing.set()
        self._thread.join(_RETRY_S)
        if not self._thread.is_alive():
            self._store.close()


def snapshot(station: Station, before: SavedMap) -> SavedMap:
    """A station's whole map at rest. before: what it was restored from. What was imported since must be noted."""
    agents = {}
    for agent, channel in sorted(station.channels.items()):
        if isinstance(channel, CodedChannel):
            end = channel.endpoint
            old = before.agents.get(agent, Codes({}, {}))
            own = {key: code for key, code in end.own_values().items() if not is_copy(key)}
            noted = (station.touched or {}).items()
            imported = {key: code for (a, _, key), code in noted if a == agent and code is not None}
            agents[agent] = Codes({**old.received, **imported, **end.earlier_values(), **end.peer_values()}, own)
    texts = Scribe().changes(station.mapper.memory())
    return SavedMap(agents, {name: text for name, text in texts.items() if text is not None})


# -- imports -----------------------------------------------------------------------------------------------------------


def import_map(path: Path, make_station: Callable[[Mapping[str, str]], Station]) -> SavedMap | list[Import]:
    """A finished map (a store, a base's log), or what an agent's log holds, in pieces for several steps.

    make_station: makes a station as that of a base's log was, from the log's metadata. Raises StoreError, SourceError.
    """
    if path.is_dir() or path.suffix == Path(FILE).suffix:
        return read(path)
    with LogReader(path) as log:
        role = log.metadata.get("role")
        if role == "agent":
            return _of_agent(log, path)
        if role == "base":
            return _of_base(log, path, make_station(log.metadata))
    raise StoreError(f"{path}: expected the log of an agent or of a base, or a base's store")


def _of_agent(log: LogReader, path: Path) -> list[Import]:
    values: dict[AgentId, dict[Key, bytes]] = {}
    for message in log.messages((record_log.TOPIC,)):
        agent, key, code = record_log.read_record(message.blob())
        values.setdefault(agent, {})[key] = code
    if not values:
        raise StoreError(f"{path}: no keyframes in this log; expected an agent's log with {record_log.TOPIC} in it")
    out = []
    for agent, codes in sorted(values.items()):
        items = sorted(codes.items())
        out += [Import(agent, tuple(items[i : i + _IMPORT_VALUES])) for i in range(0, len(items), _IMPORT_VALUES)]
    return out


def _of_base(log: LogReader, path: Path, station: Station) -> SavedMap:
    """Run the base again, to its end."""
    if log.metadata.get("channel") != "CodedChannel":
        raise StoreError(f"{path}: the log of a monolith holds no packets: expected that of a base with a link")
    before = SavedMap()
    for blob in log.messages((flight_log.RESTORED,)):
        before = unpack(blob.blob())
        restore(station, before, blob.t_ns)
    station.note_changes()
    jobs: dict[int, Job] = {}
    for messages in _steps(log):
        head = messages[0].json()
        topics = {AgentId(int(a)): flight_log.packets_in(int(a)) for a in head["agents"]}
        packets = {agent: [m.blob() for m in messages if m.topic == topic] for agent, topic in topics.items()}
        done = [run_job(jobs.pop(number)) for number in head["done"]]
        output = station.step(packets, done, head["now_ns"], flight_log.read_orders(messages))
        jobs.update({job.id: job for job in output.jobs})
    return snapshot(station, before)


def _steps(log: LogReader) -> Iterator[Sequence[LogMessage]]:
    step: list[LogMessage] = []
    for message in log.messages():
        if message.topic == flight_log.STEP:
            if step:
                yield step
            step = [message]
        elif step:
            step.append(message)
    if step and log.cut is None:
        yield step


def read_imports(
    paths: Sequence[str], make_station: Callable[[Mapping[str, str]], Station]
) -> tuple[list[SavedMap], list[Import]]:
    """What --import names: finished maps, and pieces of agents' logs. Raises StoreError, SourceError."""
    maps: list[SavedMap] = []
    pieces: list[Import] = []
    for text in paths:
        found = import_map(Path(text), make_station)
        if isinstance(found, SavedMap):
            maps.append(found)
        else:
            pieces += found
    return maps, pieces
