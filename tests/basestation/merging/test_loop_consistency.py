"""Which matches agree on one correction, against plain similarities; which show more than the expected drift."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import LoopConfig
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging import loop_consistency
from kiteline_basestation.merging.loop_consistency import agreeing
from kiteline_basestation.merging.loop_detector import LoopClosure, LoopDetector
from kiteline_basestation.merging.loop_edges import LoopMatch, correction_of, depth_of
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import (
    NO_KEYFRAME,
    AgentId,
    KeyframeId,
    agent_of_submap,
    keyframe_id,
    point_id,
    submap_id,
    submap_of_keyframe,
)

A, B = submap_id(0, 1, 0), submap_id(1, 1, 0)


def agree(sparse_map: SparseMap, a: LoopMatch, b: LoopMatch) -> bool:
    """The reference: matrix by matrix."""
    Xa, Xb = correction_of(sparse_map, a), correction_of(sparse_map, b)
    same_submap = submap_of_keyframe(a.new) == submap_of_keyframe(b.new)
    if not same_submap:
        Xa = sim3.inverse(Xa)
    if abs(np.log(sim3.scale_of(Xa) / sim3.scale_of(Xb))) > loop_consistency._AGREE_SCALE:
        return False
    T_w_a, T_w_b = sparse_map.world_pose(a.new), sparse_map.world_pose(b.new)
    assert T_w_a is not None and T_w_b is not None
    at = T_w_b[:3, 3]
    apart = float(np.linalg.norm(se3.transform(Xa, at[None])[0] - se3.transform(Xb, at[None])[0]))
    path = float(np.linalg.norm(T_w_a[:3, 3] - at)) if same_submap else 0.0
    depth = max(depth_of(sparse_map, a), depth_of(sparse_map, b))
    turn = se3.so3_log(sim3.rigid(sim3.inverse(Xa) @ Xb)[:3, :3])
    limit = loop_consistency._AGREE_M + loop_consistency._AGREE_DEPTH * depth + loop_consistency._AGREE_PATH * path
    return apart <= limit and float(np.linalg.norm(turn)) <= loop_consistency._AGREE_RAD


def test_those_agree_that_imply_one_correction() -> None:
    rng, counted = np.random.default_rng(0), []
    for unit in (1.0, 0.6):
        sparse_map = SparseMap()
        for submap in (A, B):
            for k in range(12):
                T = se3.exp(np.concatenate([rng.normal(0.0, 2.0, 3), rng.normal(0.0, 1.0, 3)]))
                sparse_map.add_keyframe(keyframe_id(submap, k), k, NO_KEYFRAME, T, 0)
        sparse_map.scale_submap(B, unit)
        X = sim3.of(1.3, se3.exp(np.array([3.0, -1.0, 0.5, 0.1, -0.2, 2.0])))

        def match(
            new: KeyframeId, old: KeyframeId, X_here: np.ndarray, sparse_map: SparseMap = sparse_map
        ) -> LoopMatch:
            """One that implies the correction X_here up to noise, now within the limits and now beyond."""
            S_w_old, S_w_new = (
                sim3.of(float(sparse_map.keyframes.scale[sparse_map.rows[k]]), sparse_map.world_pose(k))  # type: ignore[arg-type]
                for k in (old, new)
            )
            size = rng.choice([0.01, 0.1, 0.3])
            noise = sim3.of(
                float(np.exp(rng.normal(0.0, 0.3 * size))), se3.exp(rng.normal(0.0, size, 6) * [1, 1, 1, 0.2, 0.2, 0.2])
            )
            S = noise @ sim3.inverse(S_w_old) @ X_here @ S_w_new
            return LoopMatch(new, old, sim3.rigid(S), 50, float(rng.uniform(1.0, 5.0)), sim3.scale_of(S))

        matches = [match(keyframe_id(A, k), keyframe_id(B, k), X) for k in range(12)]
        matches += [match(keyframe_id(B, k), keyframe_id(A, 11 - k), sim3.inverse(X)) for k in range(12)]
        for last in range(len(matches)):
            listed = [*matches[:last], *matches[last + 1 :], matches[last]]
            expected = [m for m in listed if agree(sparse_map, m, matches[last])]
            assert [(m.new, m.old) for m in agreeing(sparse_map, listed)] == [(m.new, m.old) for m in expected]
            assert expected[-1] is matches[last]
            counted.append(len(expected))
    assert min(counted) < 6 < max(counted) < 24  # some agree, some do not


@pytest.fixture
def drifted(monkeypatch: pytest.MonkeyPatch) -> Callable[[Sequence[float]], tuple[SparseMap, list[LoopMatch]]]:
    """Makes a map in which an agent comes back to its straight path of ten metres, and its matches."""
    monkeypatch.setattr(loop_consistency, "has_depth_relief", lambda *_: True)

    def make(way_m: Sequence[float]) -> tuple[SparseMap, list[LoopMatch]]:
        """way_m: positions of the keyframes that come back. They lie a metre beside where they truly are."""
        sparse_map = SparseMap()
        for k in range(20):
            T = se3.from_rt(np.eye(3), np.array([0.5 * k, 0.0, 0.0]))
            sparse_map.add_keyframe(keyframe_id(A, k), k, NO_KEYFRAME, T, 0)
        matches = []
        for n, x_m in enumerate(way_m):
            new, old = keyframe_id(A, 40 + n), keyframe_id(A, n)
            sparse_map.add_keyframe(new, 40 + n, NO_KEYFRAME, se3.from_rt(np.eye(3), np.array([x_m, 1.0, 0.0])), 0)
            T_old_new = se3.from_rt(np.eye(3), np.array([x_m - 0.5 * n, 0.0, 0.0]))
            matches.append(LoopMatch(new, old, T_old_new, 60, 3.0))
        return sparse_map, matches

    return make


def weighed(sparse_map: SparseMap, matches: Sequence[LoopMatch], words: Any) -> list[object]:
    """What a detector makes of matches, one after the other."""
    detector = LoopDetector(LoopConfig(), sparse_map, words)
    return [detector._weigh(match) for match in matches]


def test_keyframes_along_a_path_show_more_than_the_expected_drift(drifted: Any, words: Any) -> None:
    sparse_map, matches = drifted([0.5 * n for n in range(12)])
    found = weighed(sparse_map, matches, words)
    assert found[:-1] == [None] * 11 and isinstance(found[-1], LoopClosure)


@pytest.mark.parametrize("lacks", ["inliers", "old keyframes", "level", "relief"])
def test_what_shows_more_than_the_expected_drift_is_strong_spread_and_level(
    drifted: Any, words: Any, lacks: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sparse_map, matches = drifted([0.5 * n for n in range(12)])
    if lacks == "relief":
        monkeypatch.setattr(loop_consistency, "has_depth_relief", lambda *_: False)
    elif lacks == "inliers":
        matches = [replace(m, inliers=LoopConfig().min_inliers_loop - n % 2) for n, m in enumerate(matches)]
    elif lacks == "old keyframes":
        one = keyframe_id(A, 4)
        T_one_w = se3.inverse(sparse_map.world_pose(one))
        matches = [replace(m, old=one, T_old_new=T_one_w @ sparse_map.world_pose(m.old) @ m.T_old_new) for m in matches]
    else:
        tilt = se3.from_rt(se3.so3_exp(np.array([0.2, 0.0, 0.0])), np.zeros(3))
        matches = [
            replace(
                m,
                T_old_new=se3.inverse(sparse_map.world_pose(m.old)) @ tilt @ sparse_map.world_pose(m.old) @ m.T_old_new,
            )
            for m in matches
        ]
        for keyframe in sparse_map.rows:
            sparse_map.up[keyframe] = np.array([0.0, -1.0, 0.0]), 0.005
    assert weighed(sparse_map, matches, words) == [None] * 12


def moved_by(sparse_map: SparseMap, new: KeyframeId, old: KeyframeId, X: np.ndarray) -> LoopMatch:
    """A match whose correction moves the new keyframe by X, a similarity (4,4) about it."""
    S_w_new, S_w_old = (sim3.of(1.0, sparse_map.world_pose(k)) for k in (new, old))  # type: ignore[arg-type]
    S = sim3.inverse(S_w_old) @ S_w_new @ X
    return LoopMatch(new, old, sim3.rigid(S), 60, 3.0, sim3.scale_of(S))


def motion(metres: float = 0.0, rad: float = 0.0, scale: float = 1.0) -> np.ndarray:
    return sim3.of(scale, se3.from_rt(se3.so3_exp(np.array([0.0, rad, 0.0])), np.array([metres, 0.0, 0.0])))


@pytest.mark.parametrize("stereo", [True, False])
def test_drift_explains_corrections_that_grow_with_the_path(stereo: bool) -> None:
    config = LoopConfig()
    sparse_map = SparseMap()
    sparse_map.set_camera(AgentId(0), RectifiedCamera(752, 480, 420.0, 420.0, 376.0, 240.0, 0.11, stereo, np.eye(4)))
    for k in range(41):
        T = se3.from_rt(np.eye(3), np.array([float(min(k, 40 - k)), 0.0, 0.0]))  # there and back
        sparse_map.add_keyframe(keyframe_id(A, k), k, NO_KEYFRAME, T, 0)
    share = config.drift_path if stereo else loop_consistency.MONOCULAR_DRIFT_PATH
    for begin, path_m in ((0, 40.0), (10, 20.0)):
        old, new = keyframe_id(A, begin), keyframe_id(A, 40 - begin)
        most_m = config.drift_m + share * path_m
        most_rad = loop_consistency._DRIFT_RAD + loop_consistency._DRIFT_RAD_M * path_m
        for part, explained in ((0.99, True), (1.01, False)):
            for X in (motion(metres=part * most_m), motion(rad=part * most_rad)):
                edge = moved_by(sparse_map, new, old, X)
                assert loop_consistency.within_drift(sparse_map, edge, config) == explained
                assert loop_consistency.within_drift(sparse_map, edge, config, 2.0)
        for scale, explained in ((1.4, True), (1.6, False)):
            edge = moved_by(sparse_map, new, old, motion(scale=scale))
            assert loop_consistency.within_drift(sparse_map, edge, config) == explained
        edge = moved_by(sparse_map, new, old, motion(metres=1.5 * most_m, scale=1.3))
        assert loop_consistency.within_drift(sparse_map, edge, config) != stereo  # scale drift displaces the end, too


def test_landmarks_are_fused_at_once_where_nothing_has_to_bend(drifted: Any) -> None:
    sparse_map, _ = drifted([])
    new, old = keyframe_id(A, 19), keyframe_id(A, 2)
    limits = {"metres": loop_consistency._FUSE_M, "rad": loop_consistency._FUSE_RAD}
    for part, fusible in ((0.98, True), (1.02, False)):
        for name, most in limits.items():
            edge = moved_by(sparse_map, new, old, motion(**{name: part * most}))
            assert loop_consistency.is_fusible(sparse_map, edge) == fusible
        edge = moved_by(sparse_map, new, old, motion(scale=float(np.exp(part * loop_consistency._FUSE_SCALE))))
        assert loop_consistency.is_fusible(sparse_map, edge) == fusible


def test_keyframes_that_go_to_and_fro_are_one_match(drifted: Any, words: Any) -> None:
    sparse_map, matches = drifted([0.5 * (n % 3) for n in range(20)])
    assert weighed(sparse_map, matches, words) == [None] * 20


def test_keyframes_that_see_two_places_do_not_agree(drifted: Any, words: Any) -> None:
    sparse_map, matches = drifted([0.5 * n for n in range(12)])
    away = se3.from_rt(np.eye(3), np.array([0.0, 0.0, 2.0]))
    elsewhere = [replace(m, old=keyframe_id(A, 0), T_old_new=away @ m.T_old_new) for m in matches]
    both = [m for pair in zip(elsewhere, matches, strict=True) for m in pair]
    assert weighed(sparse_map, both, words) == [None] * 24


def twice(points: np.ndarray) -> tuple[SparseMap, Callable[[KeyframeId, KeyframeId], LoopMatch]]:
    """Two maps with two keyframes each, which all see points (n,3); makes matches of two of these."""
    sparse_map, n, none = SparseMap(), np.arange(len(points)), np.zeros(len(points), np.uint8)
    camera = RectifiedCamera(752, 480, 420.0, 420.0, 376.0, 240.0, 0.11, True, np.eye(4))
    uv = (420.0 * points[:, :2] / points[:, 2:] + [376.0, 240.0]).astype(np.float32)
    for submap, T_w_m in ((A, np.eye(4)), (B, se3.exp(np.array([2.0, 1.0, -3.0, 0.3, 0.8, 0.1])))):
        sparse_map.set_camera(agent_of_submap(submap), camera)
        for k in range(2):
            keyframe = keyframe_id(submap, k)
            sparse_map.add_keyframe(keyframe, k, NO_KEYFRAME, np.eye(4), len(points))
            sparse_map.put_new_landmarks(
                keyframe, 0, n.astype(np.uint16), uv, (1.0 / points[:, 2]).astype(np.float32),
                none, none, np.zeros((len(points), 32), np.uint8),
            )  # fmt: skip
        sparse_map.move_submap(submap, T_w_m)

    def match(new: KeyframeId, old: KeyframeId) -> LoopMatch:
        ids = (point_id(k, 0) + n for k in (new, old))
        return LoopMatch(new, old, np.eye(4), len(points), 3.0, 1.0, *ids)

    return sparse_map, match


def picture(count: int, off: int, off_m: float, noise_m: float = 0.0) -> np.ndarray:
    """Points (count,3) on a plane 3 m ahead, of which `off` at its left lie before it."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-1.5, 1.5, (count, 2)), rng.normal(3.0, noise_m, count)])
    points = points[np.argsort(points[:, 0])]
    points[:off, 2] -= off_m
    return points


