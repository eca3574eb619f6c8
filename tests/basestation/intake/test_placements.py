"""Where submaps lie in the world, when one follows that will never be recognised in those before."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_codec.schema import CameraIntrinsics, Record, SubmapScale, SubmapTie
from kiteline_core.ids import keyframe_id, submap_id, submap_of_keyframe
from tests.basestation.feeding import STEP_NS, WITHOUT_GRID
from tests.basestation.test_monocular import in_own_unit

MakeFlight = Callable[..., Any]


@pytest.mark.parametrize("by", ["the same agent", "another agent", "the same agent, tied to a map without a place"])
def test_a_map_in_metres_begins_a_new_world_where_nothing_ties_it_to_one_in_another_unit(
    make_flight: MakeFlight, by: str
) -> None:
    """Grid and poses would be in no world for the rest of the flight; that of another agent is left alone."""
    agent = int(by == "another agent")
    own = in_own_unit(make_flight(keyframes=4, turns=0.07, stereo=False), 0.5)
    later = make_flight(agent=agent, keyframes=10, turns=0.18, start=0.5, submap=1, stereo=False)
    own_submap, submap = (submap_of_keyframe(f.keyframes[0]) for f in (own, later))
    mapper = Mapper(WITHOUT_GRID)
    withdrawn: list[int] = []
    metres: list[Record] = [SubmapScale(submap, 1.0)]
    if "tied" in by:
        between = keyframe_id(submap_id(later.agent, 1, 9), 3)
        metres.append(SubmapTie(submap, between, np.eye(4), 0.005, 0.002))
    said_of: list[tuple[Any, list[Record]]] = [(own, []), (later, metres)]
    for flight, said in said_of:
        for n, batch in enumerate([[CameraIntrinsics(flight.agent, flight.camera), *said], *flight.records, []]):
            output = mapper.step(MapperInput(((flight.agent, tuple(batch)),)), n * STEP_NS)
            withdrawn += [key.id for _, key in output.withdrawn]
            if n == 2:
                assert list(mapper.placements) == [own_submap]  # a tie may come late
    assert list(mapper.placements) == [own_submap if agent else submap]
    assert withdrawn == ([] if agent else [own_submap])


@pytest.mark.parametrize("keyframes", [1, 2])
@pytest.mark.parametrize("by", ["the same agent", "another agent"])
def test_a_start_that_was_broken_off_after_one_keyframe_does_not_keep_the_next_out_of_the_world(
    make_flight: MakeFlight, by: str, keyframes: int
) -> None:
    """No merge accepts matches with a keyframe alone, so that no later flight would ever have a place."""
    agent = int(by == "another agent")
    broken_off = make_flight(keyframes=keyframes, turns=0.02 * keyframes)
    later = make_flight(agent=agent, keyframes=10, turns=0.18, boot=2)
    first, submap = (submap_of_keyframe(f.keyframes[0]) for f in (broken_off, later))
    mapper = Mapper(WITHOUT_GRID)
    for flight in (broken_off, later):
        for n, batch in enumerate([[CameraIntrinsics(flight.agent, flight.camera)], *flight.records, []]):
            mapper.step(MapperInput(((flight.agent, tuple(batch)),)), n * STEP_NS)
    assert list(mapper.placements) == [submap if keyframes == 1 and not agent else first]
