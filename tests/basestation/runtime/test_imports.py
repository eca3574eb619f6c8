"""Imports are taken in as a whole or not at all, and what was left out is told."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from kiteline_basestation.runtime.flight_log import station_of
from kiteline_basestation.runtime.imports import read_imports
from kiteline_basestation.station import Station
from kiteline_basestation.store.checksums import StoreError
from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_codec.schema import KeyframeHeader, WireError, messages, record_log
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.logs.mcap_log import LogWriter
from kiteline_hw.ports import SourceError

MakeFlight = Callable[..., Any]


def no_station(metadata: Mapping[str, str]) -> Station:
    raise AssertionError("no log of a base")


def log_of(path: Path, flight: Any, spoil: int | None = None) -> Path:
    """The log of an agent; the record `spoil` cannot be read."""
    with LogWriter(path, {"role": "agent"}) as log:
        for n, record in enumerate(record for step in flight.records for record in step):
            code = b"" if n == spoil else messages.encode(record)
            log.blob(record_log.TOPIC, n, record_log.write_record(flight.agent, messages.key(record), code))
            log.flush()
    return path


def test_what_cannot_be_read_is_left_out_and_named(make_flight: MakeFlight, tmp_path: Path) -> None:
    flight = make_flight(keyframes=4, turns=0.1)
    path = log_of(tmp_path / "log.mcap", flight, spoil=1)
    _, whole = read_imports([str(log_of(tmp_path / "whole.mcap", flight))], SavedMap(), no_station)
    saved, found = read_imports([str(path)], SavedMap(), no_station)
    assert saved.empty and whole.faults == ()
    assert sum(len(p.codes) for p in found.pieces) == sum(len(p.codes) for p in whole.pieces) - 1
    assert len(found.faults) == 1 and "cannot be read" in found.faults[0]


def test_a_base_log_of_another_build_is_not_called_damaged(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap", {"role": "base", "config": "[graph]\nturns = 8"}) as log:
        log.flush()
    with pytest.raises(StoreError, match=r"log\.mcap: another build wrote this log \(unknown key 'turns'"):
        read_imports([str(tmp_path / "log.mcap")], SavedMap(), lambda about: station_of(about, None, link_traits))


def test_a_cut_log_is_told(make_flight: MakeFlight, tmp_path: Path) -> None:
    path = log_of(tmp_path / "log.mcap", make_flight(keyframes=8, turns=0.1))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    _, found = read_imports([str(path)], SavedMap(), no_station)
    assert found.pieces and len(found.faults) == 1 and "what came after is left out" in found.faults[0]


def test_other_keyframes_under_the_same_ids_are_refused_before_anything_is_taken(
    make_flight: MakeFlight, tmp_path: Path
) -> None:
    flight = make_flight(keyframes=4, turns=0.1)
    path = log_of(tmp_path / "log.mcap", flight)
    _, found = read_imports([str(path)], SavedMap(), no_station)
    codes = dict(code for piece in found.pieces for code in piece.codes)
    header = max(key for key in codes if key.kind == KeyframeHeader.KIND)
    stored = SavedMap({flight.agent: SavedValues({**codes, header: codes[header] + b"!"}, {})})
    with pytest.raises(WireError, match="another agent with this number"):
        read_imports([str(path)], stored, no_station)
    with pytest.raises(SourceError):
        read_imports([str(path), str(tmp_path / "missing")], SavedMap(), no_station)


def test_the_later_parts_of_a_log_are_read_too(make_flight: MakeFlight, tmp_path: Path) -> None:
    flight = make_flight(keyframes=4, turns=0.1)
    _, whole = read_imports([str(log_of(tmp_path / "whole.mcap", flight))], SavedMap(), no_station)
    records = [record for step in flight.records for record in step]
    for part, name in enumerate(("log.mcap", "log_1.mcap")):
        about = {"role": "agent"} | ({"part": str(part)} if part else {})
        with LogWriter(tmp_path / name, about) as log:
            for n, record in enumerate(records[part::2]):
                code = record_log.write_record(flight.agent, messages.key(record), messages.encode(record))
                log.blob(record_log.TOPIC, n, code)
    _, found = read_imports([str(tmp_path / "log.mcap")], SavedMap(), no_station)
    assert found.faults == ()
    assert found.pieces == whole.pieces


def test_values_under_ids_of_another_agent_are_left_out(make_flight: MakeFlight, tmp_path: Path) -> None:
    flight = make_flight(keyframes=4, turns=0.1)
    records = [record for step in flight.records for record in step]

    def log_of(name: str, strange: int) -> str:
        with LogWriter(tmp_path / name, {"role": "agent"}) as log:
            for n, record in enumerate(records):
                key = messages.key(record)
                if n >= len(records) - strange:
                    key = key._replace(id=key.id + (1 << 44))  # of the next agent
                log.blob(record_log.TOPIC, n, record_log.write_record(flight.agent, key, messages.encode(record)))
        return str(tmp_path / name)

    _, found = read_imports([log_of("few.mcap", 3)], SavedMap(), no_station)
    assert len(found.faults) == 1 and "left out 3 values not of agent" in found.faults[0]
    assert all(key.id < 1 << 44 for piece in found.pieces for key, _ in piece.codes)
    with pytest.raises(StoreError, match=f"left out {len(records)} values not of agent.*earlier version"):
        read_imports([log_of("all.mcap", len(records))], SavedMap(), no_station)