def test_a_flat_picture_is_flat_also_where_matches_lead_both_ways() -> None:
    """Points of two maps that are not aligned yet lie in no common plane: each map's own tell."""
    sparse_map, match = twice(picture(60, 0, 0.0))
    matches = [match(keyframe_id(A, k), keyframe_id(B, k)) for k in range(2)]
    matches += [match(keyframe_id(B, k), keyframe_id(A, 1 - k)) for k in range(2)]
    assert not loop_consistency.has_depth_relief(sparse_map, matches[:2], LoopConfig())
    assert not loop_consistency.has_depth_relief(sparse_map, matches, LoopConfig())
    assert not loop_consistency.has_depth_relief(sparse_map, matches[::-1], LoopConfig())


@pytest.mark.parametrize(
    ("count", "off", "off_m", "noise_m", "relief"),
    [
        (100, 20, 0.5, 0.01, True), (100, 12, 0.5, 0.01, False), (100, 45, 0.5, 0.01, True),
        (100, 20, 0.04, 0.01, False), (100, 0, 0.0, 0.03, False), (19, 9, 0.5, 0.01, False),
    ],
)  # fmt: skip
def test_enough_landmarks_have_to_lie_off_the_plane_of_most(
    count: int, off: int, off_m: float, noise_m: float, relief: bool
) -> None:
    sparse_map, match = twice(picture(count, off, off_m, noise_m))
    matches = [match(keyframe_id(A, 0), keyframe_id(B, 0))]
    assert loop_consistency.has_depth_relief(sparse_map, matches, LoopConfig()) == relief


