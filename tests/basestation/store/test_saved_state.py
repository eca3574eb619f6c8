"""A saved map is restored bit for bit; flights go on in it, maps of several stores are combined."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.management import Command
from kiteline_basestation.mapper_state import MapperState, MapState
from kiteline_basestation.merging.merges import MapMerge, MergerState
from kiteline_basestation.station import Import, Station
from kiteline_basestation.store.combine import combine
from kiteline_basestation.store.integrity import contradictions
from kiteline_basestation.store.keeper import Keeper, snapshot
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_basestation.store.state_texts import state_of, texts_of
from kiteline_basestation.store.store import read
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import (
    Key,
    KeyframeHeader,
    SubmapPlacement,
    WireError,
    messages,
)
from kiteline_codec.sync.config import SyncConfig
from kiteline_core.geometry import se3
from kiteline_core.ids import (
    NO_KEYFRAME,
    AgentId,
    KeyframeId,
    SubmapId,
    keyframe_id,
    submap_id,
    submap_of_keyframe,
)
from tests.basestation.saved_flights import ELSEWHERE, STEP_NS, Agents, MakeFlight, new_station, whole


def test_restored_map_is_equal_to_the_last_bit(joined: tuple[Agents, Station], words: Any) -> None:
    _, first = joined
    assert contradictions(first.mapper) == []
    kept = snapshot(first, SavedMap())
    second = new_station(words, session=2)
    restored = restore(second, kept, 0)
    assert (restored.faults, restored.awaited, restored.keyframes) == ((), 0, 48)
    assert whole(second) == whole(first)
    assert snapshot(second, restored.saved) == kept
    for channel, before in zip(second.channels.values(), first.channels.values(), strict=True):
        assert isinstance(channel, CodedChannel) and isinstance(before, CodedChannel)
        assert channel.endpoint.own_values() == before.endpoint.own_values()


def test_a_submap_without_its_first_keyframe_is_restored_with_its_oldest(make_flight: MakeFlight, words: Any) -> None:
    """The base chose its pose, and had not told anyone: the next one had none, and left out what was seen there."""
    flight = make_flight(keyframes=12, turns=0.3)
    agents, station = Agents([replace(flight, records=flight.records[4:])]), new_station(words)
    agents.fly(station, 0, 130)
    assert station.mapper.counts.keyframes == 8 and station.mapper.idle
    other = new_station(words, 2)
    restore(other, snapshot(station, SavedMap()), agents.now_ns)
    assert whole(other) == whole(station)


def test_a_keyframe_that_has_no_pose_yet_merges_no_maps_after_a_restart(make_flight: MakeFlight, words: Any) -> None:
    """Its parent is still to come. Two keyframes of one frame merge their maps by their poses; it has none yet."""
    flight, later = make_flight(keyframes=8, turns=0.1), make_flight(keyframes=4, turns=0.1, start=0.5, submap=1)
    header, *sections = flight.records[4]
    parts = [*flight.records[:4], sections, *flight.records[5:]]
    same = replace(later.records[0][0], t_ns=flight.records[7][0].t_ns)
    agents = Agents([replace(flight, records=[*parts, [same, *later.records[0][1:]], *later.records[1:], [header]])])
    station, other = new_station(words), new_station(words, 2)
    agents.fly(station, 0, len(parts))
    assert [station.mapper.map.pose(k) is not None for k in flight.keyframes] == [True] * 4 + [False] * 4
    restore(other, snapshot(station, SavedMap()), agents.now_ns)
    agents.base_died()
    agents.fly(other, len(parts), len(parts) + 4)
    assert other.mapper.counts.keyframes == 8 and other.mapper.summary()["merges"] == 0
    agents.fly(other, len(parts) + 4, len(parts) + 40)
    assert other.mapper.counts.keyframes == 12 and other.mapper.summary()["merges"] == 1


def test_a_placement_that_was_not_sent_yet_is_sent_by_the_next_base(make_flight: MakeFlight, words: Any) -> None:
    """It waited for a batch that was under way. The next base had it, and sent it no more: nothing had changed."""
    flight = make_flight(keyframes=6, turns=0.1)
    submap, moved = submap_of_keyframe(flight.keyframes[0]), se3.from_rt(np.eye(3), np.array([2.0, 0.0, 0.0]))
    agents, station, other = Agents([flight]), new_station(words), new_station(words, 2)
    agents.fly(station, 0, 12)
    station.mapper._placements._set(submap, moved)
    restore(other, snapshot(station, SavedMap()), agents.now_ns)
    agents.base_died()
    agents.fly(other, 12, 24)
    assert np.array_equal(other.mapper.placements[submap], moved)
    key = Key(SubmapPlacement.KIND, int(submap), 0)
    record = messages.decode(key, agents.ends[flight.agent].endpoint.peer_values()[key])
    assert isinstance(record, SubmapPlacement) and np.allclose(record.S_w_m, moved, atol=1e-4)


def test_a_deleted_map_does_not_come_back(make_flight: MakeFlight, words: Any) -> None:
    flights = [make_flight(keyframes=12, turns=0.2), make_flight(keyframes=12, turns=0.2, seed=9, agent=1)]
    agents, first = Agents(flights), new_station(words)
    agents.fly(first, 0, 40)
    order = Command(1, "delete", '{"map": "1.1.0"}')
    for orders in ([order], []):
        output = first.step({}, agents.done, agents.now_ns, orders)
        assert all(answer.ok for answer in output.answers)
        agents.done = [run_job(job) for job in output.jobs]
    kept = snapshot(first, SavedMap())
    second = new_station(words, session=2)
    assert restore(second, kept, 0).keyframes == len(first.mapper.map) == 12
    assert whole(second) == whole(first)
    assert second.mapper.map.count_live() == first.mapper.map.count_live()


def test_what_an_agent_said_of_deleted_maps_ends_with_its_session(make_flight: MakeFlight, words: Any) -> None:
    station, held, now_ns = new_station(words), [], 0
    for number in range(3):
        flight = make_flight(keyframes=6, turns=0.1, submap=number)
        agents = Agents([flight])
        agents.ends[flight.agent] = CodedChannel(SyncConfig(), number + 1)
        agents.now_ns = now_ns
        agents.fly(station, 0, 20)
        order = Command(1, "delete", f'{{"map": "0.1.{number}"}}')
        assert all(answer.ok for answer in station.step({}, agents.done, agents.now_ns, [order]).answers)
        now_ns = agents.now_ns + STEP_NS
        end = station.channels[flight.agent]
        assert isinstance(end, CodedChannel)
        held.append(end.endpoint.received.earlier.bytes)
        assert sum(map(len, end.endpoint.peer_values().values())) > 2000
    assert max(held) < 2000


def test_map_survives_six_restarts(make_flight: MakeFlight, words: Any, tmp_path: Path) -> None:
    flight = make_flight(keyframes=26, turns=1.0)
    agents, at = Agents([flight]), 0
    for session, until in enumerate((3, 6, 10, 15, 18, 23, 66), 1):
        station, keeper = new_station(words, session, BaseConfig()), Keeper(tmp_path)
        held = keeper.load()
        restored = restore(station, held, agents.now_ns)
        assert restored.faults == ()
        keeper.begin(station, restored.saved, held)
        agents.fly(station, at, until, each=lambda: keeper.write_changes(station, agents.now_ns))  # noqa: B023
        keeper.close(station)
        assert read(tmp_path) == snapshot(station, restored.saved)  # batch by batch, and all at once
        agents.base_died()
        at = until
    assert station.mapper.idle
    end = station.channels[flight.agent]
    assert isinstance(end, CodedChannel)
    assert end.endpoint.digest_equal
    assert contradictions(station.mapper) == []
    assert sorted(station.mapper.map.rows) == flight.keyframes

    def error_m(poses: list[Any]) -> float:
        return float(np.sqrt(np.mean([np.sum((p[:3, 3] - t[:3, 3]) ** 2) for p, t in zip(poses, flight.true_T_m_k)])))

    refined = [station.mapper.map.pose(k) for k in flight.keyframes]
    assert error_m(refined) < 0.5 * error_m(flight.agent_T_m_k)  # six deaths, and still worth having


@pytest.fixture(scope="module")
def kept(make_flight: MakeFlight, words: Any) -> list[SavedMap]:
    """Two maps of one room, by agents 0 and 1, each saved by a base of its own."""
    maps = []
    for agent, start in ((0, 0.0), (1, 0.3)):
        agents = Agents([make_flight(keyframes=20, turns=0.6, start=start, variant=agent, agent=agent)])
        station = new_station(words)
        agents.fly(station, 0, 30)
        maps.append(snapshot(station, SavedMap()))
    return maps


def test_new_flight_is_merged_with_a_restored_map(make_flight: MakeFlight, kept: list[SavedMap], words: Any) -> None:
    today = Agents([make_flight(keyframes=20, turns=0.6, start=0.3, variant=1, agent=1, T_w_m=ELSEWHERE)])
    station = new_station(words, session=2)
    restore(station, kept[0], 0)
    today.fly(station, 0, 45)
    assert station.mapper.summary()["merges"] == 1
    assert next(iter(station.mapper.placements)) == submap_id(0, 1, 0)


def test_combined_maps_are_merged_by_loop_closure(kept: list[SavedMap], words: Any) -> None:
    both = combine(*kept)
    station = new_station(words, session=2)
    assert restore(station, both, 0).faults == ()
    assert station.mapper.summary()["maps"] == 2
    done: list[JobDone] = []
    for n in range(40):
        done = [run_job(job) for job in station.step({}, done, n * STEP_NS).jobs]
    assert station.mapper.summary()["merges"] == 1
    assert combine(kept[0], kept[0]).agents == kept[0].agents


@pytest.mark.parametrize("is_newer_imported", [True, False])
def test_a_store_and_a_newer_copy_of_it_are_combined(
    make_flight: MakeFlight, words: Any, is_newer_imported: bool
) -> None:
    """Meanwhile its maps were merged with another one; an older copy adds nothing."""
    worlds = [np.eye(4), ELSEWHERE, se3.inverse(ELSEWHERE)]
    agents = Agents(
        [
            make_flight(keyframes=8, turns=0.2, start=0.1 * n, variant=n, agent=n, T_w_m=world)
            for n, world in enumerate(worlds)
        ]
    )
    station = new_station(words)
    merger = station.mapper.merger
    assert merger is not None
    merger.detector.query = lambda keyframe: None  # type: ignore[method-assign]
    agents.fly(station, 0, 20)
    copies = []
    for newer, older in ((2, 1), (1, 0)):
        T_older_newer = se3.inverse(worlds[older]) @ worlds[newer]
        order = {"map": f"{newer}.1.0", "into": f"{older}.1.0", "T_into_map": T_older_newer.ravel().tolist()}
        output = station.step({}, agents.done, agents.now_ns, [Command(1, "merge", json.dumps(order))])
        assert output.answers[0].ok
        agents.done, agents.down = [run_job(job) for job in output.jobs], dict(output.packets)
        agents.fly(station, 12, 24)
        copies.append(snapshot(station, SavedMap()))
    older_copy, newer_copy = copies
    alone, again = new_station(words, session=2), new_station(words, session=2)
    both = combine(older_copy, newer_copy) if is_newer_imported else combine(newer_copy, older_copy)
    restore(alone, newer_copy, 0)
    assert restore(again, both, 0).faults == ()
    expected, found = whole(alone), whole(again)
    del expected["placements"], found["placements"]
    assert found == expected
    done: list[JobDone] = []
    for n in range(4):
        done = [run_job(job) for job in again.step({}, done, n * STEP_NS).jobs]
    assert again.mapper.placements.keys() == station.mapper.placements.keys()
    assert contradictions(again.mapper) == []


def test_stores_that_went_on_from_one_copy_are_combined() -> None:
    """Each merged its submap with another one: what the map with more merges says is taken, the rest is apart."""
    submaps = [submap_id(0, 1, n) for n in range(5)]
    first = with_merges(submaps[:3], {submaps[1]: submaps[0]})
    second = with_merges(submaps[1:], {submaps[1]: submaps[4], submaps[3]: submaps[4]})
    third = with_merges(submaps[:2], {submaps[1]: submaps[0]})
    for one, other in ((first, second), (second, first)):
        state = state_of(combine(one, other).texts)
        assert state.map.root_submaps == {submaps[1]: submaps[4], submaps[3]: submaps[4]}
        assert {merge.into for merge in state.merger.merges} == {submaps[4]} and len(state.merger.merges) == 2
    assert submaps[0] in map(submap_of_keyframe, state_of(combine(first, second).texts).merger.requery)
    state = state_of(combine(first, third).texts)
    assert state.map.root_submaps == {submaps[1]: submaps[0]} and len(state.merger.merges) == 1


def with_merges(submaps: list[SubmapId], roots: dict[SubmapId, SubmapId]) -> SavedMap:
    """A map with a keyframe in each submap, of which some are merged."""
    headers = [KeyframeHeader(keyframe_id(s, 0), int(s), NO_KEYFRAME, np.eye(4), 0) for s in submaps]
    values = SavedValues({messages.key(header): messages.encode(header) for header in headers}, {})
    merges = tuple(MapMerge(submap, root, {submap: np.eye(4)}) for submap, root in roots.items())
    state = MapperState(map=MapState(root_submaps=roots), merger=MergerState(merges=merges))
    return SavedMap({AgentId(0): values}, texts_of(state))


def test_maps_of_two_agents_with_one_number_are_refused(make_flight: MakeFlight, words: Any) -> None:
    kept = []
    for seed in (0, 1):
        agents = Agents([make_flight(keyframes=4, turns=0.1, seed=seed)])
        station = new_station(words)
        agents.fly(station, 0, 8)
        kept.append(snapshot(station, SavedMap()))
    with pytest.raises(WireError, match="another agent with this number"):
        combine(*kept)


def test_values_lost_on_the_link_are_imported_later(make_flight: MakeFlight, words: Any) -> None:
    flight = make_flight(keyframes=20, turns=0.4)
    codes = [(messages.key(r), messages.encode(r)) for r in flight.all_records()]
    agents, station = Agents([flight]), new_station(words)
    for records in flight.records[5:12]:  # the link was away for seven keyframes
        records[:] = []
    agents.fly(station, 0, 20)
    assert len(station.mapper.map) == 13
    station.track_changes()
    done: list[JobDone] = []
    for n in range(30):
        orders = [Import(flight.agent, tuple(codes[n * 20 : n * 20 + 20]))]
        done = [run_job(j) for j in station.step({}, done, agents.now_ns + n * STEP_NS, orders).jobs]
    assert len(station.mapper.map) == 20
    assert all(station.mapper.map.pose(k) is not None for k in flight.keyframes)
    assert contradictions(station.mapper) == []
    heads = {KeyframeId(key.id) for _, ours, key in station.changed if not ours and key.kind == KeyframeHeader.KIND}
    assert heads == set(flight.keyframes[5:12])  # the others were here


def test_saved_keyframe_headers_are_complete(joined: tuple[Agents, Station]) -> None:
    agents, first = joined
    kept = snapshot(first, SavedMap())
    for flight in agents.flights:
        heads = [k for k in kept.agents[flight.agent].received if k.kind == KeyframeHeader.KIND]
        assert sorted(k.id for k in heads) == flight.keyframes
        decoded = messages.decode(heads[0], kept.agents[flight.agent].received[heads[0]])
        assert isinstance(decoded, KeyframeHeader)
