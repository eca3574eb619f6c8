"""A saved map is restored bit for bit; inconsistent values are reported and left out."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.management import Command
from kiteline_basestation.station import Import, Station
from kiteline_basestation.store.combine import combine
from kiteline_basestation.store.integrity import check, contradictions
from kiteline_basestation.store.keeper import Keeper, snapshot
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_basestation.store.state_texts import state_of
from kiteline_basestation.store.store import read
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import (
    CameraIntrinsics,
    FusedLandmarks,
    Key,
    KeyframeHeader,
    KeyframePose,
    NewLandmarks,
    Observations,
    SubmapPlacement,
    WireError,
    messages,
)
from kiteline_codec.sync.config import SyncConfig
from kiteline_core.geometry import se3
from kiteline_core.ids import (
    KEYPOINT_BITS,
    AgentId,
    KeyframeId,
    agent_of_keyframe,
    agent_of_submap,
    keyframe_id,
    submap_id,
    submap_of_keyframe,
)
from tests.basestation.feeding import WITHOUT_GRID

STEP_NS = 100_000_000
ELSEWHERE = se3.exp(np.array([0.5, -0.3, 0.2, 0.1, 0.4, -1.1]))

MakeFlight = Callable[..., Any]


def new_station(words: Any, session: int = 1, config: BaseConfig = WITHOUT_GRID) -> Station:
    return Station(config, lambda agent: CodedChannel(SyncConfig(), session), words)


class Agents:
    """Agents that say what they see, a keyframe a step, over channels without loss."""

    def __init__(self, flights: list[Any]) -> None:
        self.flights = flights
        self.ends = {f.agent: CodedChannel(SyncConfig(), 1) for f in flights}
        for flight in flights:
            self.ends[flight.agent].put(CameraIntrinsics(flight.agent, flight.camera))
        self.now_ns = 0
        self.done: list[JobDone] = []
        self.down: Mapping[AgentId, tuple[bytes, ...]] = {}

    def fly(self, station: Station, begin: int, end: int, each: Callable[[], None] = lambda: None) -> None:
        """Keyframes begin..end of every flight; beyond the last one time passes."""
        for n in range(begin, end):
            self.now_ns += STEP_NS
            up = {}
            for flight in self.flights:
                channel = self.ends[flight.agent]
                channel.receive(self.down.get(flight.agent, ()), self.now_ns)
                for record in flight.records[n] if n < len(flight.records) else ():
                    channel.put(record)
                up[flight.agent] = channel.poll(self.now_ns)
            output = station.step(up, self.done, self.now_ns)
            self.done = [run_job(job) for job in output.jobs]
            self.down = dict(output.packets)
            each()

    def base_died(self) -> None:
        self.done, self.down = [], {}


def whole(station: Station) -> dict[str, Any]:
    """The map, told in a way that does not depend on the order of arrival."""
    sparse_map = station.mapper.map
    table, out = sparse_map.keypoints, {}
    for keyframe in sorted(sparse_map.rows):
        slots = sparse_map.slots_of(keyframe)
        roots = table.root[slots]
        points = np.where(roots >= 0, sparse_map.landmark_ids(np.maximum(roots, 0)), -1)
        refined = table.flags[slots] & 4 != 0
        alive = refined & (roots == slots) & (table.flags[slots] & 2 == 0)
        pose, world = sparse_map.pose(keyframe), sparse_map.world_pose(keyframe)
        out[str(keyframe)] = (
            pose.tobytes(), world.tobytes(), points.tolist(), (table.flags[slots] & 3).tolist(),
            table.refined[slots[alive]].tobytes(), table.offset[slots[alive]].tobytes(),
            int(sparse_map.keyframes.culled[sparse_map.rows[keyframe]]),
        )  # fmt: skip
    out["placements"] = [(int(s), T.tobytes()) for s, T in station.mapper.placements.items()]
    out["islands"] = sorted(sparse_map.root_submaps.items())
    out["offsets"] = sorted((int(a), offset.tolist()) for a, offset in sparse_map.disparity_offset_px.items())
    out["loops and merges"] = {
        n: t for n, t in snapshot(station, SavedMap()).texts.items() if ".edges/" in n or ".merges/" in n
    }
    return out


@pytest.fixture(scope="module")
def joined(make_flight: MakeFlight, words: Any) -> tuple[Agents, Station]:
    """Two agents whose maps have become one, and a third that is alone."""
    a = make_flight(keyframes=20, turns=0.6)
    b = make_flight(keyframes=20, turns=0.6, start=0.3, variant=1, agent=1, T_w_m=ELSEWHERE)
    c = make_flight(keyframes=8, turns=0.1, seed=9, agent=2)
    agents, station = Agents([a, b, c]), new_station(words)
    agents.fly(station, 0, 45)
    assert station.mapper.summary()["merges"] == 1
    return agents, station


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
        held.append(end.endpoint.earlier.bytes)
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


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 1 << 20), share=st.sampled_from([0.01, 0.1, 0.5]), texts=st.sampled_from([0.0, 0.3, 1.0]))
def test_whatever_a_damaged_store_has_lost_the_rest_is_restored(
    joined: tuple[Agents, Station], words: Any, seed: int, share: float, texts: float
) -> None:
    """A landmark whose section was gone ended the process, and what a merge had linked kept the map from beginning."""
    kept, draw = snapshot(joined[1], SavedMap()), Random(seed)
    agents = {
        agent: SavedValues(
            *(
                {key: codes[key] for key in sorted(codes) if draw.random() >= share}
                for codes in (all_.received, all_.own)
            )
        )
        for agent, all_ in kept.agents.items()
    }
    left = {name: text for name, text in sorted(kept.texts.items()) if draw.random() >= texts}
    station = new_station(words, session=3)
    restored = restore(station, SavedMap(agents, left, ("values are gone",)), 0)
    assert contradictions(station.mapper) == []
    kinds = [key.kind for all_ in agents.values() for key in all_.received]
    assert restored.keyframes == kinds.count(KeyframeHeader.KIND)
    done: list[JobDone] = []
    for n in range(4):
        done = [run_job(job) for job in station.step({}, done, n * STEP_NS).jobs]
    assert contradictions(station.mapper) == []


def test_maps_whose_merge_was_lost_are_apart_and_their_agents_told(joined: tuple[Agents, Station], words: Any) -> None:
    kept = snapshot(joined[1], SavedMap())
    texts = {name: text for name, text in kept.texts.items() if name != "mapper.map"}
    station = new_station(words, session=3)
    restored = restore(station, replace(kept, texts=texts, faults=("state 'mapper.map' was altered",)), 0)
    assert any("were linked to landmarks of another map, or to none" in fault for fault in restored.faults)
    end, fused = station.channels[AgentId(1)], set[int]()
    assert isinstance(end, CodedChannel)
    for n in range(5):
        station.step({}, [], n * STEP_NS)
    for key, code in end.endpoint.own_values().items():
        if key.kind == FusedLandmarks.KIND:
            record = messages.decode(key, code)
            assert isinstance(record, FusedLandmarks)
            fused |= {int(agent_of_keyframe(KeyframeId(point >> KEYPOINT_BITS))) for point in record.point.tolist()}
    assert fused <= {1}


def test_values_of_another_kind_under_old_keys_do_not_keep_the_map_from_beginning(
    joined: tuple[Agents, Station], words: Any
) -> None:
    """As of an agent that means harm: observations take the places of landmarks that others observe."""
    agents, first = joined
    kept = snapshot(first, SavedMap())
    received = kept.agents[AgentId(0)].received
    landmarks = [key for key in sorted(received) if key.kind == NewLandmarks.KIND][:4]
    other = dict(received)
    for key in landmarks:
        record = messages.decode(key, received[key])
        assert isinstance(record, NewLandmarks)
        point = np.full(len(record.index), agents.flights[0].keyframes[0] << KEYPOINT_BITS, np.int64)
        other |= _coded(
            Observations(record.keyframe, key.part, record.index, record.uv, record.inv_depth, record.octave, point)
        )
    codes = SavedValues(other, kept.agents[AgentId(0)].own)
    station = new_station(words, session=3)
    restored = restore(station, replace(kept, agents={**kept.agents, AgentId(0): codes}), 0)
    assert any("or to none" in fault for fault in restored.faults)
    assert contradictions(station.mapper) == []


def spoilt(
    kept: SavedMap, agent: int, received: Mapping[Key, bytes], own: Mapping[Key, bytes], drop: Key | None
) -> SavedMap:
    codes = kept.agents[AgentId(agent)]
    mine = {key: code for key, code in codes.received.items() if key != drop}
    return SavedMap(
        {**kept.agents, AgentId(agent): SavedValues({**mine, **received}, {**codes.own, **own})}, kept.texts
    )


def test_every_kind_of_inconsistency_is_reported_and_left_out(joined: tuple[Agents, Station], words: Any) -> None:
    agents, first = joined
    kept = snapshot(first, SavedMap())
    keyframe = agents.flights[0].keyframes[10]
    nowhere = keyframe_id(submap_of_keyframe(keyframe), 999)
    nowhere_map = replace(
        SubmapPlacement(submap_of_keyframe(keyframe), np.eye(4)), submap=submap_of_keyframe(keyframe) + 7
    )
    index, ids = np.array([5], np.uint16), np.array([nowhere << 11], np.int64)
    far = np.array([2000], np.uint16)
    head = kept.agents[AgentId(0)].received[Key(KeyframeHeader.KIND, keyframe)]
    cases = {
        "cannot be read": ({Key(KeyframeHeader.KIND, keyframe): head + b"!"}, {}),
        "is of a keyframe that is not there": ({}, _coded(KeyframePose(nowhere, np.eye(4)))),
        "names landmarks of a keyframe that is not there": ({}, _coded(FusedLandmarks(keyframe, index, ids))),
        "is of keypoint 2000": ({}, _coded(FusedLandmarks(keyframe, far, ids))),
        "places a submap without keyframes": ({}, _coded(nowhere_map)),
    }
    for words_told, (received, own) in cases.items():
        checked = check(spoilt(kept, 0, received, own, None))
        assert any(words_told in fault for fault in checked.faults), (words_told, checked.faults)
        station = new_station(words, session=3)
        restored = restore(station, spoilt(kept, 0, received, own, None), 0)
        assert restored.faults == checked.faults
        assert contradictions(station.mapper) == []
        again = restore(new_station(words, session=4), restored.saved, 0)
        assert again.faults == ()


def _coded(record: Any) -> dict[Key, bytes]:
    return {messages.key(record): messages.encode(record)}


def test_missing_parent_is_awaited(joined: tuple[Agents, Station], words: Any) -> None:
    _, first = joined
    kept = snapshot(first, SavedMap())
    alone = sorted(k for k in kept.agents[AgentId(2)].received if k.kind == KeyframeHeader.KIND)[3]
    bare = SavedMap({AgentId(2): SavedValues(kept.agents[AgentId(2)].received, {})})
    checked = check(spoilt(bare, 2, {}, {}, alone))
    assert checked.faults == ()
    assert checked.awaited > 1  # its child, and its own sections
    restored = restore(new_station(words, session=2), checked.saved, 0)
    assert restored.keyframes == 7


def test_submap_whose_root_is_missing_becomes_a_map(joined: tuple[Agents, Station], words: Any) -> None:
    _, first = joined
    kept = snapshot(first, SavedMap())
    (root,) = set(state_of(kept.texts).map.root_submaps.values())
    lost = agent_of_submap(root)
    half = SavedMap({a: c for a, c in kept.agents.items() if a != lost}, kept.texts)
    station = new_station(words, session=2)
    restored = restore(station, half, 0)
    assert any("is merged with" in fault for fault in restored.faults)
    assert contradictions(station.mapper) == []
    assert station.mapper.summary()["maps"] == 2


def test_an_unreadable_state_is_refused(joined: tuple[Agents, Station], words: Any) -> None:
    _, first = joined
    kept = snapshot(first, SavedMap())
    for name, text in (
        ("mapper", "{}"),
        ("mapper", "nonsense"),
        ("mapper.merger", "[]"),
        ("mapper.merger.edges/0", "{}"),
    ):
        with pytest.raises(WireError, match="state"):
            restore(new_station(words, session=2), SavedMap(kept.agents, {**kept.texts, name: text}), 0)


def test_contradictions_in_the_tables_are_found(make_flight: MakeFlight, words: Any) -> None:
    agents, station = Agents([make_flight(keyframes=6, turns=0.1)]), new_station(words)
    agents.fly(station, 0, 10)
    sparse_map = station.mapper.map
    table = sparse_map.keypoints
    slot = int(np.flatnonzero(table.next[: sparse_map.slots] >= 0)[0])
    held = int(table.next[slot])
    table.next[slot] = -1
    assert any("lists of observations" in text for text in contradictions(station.mapper))
    table.next[slot] = held
    assert contradictions(station.mapper) == []
    sparse_map.keyframes.T_m_k[2, 0, 0] += 0.1
    assert any("no rigid pose" in text for text in contradictions(station.mapper))


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
