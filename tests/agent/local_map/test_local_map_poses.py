"""Corrections of keyframes of the local map: taken over together, once they differ by more than errors."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_agent.config import AgentConfig
from kiteline_agent.keyframes.reference import ReferenceKeyframe
from kiteline_agent.local_map.fused_landmarks import FusedInMap
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_codec.schema import (
    CulledLandmarks,
    FusedLandmarks,
    KeyframeHeader,
    KeyframePose,
    RefinedLandmarks,
    RemovedObservations,
)
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import KEYPOINT_BITS, NO_KEYFRAME, KeyframeId, SubmapId
from tests.agent.plain_landmarks import plain_landmarks

CAMERA = RectifiedCamera(752, 480, 400.0, 400.0, 370.0, 240.0, 0.11, True, np.eye(4))
CONFIG = AgentConfig()
DEPTH_M = 4.0
LEAST_M = CONFIG.local_map.moved_px * DEPTH_M / CAMERA.fx  # of a shift that counts


def local_map(keyframes: int = 4, slots: int = 8, camera: RectifiedCamera = CAMERA) -> LocalMap:
    out = LocalMap(camera, replace(CONFIG.local_map, keyframes=slots))
    for k in range(keyframes):
        add(out, k)
    return out


def add(held: LocalMap, k: int, parent: int = NO_KEYFRAME) -> None:
    n = 30
    held.add(
        KeyframeHeader(KeyframeId(k), k, KeyframeId(parent), np.eye(4), n), np.eye(4),
        plain_landmarks(np.full((n, 2), 200.0), 1.0 / DEPTH_M), k,
    )  # fmt: skip


def told(held: LocalMap, k: int, shift_m: float, turn_rad: float = 0.0) -> None:
    T = se3.from_rt(se3.so3_exp(np.array([0.0, turn_rad, 0.0])), np.array([shift_m, 0.0, 0.0]))
    before = held.T_m_k.copy()
    held.set_pose(KeyframePose(KeyframeId(k), T))
    assert np.array_equal(held.T_m_k, before)  # nothing moves record by record


def shifts(held: LocalMap, keyframes: int = 4) -> list[float]:
    return [float(held.T_m_k[held.slot_of(k)][0, 3]) for k in range(keyframes)]


def test_differences_within_the_errors_are_left() -> None:
    held = local_map()
    for k in range(4):
        told(held, k, 0.9 * LEAST_M)
    assert not held.apply_corrections()
    assert shifts(held) == [0.0] * 4
    assert not held.from_base.any()


@pytest.mark.parametrize("turn", [False, True])
def test_one_that_counts_brings_all_that_wait(turn: bool) -> None:
    held = local_map()
    told(held, 0, 0.5 * LEAST_M)
    told(held, 2, -0.3 * LEAST_M)
    assert not held.apply_corrections()
    told(held, 1, 0.2 * LEAST_M if turn else 1.1 * LEAST_M, 1.1 * CONFIG.local_map.moved_px / CAMERA.fx if turn else 0)
    assert held.apply_corrections()
    assert np.allclose(shifts(held), [0.5 * LEAST_M, (0.2 if turn else 1.1) * LEAST_M, -0.3 * LEAST_M, 0.0])
    assert held.from_base[:4].tolist() == [True, True, True, False]
    assert not held.apply_corrections()  # once


def test_differences_count_against_what_is_held_however_they_came_about() -> None:
    """Small steps of the base add up; a step back before they count leaves the map as it is."""
    held = local_map()
    for share in (0.4, 0.8, 0.4):
        told(held, 0, share * LEAST_M)
        assert not held.apply_corrections()
    for share in (0.6, 0.9, 1.2):
        told(held, 0, share * LEAST_M)
    assert held.apply_corrections()
    assert np.isclose(shifts(held)[0], 1.2 * LEAST_M)


def test_evicted_keyframes_are_forgotten() -> None:
    held = local_map(keyframes=8)
    told(held, 0, 0.5 * LEAST_M)
    add(held, 8)  # takes the slot of keyframe 0
    add(held, 0)
    told(held, 1, 2.0 * LEAST_M) if held.slot_of(1) >= 0 else told(held, 3, 2.0 * LEAST_M)
    assert held.apply_corrections()
    assert held.T_m_k[held.slot_of(0)][0, 3] == 0.0
    held = local_map()
    told(held, 0, 0.5 * LEAST_M)
    held.drop_submap(SubmapId(0))
    assert not held.apply_corrections()


@given(st.permutations(range(4)), st.lists(st.floats(0.0, 3.0), min_size=4, max_size=4))
def test_the_order_of_records_does_not_matter(order: list[int], share: list[float]) -> None:
    one, other = local_map(), local_map()
    for k in range(4):
        told(one, k, share[k] * LEAST_M)
    for k in order:
        told(other, k, share[k] * LEAST_M)
    assert one.apply_corrections() == other.apply_corrections()
    assert shifts(one) == shifts(other)


def refined(held: LocalMap, k: int, offset_px: float) -> None:
    index = np.arange(20, dtype=np.uint16)
    offset = np.tile(np.array([offset_px, 0.0], np.float32), (20, 1))
    held.refine(RefinedLandmarks(KeyframeId(k), index, np.full(20, 1.0 / DEPTH_M, np.float32), offset))


@pytest.mark.parametrize("stereo", [False, True])
def test_refined_landmarks_wait_with_the_poses(stereo: bool) -> None:
    held = local_map(camera=replace(CAMERA, stereo=stereo))
    for k in range(4):
        held.share(KeyframeId(k), 30)
    before = held.bearing.copy()
    refined(held, 0, 0.5 * CONFIG.local_map.moved_px)
    told(held, 1, 0.5 * LEAST_M)
    assert not held.apply_corrections()
    assert np.array_equal(held.bearing, before)
    refined(held, 2, 1.5 * CONFIG.local_map.moved_px)  # these count, and bring all the others
    assert held.apply_corrections()
    moved = np.abs(held.bearing - before).max(axis=(1, 2)) * CAMERA.fx / CONFIG.local_map.moved_px
    assert np.allclose(moved[:4], [0.5, 0.0, 1.5, 0.0])
    assert np.allclose(shifts(held), [0.0, 0.5 * LEAST_M, 0.0, 0.0])
    assert not held.apply_corrections()  # once


@pytest.mark.parametrize("units", [0.2, 1.0, 40.0])
def test_depths_in_a_unit_of_its_own_count_alike_in_any_unit(units: float) -> None:
    """A map that began a hand's breadth above a floor has its walls at a hundred units."""
    held = local_map(camera=replace(CAMERA, stereo=False))
    held.in_own_unit = True
    held.share(KeyframeId(0), 30)
    held.rho[held.rho > 0.0] = 1.0 / (DEPTH_M * units)
    index, offset = np.arange(20, dtype=np.uint16), np.zeros((20, 2), np.float32)
    for growth, counts in ((1.02, False), (1.2, True)):
        inverse = np.full(20, 1.0 / (growth * DEPTH_M * units), np.float32)
        held.refine(RefinedLandmarks(KeyframeId(0), index, inverse, offset))
        assert held.due == counts
    assert held.apply_corrections()
    slot = held.slot_of(KeyframeId(0))
    assert np.allclose(held.sigma_rho[slot, :20] / held.rho[slot, :20], 0.08 * 4.0 / CAMERA.bf, rtol=0.3)


