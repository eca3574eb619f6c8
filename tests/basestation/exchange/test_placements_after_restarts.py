"""Placements that agents hold when a base starts anew: those without a map end, all others stay as they are."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.management import Command
from kiteline_basestation.station import Station
from kiteline_basestation.store.keeper import snapshot
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.saved_map import SavedMap
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import CameraIntrinsics, Record, SubmapPlacement
from kiteline_codec.sync.config import SyncConfig
from kiteline_core.arrays import F64
from kiteline_core.ids import SubmapId, submap_of_keyframe
from tests.basestation.feeding import WITHOUT_GRID
from tests.basestation.saved_flights import ELSEWHERE, Agents, MakeFlight, new_station

LINKS = pytest.mark.parametrize("lose", [0.0, 0.3], ids=["whole", "lossy"])
FAR_NS = 60 * 10**9


class AgentEnd(CodedChannel):
    """An agent's channel over a link that may lose and reorder packets, with the placements that it holds."""

    def __init__(self, lose: float, seed: int) -> None:
        super().__init__(SyncConfig(), 1)
        self._lose, self._random = lose, np.random.default_rng(seed)
        self._late: list[bytes] = []
        self.placed: dict[SubmapId, F64] = {}
        self.ended = 0  # placements that were withdrawn

    def _arriving(self, packets: Sequence[bytes]) -> list[bytes]:
        here = [packet for packet in packets if self._random.random() >= self._lose]
        if self._lose:
            arrived, held_up = self._late, []
            for packet in here:
                (held_up if self._random.random() < self._lose else arrived).append(packet)
            here, self._late = arrived, held_up
            self._random.shuffle(here)
        return here

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        records = super().receive(self._arriving(packets), now_ns)
        for record in records:
            if isinstance(record, SubmapPlacement):
                self.placed[record.submap] = record.S_w_m
        for key in self.take_removed():
            if key.kind == SubmapPlacement.KIND:
                self.ended += self.placed.pop(SubmapId(key.id), None) is not None
        return records

    def poll(self, now_ns: int) -> list[bytes]:
        return [packet for packet in super().poll(now_ns) if self._random.random() >= self._lose]


def agents_of(flights: list[Any], lose: float) -> tuple[Agents, list[AgentEnd]]:
    agents = Agents(flights)
    ends = [AgentEnd(lose, seed) for seed, _ in enumerate(flights)]
    for flight, end in zip(flights, ends, strict=True):
        agents.ends[flight.agent] = end
        end.put(CameraIntrinsics(flight.agent, flight.camera))
    return agents, ends


def restarted(station: Station, agents: Agents, words: Any, session: int) -> Station:
    """The next base, with what this one had in its store."""
    after = new_station(words, session)
    restore(after, snapshot(station, SavedMap()), agents.now_ns)
    agents.base_died()
    return after


def delete(station: Station, agents: Agents, name: str) -> None:
    """Delete a map while no agent is in reach."""
    for orders in ([Command(1, "delete", json.dumps({"map": name}))], []):
        agents.now_ns += FAR_NS
        output = station.step({}, [], agents.now_ns, orders)
        assert all(answer.ok for answer in output.answers), output.answers


@LINKS
@pytest.mark.parametrize("deletes", ["before", "after"])
def test_a_map_that_is_deleted_about_a_restart_has_no_place_on_board(
    make_flight: MakeFlight, words: Any, deletes: str, lose: float
) -> None:
    """The base that had told the placement is gone, and the next one did not know that the agent held it."""
    flight = make_flight(keyframes=6, turns=0.1)
    agents, (end,) = agents_of([flight], lose)
    station = new_station(words)
    agents.fly(station, 0, 60)
    assert list(end.placed) == [submap_of_keyframe(flight.keyframes[0])]
    if deletes == "before":
        delete(station, agents, "0.1.0")
    station = restarted(station, agents, words, 2)
    if deletes == "after":
        delete(station, agents, "0.1.0")
    agents.fly(station, 60, 120)
    assert end.placed == {} and end.ended == 1
    agents.fly(restarted(station, agents, words, 3), 120, 180)
    assert end.placed == {}


@LINKS
@pytest.mark.parametrize("slow", [False, True])
def test_a_base_that_only_starts_anew_moves_and_ends_nothing(
    make_flight: MakeFlight, words: Any, lose: float, slow: bool
) -> None:
    """Nor one that takes a minute to load its store."""
    flights = [
        make_flight(keyframes=20, turns=0.6),
        make_flight(keyframes=20, turns=0.6, start=0.3, variant=1, agent=1, T_w_m=ELSEWHERE),
    ]
    agents, ends = agents_of(flights, lose)
    station = new_station(words)
    agents.fly(station, 0, 90)
    before = [dict(end.placed) for end in ends]
    assert all(len(placed) == 1 for placed in before)
    for session in (2, 3):
        station = restarted(station, agents, words, session)
        if slow:
            agents.now_ns += FAR_NS
        agents.fly(station, 90, 90 + 60, lambda: held(ends, before))
    assert not any(end.ended for end in ends)


def held(ends: list[AgentEnd], before: list[dict[SubmapId, F64]]) -> None:
    for end, placed in zip(ends, before, strict=True):
        assert end.placed.keys() == placed.keys()
        assert all(np.array_equal(end.placed[submap], S_w_m) for submap, S_w_m in placed.items())


@LINKS
def test_a_base_that_lost_its_map_ends_no_placement_before_it_knows_the_submap(
    make_flight: MakeFlight, words: Any, lose: float
) -> None:
    flight = make_flight(keyframes=8, turns=0.1)
    agents, (end,) = agents_of([flight], lose)
    agents.fly(new_station(words), 0, 40)
    agents.base_died()
    after = new_station(words, 2)
    agents.fly(after, 40, 100, lambda: held([end], [dict(end.placed)]))
    assert end.ended == 0 and list(end.placed) == list(after.mapper.placements)


@LINKS
def test_agents_apart_from_the_next_world_leave_it_until_their_maps_are_merged(
    make_flight: MakeFlight, words: Any, lose: float
) -> None:
    """Two agents shared a world. The base that lost it begins one with the first of them: the other is not in it."""
    flights = [
        make_flight(keyframes=20, turns=0.6),
        make_flight(keyframes=20, turns=0.6, start=0.3, variant=1, agent=1, T_w_m=ELSEWHERE),
    ]
    agents, (first, second) = agents_of(flights, lose)
    agents.fly(new_station(words), 0, 90)
    assert first.placed and second.placed
    agents.base_died()
    unmerged = Station(WITHOUT_GRID, lambda agent: CodedChannel(SyncConfig(), 2))  # without words, it merges nothing
    agents.fly(unmerged, 90, 170)
    placed = unmerged.mapper.placements
    assert len(placed) == 1 and [end.placed.keys() for end in (first, second)].count(placed.keys()) == 1
    assert sorted([first.ended, second.ended]) == [0, 1]
