"""Corrections that are not applied: results that are no numbers, and ties between maps that a user has split."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.inertial.ties import InertialTie
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.merging.merges import NOTHING
from kiteline_basestation.refinement.bundle_job import FULL_BUNDLE
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import SubmapId, submap_of_keyframe
from tests.basestation.feeding import STEP_NS, WITHOUT_GRID, feed

MakeFlight = Callable[..., Any]
ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))


def mapped(make_flight: MakeFlight, words: Any, agents: int) -> tuple[Mapper, list[SubmapId]]:
    """A base with a map of each agent, and their ids."""
    flights = [make_flight(keyframes=6, turns=0.15, seed=9 * agent + 1, agent=agent) for agent in range(agents)]
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, flights)
    return mapper, [submap_of_keyframe(flight.keyframes[0]) for flight in flights]


@pytest.mark.parametrize("spoilt", [None, "T_c_m", "points"])
def test_a_full_bundle_whose_result_is_no_number_moves_nothing(
    make_flight: MakeFlight, words: Any, spoilt: str | None
) -> None:
    mapper, (map_id,) = mapped(make_flight, words, 1)
    assert mapper.merger is not None
    mapper.merger._corrections.request_bundle(map_id)
    (job,) = mapper.step(MapperInput(()), 10**12).jobs
    assert job.kind == FULL_BUNDLE.name
    done = run_job(job)
    result = replace(done.result, T_c_m=np.array(done.result.T_c_m), points=np.array(done.result.points))
    result.T_c_m[-1, :3, 3] += 0.01
    if spoilt is not None:
        getattr(result, spoilt)[0] = np.nan
    last = mapper.map.submaps[map_id][-1]
    before = mapper.map.pose(last)
    mapper.step(MapperInput((), (replace(done, result=result),)), 10**12 + STEP_NS)
    assert np.array_equal(mapper.map.pose(last), before) == (spoilt is not None)


def test_maps_that_a_user_has_split_are_not_merged_by_inertial_steps(make_flight: MakeFlight, words: Any) -> None:
    mapper, (older, newer) = mapped(make_flight, words, 2)
    merger, tie = mapper.merger, InertialTie(newer, older, ELSEWHERE, 2.0)
    assert merger is not None
    merger.merge(newer, older, ELSEWHERE)
    assert merger.split(newer) is not None
    before = mapper.map.submap_pose(older), mapper.map.submap_pose(newer)
    assert merger.merge_tied(tie) == NOTHING
    assert np.array_equal((mapper.map.submap_pose(older), mapper.map.submap_pose(newer)), before)
    assert [mapper.map.map_id(submap) for submap in (older, newer)] == [older, newer] and not merger.merges
    merger.search_overlap(newer, older)  # they may be one map again
    assert merger.merge_tied(tie).rescaled == {older: 2.0}
    assert mapper.map.map_id(newer) == older
    assert sim3.scale_of(mapper.map.submap_pose(older)) == pytest.approx(2.0)