@pytest.mark.parametrize(("tilt_rad", "merged"), [(0.0, True), (0.3, False)])
def test_maps_are_not_merged_that_gravity_would_tilt(drifted: Any, words: Any, tilt_rad: float, merged: bool) -> None:
    sparse_map, _ = drifted([])
    tilt = se3.from_rt(se3.so3_exp(np.array([tilt_rad, 0.0, 0.0])), np.zeros(3))
    matches = []
    for k in range(6):
        new, old = keyframe_id(B, k), keyframe_id(A, k)
        sparse_map.add_keyframe(new, k, NO_KEYFRAME, se3.from_rt(np.eye(3), np.array([0.5 * k, 0.0, 0.0])), 0)
        for keyframe in (new, old):
            sparse_map.up[keyframe] = np.array([0.0, -1.0, 0.0]), 0.005
        there = se3.inverse(sparse_map.world_pose(old)) @ tilt @ sparse_map.world_pose(new)
        matches.append(LoopMatch(new, old, there, 60, 3.0))
    detector = LoopDetector(LoopConfig(), sparse_map, words)
    detector._is_ambiguous = lambda keyframe: False  # type: ignore[method-assign]
    found = [detector._weigh(match) for match in matches]
    assert any(isinstance(closure, LoopClosure) for closure in found) == merged
    assert detector.refused == (0 if merged else len(matches))
