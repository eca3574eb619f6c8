"""Which matches, ties, results and commands change maps, and which do not."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.inertial.ties import InertialTie
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.management import Command
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.merging.loop_edges import LoopEdge, LoopMatch, slot_pairs
from kiteline_basestation.merging.merges import NOTHING
from kiteline_basestation.refinement import landmark_matching
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


def test_loop_edges_of_a_deleted_map_go_with_it(make_flight: MakeFlight, words: Any) -> None:
    mapper, maps = mapped(make_flight, words, 2)
    first, second = (mapper.map.submaps[submap][:2] for submap in maps)
    assert mapper.merger is not None
    ends = [(first[1], first[0]), (second[1], first[0]), (first[1], second[0]), (second[1], second[0])]
    mapper.merger._edges = [LoopEdge(new, old, np.eye(4), 40, 3.0) for new, old in ends]
    mapper.step(MapperInput((), (), (Command(1, "delete", '{"map": "1.1.0"}'),)), 10**12)
    assert [(edge.new, edge.old) for edge in mapper.merger.edges] == ends[:1]


def test_keyframes_of_a_deleted_map_are_not_searched(make_flight: MakeFlight, words: Any) -> None:
    mapper, (older, newer) = mapped(make_flight, words, 2)
    merger = mapper.merger
    assert merger is not None
    merger.search_overlap(newer, older)
    assert not merger.idle
    output = mapper.step(MapperInput((), (), (Command(1, "delete", '{"map": "1.1.0"}'),)), 10**12)
    assert output.answers[0].ok and output.jobs == () and merger.idle


def test_landmarks_by_which_two_maps_are_merged_become_one(
    make_flight: MakeFlight, words: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once: matching around the keyframes, which finds most of them again, is left out here."""
    monkeypatch.setattr(landmark_matching, "match_landmarks", lambda *given: 0)
    a = make_flight(keyframes=10, turns=0.2)
    b = make_flight(keyframes=10, turns=0.2, start=0.1, variant=1, agent=1, T_w_m=ELSEWHERE)
    mapper, matches = Mapper(WITHOUT_GRID, words), list[LoopMatch]()
    merger = mapper.merger
    assert merger is not None
    close = merger._close
    merger._close = lambda found, keyframe: (matches.extend(found.matches), close(found, keyframe))[1]  # type: ignore[method-assign]
    feed(mapper, [a, b])
    assert mapper.summary()["merges"] == 1
    root = mapper.map.keypoints.root
    pairs = [slot_pairs(mapper.map, match.new_landmarks, match.old_landmarks) for match in matches]
    new, old = (np.concatenate([pair[side] for pair in pairs]) for side in (0, 1))
    assert len(new) > 50 and np.mean(root[new] == root[old]) > 0.9