def test_landmarks_that_waited_do_not_come_after_newer_ones() -> None:
    held = local_map()
    held.share(KeyframeId(0), 30)
    before = held.bearing.copy()
    for share in (0.5, 0.1):
        refined(held, 0, share * CONFIG.local_map.moved_px)
    told(held, 1, 2.0 * LEAST_M)
    assert held.apply_corrections()
    moved = np.abs(held.bearing - before).max(axis=(1, 2)) * CAMERA.fx / CONFIG.local_map.moved_px
    assert np.allclose(moved[held.slot_of(0)], 0.1)


def test_landmarks_that_only_the_base_could_triangulate_wait_with_the_others() -> None:
    held = local_map()
    held.share(KeyframeId(0), 30)
    held.usable[0, :5], held.seed[0, :5] = False, True
    refined(held, 0, 0.2)
    saved = held.save()
    held.try_corrections([KeyframeId(0)])  # nothing was tracked there: they tell nothing of the camera
    assert held.seed[0, :5].all()
    assert (held.rho[0, :5] == saved[2][0, :5]).all()
    held.restore(saved)
    told(held, 1, 2.0 * LEAST_M)
    assert held.apply_corrections()
    assert held.usable[0, :5].all()
    assert not held.seed[0, :5].any()
    assert np.allclose(held.rho[0, :5], 1.0 / DEPTH_M)


@pytest.mark.parametrize("kind", [CulledLandmarks, RemovedObservations])
def test_removed_landmarks_are_searched_until_corrections_matter(
    kind: type[CulledLandmarks | RemovedObservations],
) -> None:
    held = local_map()
    held.share(KeyframeId(0), 30)
    index = np.array([3, 4], np.uint16)
    culled = kind is CulledLandmarks
    record = CulledLandmarks(KeyframeId(0), index, 0) if culled else RemovedObservations(KeyframeId(0), index)
    held.remove(record)
    assert held.usable[0, 3:5].all()
    told(held, 1, 2.0 * LEAST_M)
    assert held.apply_corrections()
    assert np.flatnonzero(~held.usable[0, :30]).tolist() == [3, 4]


