"""Maps that were merged wrongly, all checks before a merge being off: later matches undo it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.merging import loop_consistency
from kiteline_basestation.merging.loop_detector import LoopClosure, LoopDetector
from kiteline_basestation.merging.merges import MapMerge, MergeResult
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import submap_of_keyframe
from tests.basestation.conftest import straight, two_rooms
from tests.basestation.feeding import WITHOUT_GRID, feed

ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))
CREDULOUS = replace(WITHOUT_GRID, loops=replace(BaseConfig().loops, min_matched_share=0.0, min_inliers_all=20))


@pytest.mark.parametrize("stereo", [True, False])
@pytest.mark.parametrize("places", ["rooms with one wallpaper", "rooms that share half of it", "pieces of a corridor"])
def test_a_wrong_merge_is_undone_by_later_matches(
    make_flight: Callable[..., Any], words: Any, monkeypatch: pytest.MonkeyPatch, places: str, stereo: bool
) -> None:
    """All that it fused fits: a bundle rejects hardly any of it. That keyframes match elsewhere is what tells."""
    monkeypatch.setattr(loop_consistency, "has_depth_relief", lambda *_: True)
    monkeypatch.setattr(LoopDetector, "_is_ambiguous", lambda *_: False)
    if "rooms" in places:
        scenes = two_rooms(1.0 if "one" in places else 0.5, 40)
        keyframes, turns, start = 24, 0.72, 0.0
    else:
        scenes = 2 * (straight(10, 3.0, 1.0, 12),)
        keyframes, turns, start = 16, 0.3, 0.4
    given = {"keyframes": keyframes, "turns": turns, "stereo": stereo}
    other = {"scene": scenes[1], "start": start, "agent": 1, "variant": 1, "T_w_m": ELSEWHERE}
    flights = [make_flight(scene=scenes[0], **given), make_flight(**given, **other)]
    mapper = Mapper(CREDULOUS, words)
    merger = mapper.merger
    assert merger is not None
    merge, undo, known = merger._merge, merger.undo, list[int]()

    def merge_and_count(closure: LoopClosure) -> MergeResult:
        known.append(len(mapper.map.rows))
        return merge(closure)

    def undo_and_count(wrong: MapMerge) -> MergeResult:
        known.append(len(mapper.map.rows))
        return undo(wrong)

    monkeypatch.setattr(merger, "_merge", merge_and_count)
    monkeypatch.setattr(merger, "undo", undo_and_count)
    feed(mapper, flights)
    assert mapper.summary()["merges"] == 0 and mapper.summary()["merges_undone"] == len(known) / 2
    merged, undone = known[:2]
    assert undone - merged <= 20  # keyframes of both agents


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
