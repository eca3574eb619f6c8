"""Records that come in any order, in part or not at all, while a user merges and splits maps: the base goes on."""

import json
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kiteline_basestation.management import Command, submap_name
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.runtime.worker import LockstepJobs
from kiteline_basestation.store.integrity import contradictions
from kiteline_basestation.store.state_texts import texts_of
from kiteline_codec.schema import CameraIntrinsics, Record
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from tests.basestation.feeding import STEP_NS, WITHOUT_GRID

MakeFlight = Callable[..., Any]
ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))


@pytest.fixture(scope="module")
def flights(make_flight: MakeFlight) -> Callable[[], list[Any]]:
    """One room, by two agents and by one of them again in another submap."""
    flown = [
        make_flight(keyframes=16, turns=0.4),
        make_flight(keyframes=16, turns=0.4, start=0.2, variant=1, agent=1, T_w_m=ELSEWHERE),
        make_flight(keyframes=10, turns=0.3, start=0.1, variant=2, submap=1),
    ]
    return lambda: flown  # whose text is short, where an example fails


def _order(mapper: Mapper, draw: Random, number: int) -> Command:
    names = [submap_name(submap) for submap in mapper.map.submaps]
    verb = draw.choice(("merge", "merge", "split"))
    given: dict[str, Any] = {"map": draw.choice(names)}
    if verb == "merge":
        given["into"] = draw.choice(names)
        given |= {"T_into_map": np.eye(4).ravel().tolist()} if draw.random() < 0.5 else {}
    return Command(number, verb, json.dumps(given))


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 1 << 20), lost=st.sampled_from([0.0, 0.05, 0.2]))
@example(seed=721, lost=0.05)  # a merge is undone that a later one held
@example(seed=32, lost=0.0)  # a map is split off whose landmarks an unfused match names
def test_the_base_goes_on(flights: Callable[[], list[Any]], words: Any, seed: int, lost: float) -> None:
    draw, mapper, jobs = Random(seed), Mapper(WITHOUT_GRID, words), LockstepJobs()
    waiting: list[tuple[AgentId, list[Record]]] = []
    for flight in flights():
        records: list[Record] = [CameraIntrinsics(flight.agent, flight.camera)] if draw.random() < 0.8 else []
        records += [record for group in flight.records for record in group if draw.random() >= lost]
        if draw.random() < 0.5:
            draw.shuffle(records)
        waiting.append((flight.agent, records))
    for n in range(50):
        arrivals = []
        for agent, records in waiting:
            count = draw.choice((1, 4, 12))
            arrivals.append((agent, tuple(records[:count])))
            del records[:count]
        orders = (_order(mapper, draw, n),) if mapper.map.submaps and draw.random() < 0.1 else ()
        done = jobs.done(n * STEP_NS)
        jobs.add(mapper.step(MapperInput(tuple(arrivals), done, orders), n * STEP_NS).jobs, n * STEP_NS)
        texts_of(mapper.state())  # as for a store
    assert contradictions(mapper) == []
