"""What rests on a merge that is undone, and whether it is made again."""

import itertools
import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.management import Command
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.merging.loop_detector import Contradiction
from kiteline_basestation.store.integrity import contradictions
from kiteline_codec.schema import Key, SubmapPlacement
from kiteline_core.geometry import se3
from kiteline_core.ids import submap_of_keyframe
from tests.basestation.feeding import STEP_NS, WITHOUT_GRID, feed

MakeFlight = Callable[..., Any]
ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))
ELSEWHERE_TOO = se3.exp(np.array([-2.0, 2.0, 0.1, 0.01, 0.02, -0.7]))


def order(mapper: Mapper, verb: str, clock: Iterator[int], **given: Any) -> None:
    """Carry a command out, and run the jobs that follow."""
    output = mapper.step(MapperInput((), (), (Command(1, verb, json.dumps(given)),)), next(clock))
    assert output.answers[0].ok, output.answers[0].text
    rest(mapper, clock, output)


def rest(mapper: Mapper, clock: Iterator[int], output: Any = None) -> None:
    """Step until the mapper is idle."""
    while output is None or not mapper.idle:
        done = () if output is None else tuple(run_job(job) for job in output.jobs)
        output = mapper.step(MapperInput((), done), next(clock))


@pytest.mark.parametrize("by_user", [True, False])
def test_a_map_that_matched_a_wrongly_merged_one_alone_goes_with_it(
    make_flight: MakeFlight, words: Any, by_user: bool
) -> None:
    """It stayed in the map with which it has nothing in common, where the wrong merge had put it."""
    other = make_flight(keyframes=12, turns=0.2, seed=9)
    wrong = make_flight(keyframes=20, turns=0.6, agent=1)
    last = make_flight(keyframes=20, turns=0.6, start=0.3, variant=1, agent=2, T_w_m=ELSEWHERE)
    mapper, clock = Mapper(WITHOUT_GRID, words), itertools.count(10**12, STEP_NS)
    feed(mapper, [other, wrong])
    order(mapper, "merge", clock, map="1.1.0", into="0.1.0", T_into_map=ELSEWHERE_TOO.ravel().tolist())
    feed(mapper, [last])
    maps = [submap_of_keyframe(flight.keyframes[0]) for flight in (other, wrong, last)]
    assert {mapper.map.map_id(submap) for submap in maps} == {maps[0]}
    merger = mapper.merger
    assert merger is not None
    if by_user:
        order(mapper, "split", clock, map="1.1.0")
    else:
        changes = merger.undo(merger.merges[0])
        mapper._apply_merges(changes)
        rest(mapper, clock)
    assert [mapper.map.map_id(submap) for submap in maps] == [maps[0], maps[1], maps[1]]
    assert contradictions(mapper) == []
    T_b_c = mapper.map.submap_pose(maps[1]), mapper.map.submap_pose(maps[2])
    assert np.allclose(se3.inverse(T_b_c[0]) @ T_b_c[1], ELSEWHERE, atol=0.03)


@pytest.mark.parametrize("stereo", [True, False])
def test_a_map_that_took_in_the_one_that_defines_w_loses_its_place_with_it(
    make_flight: MakeFlight, words: Any, stereo: bool
) -> None:
    """Its place rested on the undone merge alone."""
    first = make_flight(keyframes=12, turns=0.3, stereo=stereo)
    other = make_flight(keyframes=12, turns=0.3, seed=9, agent=1)
    mapper, clock = Mapper(WITHOUT_GRID, words), itertools.count(10**12, STEP_NS)
    feed(mapper, [first, other])
    maps = [submap_of_keyframe(flight.keyframes[0]) for flight in (first, other)]
    before = mapper.map.submap_pose(maps[0])
    order(mapper, "merge", clock, map="0.1.0", into="1.1.0", T_into_map=ELSEWHERE.ravel().tolist())
    assert mapper.map.map_id(maps[0]) == maps[1] and list(mapper.placements) == maps
    output = mapper.step(MapperInput((), (), (Command(1, "split", '{"map": "0.1.0"}'),)), next(clock))
    assert output.withdrawn == ((other.agent, Key(SubmapPlacement.KIND, maps[1], 0)),)
    assert np.array_equal(mapper.map.submap_pose(maps[0]), before)
    rest(mapper, clock, output)
    assert list(mapper.placements) == maps[:1]
    assert contradictions(mapper) == []


def test_matches_that_made_a_merge_do_not_make_it_again_once_others_contradict_it(
    make_flight: MakeFlight, words: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of two other submaps of the same maps contradict it: one match more made it anew, in every step."""
    a = make_flight(keyframes=20, turns=0.6)
    beside = make_flight(keyframes=8, turns=0.1, seed=9, agent=2)
    b = make_flight(keyframes=20, turns=0.6, start=0.3, variant=1, agent=1, T_w_m=ELSEWHERE)
    mapper, clock = Mapper(WITHOUT_GRID, words), itertools.count(10**12, STEP_NS)
    feed(mapper, [a, beside])
    order(mapper, "merge", clock, map="2.1.0", into="0.1.0", T_into_map=ELSEWHERE_TOO.ravel().tolist())
    feed(mapper, [b])
    merger = mapper.merger
    assert merger is not None
    maps = [submap_of_keyframe(flight.keyframes[0]) for flight in (a, b, beside)]
    assert {mapper.map.map_id(submap) for submap in maps} == {maps[0]}
    assert (maps[0], maps[1]) in merger.detector.state().matches
    merger.detector.requested.add((maps[0], maps[1]))  # as if a user had asked to search for it
    monkeypatch.setattr(merger.detector, "query", lambda keyframe: Contradiction((maps[1], maps[2])))
    merger.add_keyframe(b.keyframes[-1])
    assert [mapper.map.map_id(submap) for submap in maps] == [maps[0], maps[1], maps[0]]
    state = merger.detector.state()
    assert state.contradicted == {(maps[0], maps[1]): 1} and (maps[0], maps[1]) not in state.matches
    assert not state.requested