def test_a_removed_landmark_stays_so_though_the_base_refines_it() -> None:
    """Others still observe it at the base, and the agent has never tracked it."""
    held = local_map()
    held.share(KeyframeId(0), 30)
    held.usable[0, :5], held.seed[0, :5] = False, True
    refined(held, 0, 0.2)
    held.remove(RemovedObservations(KeyframeId(0), np.array([3], np.uint16)))
    for share in (2.0, 4.0):
        told(held, 1, share * LEAST_M)
        assert held.apply_corrections()
        assert np.flatnonzero(~held.usable[0, :30]).tolist() == [3]
        refined(held, 0, 0.2)
    held.drop_submap(SubmapId(0))
    add(held, 5)
    assert held.usable[held.slot_of(5), :30].all()
    assert not held.removed[held.slot_of(5)].any()


def test_refined_landmarks_of_evicted_keyframes_are_forgotten() -> None:
    held = local_map(keyframes=8)
    held.share(KeyframeId(0), 30)
    refined(held, 0, 0.5)
    add(held, 8)  # takes the slot of keyframe 0
    add(held, 0)
    before = held.bearing[held.slot_of(0)].copy()
    told(held, 4, 2.0 * LEAST_M)
    assert held.apply_corrections()
    assert np.array_equal(held.bearing[held.slot_of(0)], before)


def test_a_fused_landmark_is_dropped_once_the_base_has_set_both_poses() -> None:
    held = local_map(2)
    add(held, 2, parent=1)
    held.share(KeyframeId(1), 30)
    held.share(KeyframeId(2), 30)
    slot, roots = held.slot_of(2), np.array([1 << KEYPOINT_BITS | 7, 9 << KEYPOINT_BITS | 3])
    fused = FusedInMap(held)
    fused.take(FusedLandmarks(KeyframeId(2), np.array([4, 5], np.uint16), roots))
    assert held.usable[slot, :30].all()  # drift lies between the keyframes
    told(held, 2, 1.1 * LEAST_M)
    assert held.apply_corrections()
    fused.corrected()
    assert np.flatnonzero(~held.usable[slot, :30]).tolist() == [4]  # the other root is not stored here
    fused.take(FusedLandmarks(KeyframeId(2), np.array([4, 6], np.uint16), roots[[0, 0]]))
    assert held.usable[slot, 6]  # waits with the next corrections that matter
    fused.corrected()
    assert not held.usable[slot, 6]


def test_what_is_told_of_keyframes_that_are_gone_is_forgotten() -> None:
    """Corrections that never matter are not applied: even so no more is held than the map has slots."""
    held = local_map(0, slots=4)
    fused = FusedInMap(held)
    roots = np.array([99 << KEYPOINT_BITS | 7])
    for k in range(1, 40):
        add(held, k)
        fused.take(FusedLandmarks(KeyframeId(k), np.array([4], np.uint16), roots))
        fused.take(FusedLandmarks(KeyframeId(1000 + k), np.array([4], np.uint16), roots))  # never stored
    assert 0 < len(fused._told) <= 4


def test_rotations_stay_orthonormal_along_a_long_chain_of_keyframes() -> None:
    """Each keyframe's pose follows from its parent's, and its children's poses relative to it follow from that."""
    held = local_map(0, slots=6)
    reference = ReferenceKeyframe(held)
    step = se3.exp(np.array([0.1, 0.02, 0.05, 0.1, 0.2, -0.05]))
    add(held, 0)
    reference.set_new(KeyframeId(0), SubmapId(0), np.eye(4), np.eye(4), 0, 0)
    for k in range(1, 80):
        newest = held.T_m_k[held.slot_of(k - 1)]
        reference.T_k_c = se3.inverse(newest) @ se3.orthonormalise(newest @ step)
        keyframe, parent, T_p_k = reference.next_keyframe(SubmapId(0), np.eye(4))
        add(held, k, parent)
        slot = held.slot_of(k)
        held.T_p_k[slot], held.T_m_k[slot] = T_p_k, newest @ T_p_k
        held.compose_unplaced()
        reference.set_new(keyframe, SubmapId(0), newest @ T_p_k, newest @ T_p_k, k, k)
    R = held.T_m_k[held.slot_of(79)][:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_the_reference_is_where_the_base_holds_it_after_a_relocalisation_too() -> None:
    held = local_map(keyframes=0)
    reference, rounded = ReferenceKeyframe(held), se3.exp(np.array([1e-3, 0.0, 0.0, 0.0, 1e-3, 0.0]))
    for k in range(2):
        add(held, k)
        reference.set_new(KeyframeId(k), SubmapId(0), np.eye(4), rounded, k, k)
    for k in (1, 1):
        reference.return_to(KeyframeId(k), 50, 2)
        assert reference.T_m_k is not None
        np.testing.assert_allclose(reference.T_m_k, rounded, atol=1e-15)
    T_w_k = se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.1]))
    held.set_pose(KeyframePose(KeyframeId(1), T_w_k))
    assert held.apply_corrections()
    np.testing.assert_array_equal(reference.T_m_k, T_w_k)  # what the base says is not rounded again
