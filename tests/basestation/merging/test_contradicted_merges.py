"""When a full bundle contradicts a merge: by what the moved map observes of the landmarks that the merge fused."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.mapper import Mapper
from kiteline_basestation.merging.correction import full_bundle_window
from kiteline_basestation.merging.merges import MapMerge, fused_across, is_contradicted
from kiteline_basestation.refinement.bundle_window import BundleWindow
from kiteline_core.arrays import Bool
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import SEQUENCE_BITS, submap_of_keyframe
from kiteline_core.optimisation.bundle import BundleResult
from tests.basestation.feeding import WITHOUT_GRID, feed

ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))


@pytest.fixture(scope="module")
def merged(make_flight: Callable[..., Any], words: Any) -> tuple[Mapper, BundleWindow, Bool]:
    """Two maps that are one, its full bundle, and which of its observations bear on the merge."""
    a = make_flight(keyframes=12, turns=0.3)
    b = make_flight(keyframes=12, turns=0.3, start=0.1, variant=1, agent=1, T_w_m=ELSEWHERE)
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [a, b])
    sparse_map, merger = mapper.map, mapper.merger
    assert merger is not None
    (merge,) = merger.merges
    window = full_bundle_window(sparse_map, merge.into, merger.edges, mapper.config)
    assert window is not None
    root, fused = sparse_map.keypoints.root, fused_across(sparse_map, merge.moved)
    pairs = [sparse_map.landmark_ids(slots) for slots in (fused, root[fused])]
    merger.merges[0] = replace(merge, fused=np.stack(pairs, 1))
    moved = sparse_map.keyframes.id[sparse_map.keypoints.row[window.slots]] >> SEQUENCE_BITS == merge.map_id
    return mapper, window, moved & np.isin(root[window.slots], root[fused])


def contradicts(merged: tuple[Mapper, BundleWindow, Bool], inlier: Bool, merge: MapMerge | None = None) -> bool:
    mapper, window, _ = merged
    assert mapper.merger is not None
    result = BundleResult(window.problem.T_c_m, window.problem.points, inlier, 0.0, 0.0, 1, 0)
    return is_contradicted(mapper.map, merge or mapper.merger.merges[0], window, result, mapper.config)


@pytest.mark.parametrize(("rejected", "contradicted"), [(0.0, False), (0.45, False), (0.55, True), (1.0, True)])
def test_a_merge_is_contradicted_where_most_of_what_it_fused_is_rejected(
    merged: tuple[Mapper, BundleWindow, Bool], rejected: float, contradicted: bool
) -> None:
    _, _, bearing = merged
    inlier = np.ones(len(bearing), np.bool_)
    which = np.flatnonzero(bearing)
    inlier[which[: round(rejected * len(which))]] = False
    assert contradicts(merged, inlier) == contradicted


def test_what_does_not_bear_on_a_merge_does_not_contradict_it(merged: tuple[Mapper, BundleWindow, Bool]) -> None:
    mapper, _, bearing = merged
    assert not contradicts(merged, bearing)
    assert mapper.merger is not None
    few = replace(mapper.merger.merges[0], fused=mapper.merger.merges[0].fused[:2])
    assert not contradicts(merged, np.zeros(len(bearing), np.bool_), few)


def test_keyframes_of_a_merged_map_are_searched_for_in_the_other_one(
    make_flight: Callable[..., Any], words: Any
) -> None:
    flights = [make_flight(keyframes=6, turns=0.1), make_flight(keyframes=6, turns=0.1, seed=9, agent=1)]
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, flights)
    assert mapper.merger is not None
    older, newer = (submap_of_keyframe(flight.keyframes[0]) for flight in flights)
    mapper.merger.merge(newer, older, sim3.of(1.0, ELSEWHERE))
    assert list(mapper.merger.state().requery) == flights[1].keyframes
