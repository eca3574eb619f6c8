"""Geometric verification of one pair of keyframes of two maps: what it finds, in which unit, and what it asks for."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import LoopConfig
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.merging import loop_verification
from kiteline_basestation.merging.loop_edges import LoopMatch
from kiteline_basestation.merging.loop_verification import depth_scale, guessed_pose, spread_out, verify_loop
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import KeyframeId, submap_of_keyframe
from tests.basestation.feeding import WITHOUT_GRID, feed
from tests.basestation.test_monocular import in_own_unit

ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))
CONFIG, OLD, NEW = LoopConfig(), 5, 4
OLD_UNIT, NEW_UNIT = 1.3, 0.5  # of lengths in maps of one eye


@pytest.fixture(scope="module", params=["stereo", "one eye", "one eye, then stereo"])
def maps(request: pytest.FixtureRequest, make_flight: Callable[..., Any]) -> tuple[SparseMap, Any, Any]:
    """Two maps of one room that nobody has merged, and their flights, the older first."""
    of_old, of_new = request.param != "stereo", request.param == "one eye"
    a = make_flight(keyframes=12, turns=0.3, stereo=not of_old)
    b = make_flight(keyframes=12, turns=0.3, start=0.02, variant=1, agent=1, T_w_m=ELSEWHERE, stereo=not of_new)
    mapper = Mapper(WITHOUT_GRID)
    feed(mapper, [in_own_unit(a, OLD_UNIT) if of_old else a, in_own_unit(b, NEW_UNIT) if of_new else b])
    return mapper.map, a, b


def verified(maps: tuple[SparseMap, Any, Any], config: LoopConfig = CONFIG, **given: Any) -> LoopMatch | None:
    sparse_map, a, b = maps
    return verify_loop(sparse_map, b.keyframes[NEW], a.keyframes[OLD], config, **given)


def test_a_match_tells_how_the_cameras_lie_to_each_other_in_the_old_maps_unit(maps: tuple[SparseMap, Any, Any]) -> None:
    sparse_map, a, b = maps
    match = verified(maps)
    assert match is not None and match.inliers == len(match.new_landmarks) == len(match.old_landmarks) >= 35
    between = se3.inverse(a.true_T_w_k[OLD]) @ b.true_T_w_k[NEW]
    units = [
        unit if sparse_map.is_up_to_scale(submap_of_keyframe(keyframe)) else 1.0
        for unit, keyframe in ((OLD_UNIT, match.old), (NEW_UNIT, match.new))
    ]
    assert np.linalg.norm(match.T_old_new[:3, 3] - units[0] * between[:3, 3]) < 0.04 * units[0]
    assert np.linalg.norm(se3.so3_log(between[:3, :3].T @ match.T_old_new[:3, :3])) < 0.01
    assert match.scale == pytest.approx(units[0] / units[1], rel=0.03)
    rows = [(a.point_of[int(old)], b.point_of[int(new)]) for new, old in zip(match.new_landmarks, match.old_landmarks)]
    assert np.mean([old == new for old, new in rows]) > 0.97
    depths = se3.transform(se3.inverse(b.true_T_w_k[NEW]), a.world[[old for old, _ in rows]])[:, 2]
    assert match.depth_m == pytest.approx(units[0] * float(np.median(depths)), rel=0.05)


@pytest.mark.parametrize("moved", ["old", "new"])
def test_where_and_how_large_maps_lie_in_w_does_not_matter(maps: tuple[SparseMap, Any, Any], moved: str) -> None:
    sparse_map, a, b = maps
    before = verified(maps)
    submap = submap_of_keyframe((a if moved == "old" else b).keyframes[0])
    one_eye = sparse_map.is_up_to_scale(submap)
    held = sparse_map.submap_pose(submap)
    sparse_map.move_submap(
        submap, sim3.of(3.0 if one_eye else 1.0, se3.exp(np.array([5.0, 2.0, -1.0, 0.5, 0.4, -2.0])))
    )
    after = verified(maps)
    sparse_map.move_submap(submap, held)
    assert before is not None and after is not None
    np.testing.assert_allclose(after.T_old_new, before.T_old_new, atol=5e-3)
    assert [after.scale, after.depth_m] == pytest.approx([before.scale, before.depth_m], rel=5e-3)
    assert after.inliers == pytest.approx(before.inliers, abs=3)


def test_enough_landmarks_and_enough_of_those_in_view_have_to_agree(maps: tuple[SparseMap, Any, Any]) -> None:
    match = verified(maps)
    assert match is not None
    assert verified(maps, replace(CONFIG, min_inliers_all=match.inliers)) is not None
    assert verified(maps, replace(CONFIG, min_inliers_all=match.inliers + 1)) is None
    assert verified(maps, replace(CONFIG, min_matched_share=0.6)) is not None
    assert verified(maps, replace(CONFIG, min_matched_share=2.0)) is None


def test_guided_matching_begins_at_a_guess_where_no_pose_was_found(
    maps: tuple[SparseMap, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    sparse_map, a, b = maps
    match = verified(maps)
    assert match is not None
    for solve in ("_solve_pnp", "_solve_similarity"):
        monkeypatch.setattr(loop_verification, solve, lambda *_: None)
    assert verified(maps) is None
    T_w_old, T_w_new = (sparse_map.world_pose(f.keyframes[k]) for f, k in ((a, OLD), (b, NEW)))
    assert T_w_old is not None and T_w_new is not None
    off = se3.exp(np.array([0.02, 0.0, 0.0, 0.0, 0.01, 0.0]))
    X = sim3.of(match.scale, T_w_old @ match.T_old_new @ off) @ se3.inverse(T_w_new)
    guess = guessed_pose(sparse_map, X, b.keyframes[NEW])
    assert guess[1] == pytest.approx(match.scale)
    found = verified(maps, guess=guess)
    assert found is not None
    np.testing.assert_allclose(found.T_old_new, match.T_old_new, atol=0.02)
    assert found.scale == pytest.approx(match.scale, rel=0.02)


def test_views_of_different_places_are_not_verified(maps: tuple[SparseMap, Any, Any]) -> None:
    sparse_map, a, b = maps
    assert verify_loop(sparse_map, b.keyframes[-1], a.keyframes[0], CONFIG) is None


def test_a_distant_view_is_verified_by_landmarks_of_neighbours(
    maps: tuple[SparseMap, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One keyframe alone has too few of those that it shows."""
    sparse_map, a, b = maps
    pair, local = (b.keyframes[9], a.keyframes[3]), loop_verification.local_landmarks
    assert verify_loop(sparse_map, *pair, CONFIG) is not None
    monkeypatch.setattr(loop_verification, "local_landmarks", lambda of, keyframe, neighbours: local(of, keyframe, 0))
    assert verify_loop(sparse_map, *pair, CONFIG) is None


