"""How far corrections move the map under the camera: with the landmarks in view, not with one keyframe."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.corrections import Corrections
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_agent.tracking.map_anchor import MapAnchor
from kiteline_agent.tracking.track import Track
from kiteline_codec.schema import CulledLandmarks, KeyframeHeader, KeyframePose, RefinedLandmarks
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, KeyframeId
from tests.agent.plain_landmarks import plain_landmarks

CAMERA = RectifiedCamera(752, 480, 450.0, 450.0, 370.0, 240.0, 0.11, True, np.eye(4))
CONFIG = AgentConfig()
LANDMARKS, IN_VIEW = 80, 60  # of each of three keyframes; the last one's are not tracked


def scene(seed: int = 0) -> tuple[LocalMap, Track]:
    """Three keyframes with landmarks, and a frame that tracks those of the first two without error."""
    rng = np.random.default_rng(seed)
    local_map = LocalMap(CAMERA, CONFIG.local_map)
    for k in range(3):
        z = rng.uniform(2.0, 8.0, LANDMARKS)
        uv = rng.uniform((80.0, 60.0), (680.0, 420.0), (LANDMARKS, 2))
        T_m_k = se3.exp(rng.normal(0.0, 0.05, 6))
        local_map.add(
            KeyframeHeader(KeyframeId(k), 0, NO_KEYFRAME, T_m_k, LANDMARKS), T_m_k,
            plain_landmarks(uv, 1.0 / z), 0,
        )  # fmt: skip
        local_map.share(KeyframeId(k), LANDMARKS)
    rows = np.concatenate([k * local_map.slot_size + np.arange(IN_VIEW) for k in range(2)]).astype(np.int64)
    T_c_m = se3.exp(rng.normal(0.0, 0.05, 6))
    xyz, ray = local_map.positions(rows)
    p = se3.transform(T_c_m, xyz)
    n = len(rows)
    observed = np.column_stack([
        CAMERA.fx * p[:, 0] / p[:, 2] + CAMERA.cx, CAMERA.fy * p[:, 1] / p[:, 2] + CAMERA.cy, CAMERA.bf / p[:, 2],
    ])  # fmt: skip
    return local_map, Track(T_c_m, rows, observed, np.full(n, 0.3), p[:, 2], np.ones(n, np.bool_), n, 1.0, n, xyz, ray)


def move(local_map: LocalMap, k: int, motion: F64) -> None:
    """Move a keyframe, as if the base had sent a pose that differs enough."""
    local_map.T_m_k[k] = pose_record(local_map, k, motion).T_m_k


def pose_record(local_map: LocalMap, k: int, motion: F64) -> KeyframePose:
    return KeyframePose(KeyframeId(k), motion @ local_map.T_m_k[k])


@given(st.integers(0, 1000))
def test_a_map_that_moves_as_a_whole_takes_the_camera_along(seed: int) -> None:
    local_map, track = scene(seed)
    anchor = MapAnchor(local_map, track, CONFIG, inertial=False)
    motion = se3.exp(np.random.default_rng(seed + 1).normal(0.0, 0.02, 6))
    for k in range(3):
        move(local_map, k, motion)
    found = anchor.motion()
    assert found is not None and found.growth == pytest.approx(1.0, abs=1e-5)
    assert np.allclose(found.T_new_old, motion, atol=1e-5)


@pytest.mark.parametrize("factor", [0.97, 1.04])
def test_lengths_that_grow_in_view_are_told(factor: float) -> None:
    """The base multiplies lengths about the first keyframe: landmarks and the other keyframes."""
    local_map, track = scene()
    anchor = MapAnchor(local_map, track, CONFIG, inertial=False)
    first = local_map.T_m_k[0, :3, 3].copy()
    local_map.T_m_k[:3, :3, 3] = first + factor * (local_map.T_m_k[:3, :3, 3] - first)
    local_map.rho[:3, :LANDMARKS] /= factor
    found = anchor.motion()
    assert found is not None and found.growth == pytest.approx(factor, abs=1e-4)
    camera = se3.inverse(track.T_c_m)[:3, 3]
    expected = first + factor * (camera - first)
    assert np.allclose(se3.transform(found.T_new_old, camera[None])[0], expected, atol=1e-3)


def test_a_keyframe_out_of_view_moves_nothing() -> None:
    local_map, track = scene()
    anchor = MapAnchor(local_map, track, CONFIG, inertial=False)
    move(local_map, 2, se3.exp(np.array([0.3, 0.1, 0.0, 0.0, 0.1, 0.0])))
    found = anchor.motion()
    assert found is not None
    assert np.allclose(found.T_new_old, np.eye(4), atol=1e-7)


def test_a_keyframe_that_moves_without_its_landmarks_moves_nothing() -> None:
    """The base moves the keyframes, and refines their landmarks so that these stay where they are."""
    local_map, track = scene()
    anchor = MapAnchor(local_map, track, CONFIG, inertial=False)
    index = np.arange(LANDMARKS)
    for k in range(2):
        xyz, _ = local_map.positions(k * local_map.slot_size + index)
        move(local_map, k, se3.exp(np.array([0.02, -0.03, 0.04, 0.01, 0.0, -0.01])))
        p = se3.transform(se3.inverse(local_map.T_m_k[k]), xyz)
        uv = np.array([CAMERA.fx, CAMERA.fy]) * p[:, :2] / p[:, 2:] + np.array([CAMERA.cx, CAMERA.cy])
        offset = (uv - local_map.uv[k, :LANDMARKS]).astype(np.float32)
        inverse = (1.0 / p[:, 2]).astype(np.float32)
        local_map.refine(RefinedLandmarks(KeyframeId(k), index.astype(np.uint16), inverse, offset))
    assert local_map.apply_corrections()
    found = anchor.motion()
    assert found is not None
    assert np.allclose(found.T_new_old, np.eye(4), atol=1e-5)


@pytest.mark.parametrize("left", [10, 40])
def test_culled_landmarks_do_not_count(left: int) -> None:
    local_map, track = scene()
    anchor = MapAnchor(local_map, track, CONFIG, inertial=False)
    move(local_map, 0, se3.exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0])))
    local_map.remove(CulledLandmarks(KeyframeId(0), np.arange(LANDMARKS, dtype=np.uint16), 0))
    local_map.remove(CulledLandmarks(KeyframeId(1), np.arange(left, LANDMARKS, dtype=np.uint16), 0))
    local_map.due = True
    assert local_map.apply_corrections()
    found = anchor.motion()
    if left < CONFIG.pose.min_inliers:
        assert found is None
    else:
        assert found is not None
        assert np.allclose(found.T_new_old, np.eye(4), atol=1e-7)


def test_an_evicted_keyframe_does_not_count() -> None:
    local_map, track = scene()
    anchor = MapAnchor(local_map, replace(track, inlier=track.rows < local_map.slot_size), CONFIG, inertial=False)
    local_map.keyframe[0] = 77
    assert anchor.motion() is None


def corrected(local_map: LocalMap, moved: dict[int, F64], anchor: MapAnchor) -> bool:
    """Whether the map moves when the base sends these motions of keyframes."""
    cache = MapCache(CAMERA, CONFIG.map_cache, None)
    corrections = Corrections(local_map, cache, CONFIG.smoothing)
    return corrections.take([pose_record(local_map, k, motion) for k, motion in moved.items()], [], anchor)[0]


def sideways(px: float) -> F64:
    """A motion that moves landmarks five metres away, the typical ones, by so many pixels."""
    return se3.from_rt(np.eye(3), np.array([5.0 * px / CAMERA.fx, 0.0, 0.0]))


def test_corrections_wait_while_the_camera_hardly_moves() -> None:
    """One keyframe is off by three pixels, but not in view: all wait, and nothing has changed."""
    local_map, track = scene()
    before = local_map.save()
    assert not corrected(
        local_map, {0: sideways(0.1), 2: sideways(3.0)}, MapAnchor(local_map, track, CONFIG, inertial=False)
    )
    for array, was in zip(local_map.save(), before, strict=True):
        assert np.array_equal(array, was)


def test_what_waits_is_not_applied_by_a_step_without_records() -> None:
    local_map, track = scene()
    cache = MapCache(CAMERA, CONFIG.map_cache, None)
    corrections = Corrections(local_map, cache, CONFIG.smoothing)
    held = corrections.take(
        [pose_record(local_map, 2, sideways(3.0))], [], MapAnchor(local_map, track, CONFIG, inertial=False)
    )
    assert not held[0] and not corrections.take([], [], None)[0]


def test_corrections_that_waited_come_with_those_that_matter() -> None:
    local_map, track = scene()
    assert not corrected(local_map, {2: sideways(3.0)}, MapAnchor(local_map, track, CONFIG, inertial=False))
    goal = pose_record(local_map, 2, sideways(3.0)).T_m_k
    assert corrected(
        local_map, {0: sideways(2.0), 1: sideways(2.0)}, MapAnchor(local_map, track, CONFIG, inertial=False)
    )
    assert np.allclose(local_map.T_m_k[2], goal)
    assert local_map.from_base[:3].all()


def test_a_frame_that_tracked_nothing_holds_no_correction_back() -> None:
    local_map, track = scene()
    lost = replace(track, inlier=np.zeros(len(track.rows), np.bool_))
    assert corrected(local_map, {2: sideways(3.0)}, MapAnchor(local_map, lost, CONFIG, inertial=False))


def test_an_undone_correction_is_the_same_as_none() -> None:
    local_map, _ = scene()
    saved = local_map.save()
    index = np.arange(LANDMARKS, dtype=np.uint16)
    local_map.set_pose(pose_record(local_map, 1, sideways(3.0)))
    local_map.refine(
        RefinedLandmarks(KeyframeId(1), index, np.full(LANDMARKS, 0.3, np.float32), np.ones((LANDMARKS, 2), np.float32))
    )
    local_map.try_corrections([KeyframeId(1)])
    assert not np.array_equal(local_map.rho, saved[2])
    local_map.restore(saved)
    for array, was in zip(local_map.save(), saved, strict=True):
        assert np.array_equal(array, was)
    assert local_map.apply_corrections()  # they still wait
    assert np.allclose(local_map.rho[1, :LANDMARKS], 0.3)


@given(st.integers(0, 1000))
def test_a_trial_moves_what_is_in_view_as_taking_over_all_does(seed: int) -> None:
    """Landmarks out of view wait meanwhile; those in view, and the verdict, are the same to the last bit."""
    rng = np.random.default_rng(seed)
    index = np.arange(LANDMARKS, dtype=np.uint16)
    records = [
        RefinedLandmarks(
            KeyframeId(k), index, rng.uniform(0.1, 0.5, LANDMARKS).astype(np.float32),
            rng.normal(0.0, 1.0, (LANDMARKS, 2)).astype(np.float32),
        )
        for k in range(3)
    ]  # fmt: skip
    maps = []
    for trial in (True, False):
        local_map, track = scene(seed)
        anchor = MapAnchor(local_map, track, CONFIG, inertial=False)
        for k in range(3):
            local_map.set_pose(pose_record(local_map, k, sideways(2.0)))
            local_map.refine(records[k])
        out_of_view = local_map.rho[2].copy()
        if trial:
            local_map.try_corrections(anchor.keyframes)
            assert np.array_equal(local_map.rho[2], out_of_view) and local_map.due
        else:
            assert local_map.apply_corrections()
            assert not np.array_equal(local_map.rho[2], out_of_view)
        maps.append((local_map, anchor.motion(), anchor.matters()))
    (tried, moved, matters), (applied, found, all_matter) = maps
    assert moved is not None and found is not None and matters == all_matter
    assert np.array_equal(moved.T_new_old, found.T_new_old) and moved.growth == found.growth
    assert tried.apply_corrections()
    for array, other in zip(tried.save(), applied.save(), strict=True):
        assert np.array_equal(array, other)


@pytest.mark.parametrize("inertial", [False, True])
def test_an_agent_with_an_imu_moves_for_larger_corrections_only(inertial: bool) -> None:
    local_map, track = scene()
    anchor = MapAnchor(local_map, track, CONFIG, inertial=inertial)
    between = 0.5 * (CONFIG.local_map.camera_px + CONFIG.local_map.inertial_px)
    assert corrected(local_map, {k: sideways(between) for k in range(3)}, anchor) is not inertial
