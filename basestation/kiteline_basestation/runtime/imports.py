"""Reads maps and logs that are imported: a store, a base's log, or the log of an agent."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from kiteline_basestation.jobs import Job
from kiteline_basestation.runtime import flight_log
from kiteline_basestation.station import Import, Station
from kiteline_basestation.store.checksums import StoreError
from kiteline_basestation.store.combine import combine
from kiteline_basestation.store.keeper import snapshot
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.saved_map import SavedMap, SavedValues, unpack, value_name
from kiteline_basestation.store.store import FILE, read
from kiteline_codec.schema import Key, WireError, messages, owners, record_log
from kiteline_core.config import ConfigError
from kiteline_core.errors import INPUT_FAULTS
from kiteline_core.ids import AgentId
from kiteline_core.wording import counted
from kiteline_hw.logs.log_parts import WholeLog
from kiteline_hw.logs.mcap_log import LogMessage, LogReader

_STEP_VALUES = 200  # values of an agent's log that one step takes in, so that the loop goes on


@dataclass(frozen=True, slots=True)
class FromLog:
    """The values of an agent's log, in pieces for several steps. faults: what was left out, in words."""

    pieces: tuple[Import, ...]
    faults: tuple[str, ...] = ()


def import_map(path: Path, make_station: Callable[[Mapping[str, str]], Station]) -> SavedMap | FromLog:
    """A saved map (of a store or a base's log), or the values of an agent's log.

    make_station: from the metadata of a base's log, a station as in the log. Raises StoreError, SourceError.
    """
    if path.is_dir() or path.suffix == Path(FILE).suffix:
        return read(path)
    try:
        return _of_log(path, make_station)
    except ConfigError as error:  # of another build, not damaged
        raise StoreError(f"{path}: {error}") from error
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, *INPUT_FAULTS) as error:
        raise StoreError(
            f"{path}: damaged, or no log of kiteline ({error!r}); `kiteline log recover` mends logs"
        ) from error


def _of_log(path: Path, make_station: Callable[[Mapping[str, str]], Station]) -> SavedMap | FromLog:
    with WholeLog(path) as log:
        role = log.metadata.get("role")
        if role == "agent":
            return _of_agent(log, path)
        if role == "base" and "part" in log.metadata:
            raise StoreError(
                f"{path}: part {log.metadata['part']} of a base's log: expected its beginning, or the store"
            )
        if role == "base":
            return _of_base(log, path, make_station(log.metadata))
    raise StoreError(f"{path}: expected the log of an agent or of a base, or a base's store")


def _of_agent(log: LogReader, path: Path) -> FromLog:
    values: dict[AgentId, dict[Key, bytes]] = {}
    strange: dict[AgentId, list[Key]] = {}  # not of the agent, as in logs of versions with another layout of ids
    faults = [] if log.cut is None else [f"{path}: {log.cut}: what came after is left out"]
    for message in log.messages((record_log.TOPIC,)):
        agent, key, code = record_log.read_record(message.blob())
        try:
            messages.decode(key, code)
        except WireError as error:
            faults.append(f"{path}: {value_name(key)} of agent {agent} cannot be read ({error}): left out")
            continue
        if not owners.of_agent(agent, key):
            strange.setdefault(agent, []).append(key)
            continue
        values.setdefault(agent, {})[key] = code
    for agent, keys in sorted(strange.items()):
        faults.append(
            f"{path}: left out {counted(len(keys), 'value')} not of agent {agent}, whose log this is, the "
            f"first {value_name(keys[0])}: ids of an earlier version?"
        )
    if strange and not values:
        raise StoreError(f"{faults[-1]} Nothing else is in this log")
    if not values:
        raise StoreError(f"{path}: no keyframes in this log; expected an agent's log with {record_log.TOPIC} in it")
    out = []
    for agent, codes in sorted(values.items()):
        items = sorted(codes.items())
        out += [Import(agent, tuple(items[i : i + _STEP_VALUES])) for i in range(0, len(items), _STEP_VALUES)]
    return FromLog(tuple(out), tuple(faults))


def _of_base(log: LogReader, path: Path, station: Station) -> SavedMap:
    """Replay a base to its end."""
    if log.metadata.get("channel") != "CodedChannel":
        raise StoreError(f"{path}: the log of a monolith holds no packets: expected that of a base with a link")
    before = SavedMap()
    for blob in log.messages((flight_log.RESTORED,)):
        before = unpack(blob.blob())
        restore(station, before, blob.t_ns)
    station.track_changes()
    jobs: dict[int, Job] = {}
    for step in _steps(log):
        head = step[0].json()
        topics = {AgentId(int(a)): flight_log.packets_in(int(a)) for a in head["agents"]}
        packets = {agent: [m.blob() for m in step if m.topic == topic] for agent, topic in topics.items()}
        logged = [m for m in step if m.topic == flight_log.JOB]
        done = [flight_log.done_again(jobs.pop(n), m) for n, m in zip(head["done"], logged, strict=True)]
        output = station.step(packets, done, head["now_ns"], flight_log.read_orders(step))
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
    paths: Sequence[str], stored: SavedMap, make_station: Callable[[Mapping[str, str]], Station]
) -> tuple[SavedMap, FromLog]:
    """The stored map with all maps that --import names, and what their agents' logs hold.

    All of it or nothing: raises StoreError, SourceError, WireError before anything is taken in.
    """
    saved, logs = stored, list[FromLog]()
    for text in paths:
        found = import_map(Path(text), make_station)
        if isinstance(found, SavedMap):
            saved = combine(saved, found)
        else:
            logs.append(found)
    for piece in [piece for log in logs for piece in log.pieces]:
        held = saved.agents.get(piece.agent, SavedValues({}, {})).received
        combine(  # raises if these are other keyframes under the same ids
            SavedMap({piece.agent: SavedValues({key: held[key] for key, _ in piece.codes if key in held}, {})}),
            SavedMap({piece.agent: SavedValues(dict(piece.codes), {})}),
        )
    faults = tuple(fault for log in logs for fault in log.faults)
    return saved, FromLog(tuple(piece for log in logs for piece in log.pieces), faults)
