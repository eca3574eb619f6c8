"""Maps of damaged stores: what is inconsistent is reported and left out, the rest is restored."""

from collections.abc import Mapping
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.station import Station
from kiteline_basestation.store.integrity import check, contradictions
from kiteline_basestation.store.keeper import snapshot
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_basestation.store.state_texts import state_of
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import (
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
from kiteline_core.ids import (
    KEYPOINT_BITS,
    AgentId,
    KeyframeId,
    agent_of_keyframe,
    agent_of_submap,
    keyframe_id,
    submap_of_keyframe,
)
from tests.basestation.saved_flights import STEP_NS, Agents, MakeFlight, new_station


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


def roots_told(values: Mapping[Key, bytes]) -> tuple[int, set[int]]:
    """The number of records of fused landmarks, and the agents whose landmarks are the roots in them."""
    records = [messages.decode(key, code) for key, code in values.items() if key.kind == FusedLandmarks.KIND]
    points = [point for record in records if isinstance(record, FusedLandmarks) for point in record.point.tolist()]
    return len(records), {int(agent_of_keyframe(KeyframeId(point >> KEYPOINT_BITS))) for point in points}


def test_maps_whose_merge_was_lost_are_apart_and_their_agents_told(joined: tuple[Agents, Station], words: Any) -> None:
    kept = snapshot(joined[1], SavedMap())
    count, roots = roots_told(kept.agents[AgentId(1)].own)
    assert count and roots == {0}
    texts = {name: text for name, text in kept.texts.items() if name != "mapper.map"}
    station = new_station(words, session=3)
    restored = restore(station, replace(kept, texts=texts, faults=("state 'mapper.map' was altered",)), 0)
    assert any("linked to landmarks of another map, or to none" in fault for fault in restored.faults)
    end = station.channels[AgentId(1)]
    assert isinstance(end, CodedChannel)
    for n in range(5):
        station.step({}, [], n * STEP_NS)
    assert roots_told(end.endpoint.own_values()) == (count, set())


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