def ratios(logarithms: list[float]) -> float | None:
    own = np.linspace(1.0, 5.0, len(logarithms))
    return depth_scale(own, own * np.exp(logarithms))


def test_a_scale_is_told_by_enough_depths_that_agree_closely() -> None:
    assert ratios([0.7] * 20) == pytest.approx(np.exp(0.7)) and ratios([0.7] * 19) is None
    assert ratios([0.7] * 14 + [1.8] * 6) is not None and ratios([0.7] * 13 + [1.8] * 7) is None
    assert ratios([0.7] * 13 + [0.89] * 7) is not None and ratios([0.7] * 13 + [0.91] * 7) is None
    assert ratios([0.65] * 12 + [0.7] + [0.75] * 12) == pytest.approx(np.exp(0.7))  # known to 1.9 %
    assert ratios([0.64] * 12 + [0.7] + [0.76] * 12) is None  # to 2.2 %


def pixels(cells: int, each: int) -> F64:
    """So many pixels in each of the first cells of 6 by 4."""
    centres = [((c % 6 + 0.5) * 752 / 6, (c // 6 + 0.5) * 480 / 4) for c in range(cells)]
    return np.repeat(np.array(centres), each, axis=0)


@pytest.mark.parametrize(("cells", "each", "spread"), [(8, 2, True), (7, 20, False), (20, 1, False)])
def test_landmarks_have_to_fill_a_third_of_the_image(
    maps: tuple[SparseMap, Any, Any], cells: int, each: int, spread: bool
) -> None:
    sparse_map, a, _ = maps
    keyframe: KeyframeId = a.keyframes[0]
    assert spread_out(sparse_map, keyframe, pixels(cells, each), CONFIG) == spread
