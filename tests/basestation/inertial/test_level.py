"""Gravity at keyframes: loop closures keep roll and pitch, and matches that tilt a map are no closures."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig, GraphConfig
from kiteline_basestation.inertial.level import Level, level_of, tilt_between
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.merging.essential_graph import GraphInputs, Scaled, optimise
from kiteline_basestation.merging.loop_consistency import keeps_level
from kiteline_basestation.merging.loop_edges import LoopEdge
from kiteline_codec.schema import CameraIntrinsics, KeyframeHeader, LivePose, Record, SubmapScale, SubmapTie
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id, submap_id

UP = np.array([0.0, 0.0, 1.0])
AGENT = AgentId(1)
OLD, NEW = submap_id(AGENT, 0, 0), submap_id(AGENT, 0, 1)
CAMERA = RectifiedCamera(640, 480, 400.0, 400.0, 320.0, 240.0, 0.1, True, np.eye(4))


def poses(seed: int, n: int) -> list[F64]:
    rng = np.random.default_rng(seed)
    return [se3.exp(np.concatenate([rng.normal(0.0, 2.0, 3), rng.normal(0.0, 0.8, 3)])) for _ in range(n)]


def a_map(tilt: F64, sigma: float = 0.005) -> SparseMap:
    """Two submaps of four keyframes; gravity of the second one is turned by `tilt` (3,) rad against its poses."""
    sparse_map = SparseMap()
    sparse_map.set_camera(AGENT, CAMERA)
    for submap, up_w in ((OLD, UP), (NEW, se3.so3_exp(tilt) @ UP)):
        for k, T_m_k in enumerate(poses(submap, 4)):
            keyframe = keyframe_id(submap, k)
            sparse_map.add_keyframe(keyframe, k, NO_KEYFRAME, T_m_k, 0)
            sparse_map.up[keyframe] = T_m_k[:3, :3].T @ up_w, sigma
    return sparse_map


def test_gravity_of_a_map_is_the_mean_and_bent_keyframes_are_less_certain() -> None:
    sparse_map = a_map(np.zeros(3))
    keyframes = [keyframe_id(OLD, k) for k in range(4)]
    level = level_of(sparse_map, keyframes)
    assert np.allclose(level.up_w, UP, atol=1e-9)
    assert np.allclose(level.sigma, 0.005)
    up, _ = sparse_map.up[keyframes[3]]
    T = sparse_map.world_pose(keyframes[3])
    bent = T[:3, :3].T @ se3.so3_exp(np.array([0.1, 0.0, 0.0])) @ T[:3, :3] @ up
    sparse_map.up[keyframes[3]] = bent, 0.005
    del sparse_map.up[keyframes[1]]
    level = level_of(sparse_map, keyframes)
    assert level.rows.tolist() == [0, 2, 3]
    assert level.sigma[2] > 0.06 > level.sigma[0] > 0.005
    assert level_of(sparse_map, []) is None


@pytest.mark.parametrize(("degrees", "kept"), [(0.0, True), (2.0, True), (8.0, False), (170.0, False)])
def test_a_match_that_tilts_a_map_is_refused(degrees: float, kept: bool) -> None:
    turn = np.radians(degrees) * np.array([0.6, 0.8, 0.0])
    sparse_map = a_map(turn)
    found = tilt_between(sparse_map, NEW, OLD, np.eye(4))
    assert found[0] == pytest.approx(np.radians(degrees), abs=1e-9)
    assert found[1] == pytest.approx(np.hypot(0.005, 0.005))
    back = se3.from_rt(se3.so3_exp(-turn), np.zeros(3))  # it levels the new submap
    assert tilt_between(sparse_map, NEW, OLD, sim3.of(1.3, back))[0] == pytest.approx(0.0, abs=1e-9)
    new, old = keyframe_id(NEW, 0), keyframe_id(OLD, 0)
    T_w_old, T_w_new = sparse_map.world_pose(old), sparse_map.world_pose(new)
    for yaw in (0.0, 1.0, 3.0):  # which gravity does not tell
        X = se3.from_rt(se3.so3_exp(yaw * UP), np.array([3.0, -1.0, 0.5]))
        edge = LoopEdge(new, old, se3.inverse(T_w_old) @ X @ T_w_new, 50, 3.0)
        assert keeps_level(sparse_map, edge) is kept
    assert keeps_level(sparse_map, replace(edge, scale=1.2)) is kept
    sparse_map.up = {k: (up, 0.2) for k, (up, _) in sparse_map.up.items()}
    assert keeps_level(sparse_map, edge) is (degrees < 60.0)  # as uncertain as that
    sparse_map.up = {k: v for k, v in sparse_map.up.items() if k < keyframe_id(NEW, 0)}
    assert keeps_level(sparse_map, edge)  # one agent has no IMU


MOUNT = se3.exp(np.array([0.0, 0.0, 0.0, 0.7, -1.1, 0.4]))  # a camera that looks anywhere


def a_loop(tilted_rad: float, level: bool, scaled: bool, yaw_rad: float = 0.0) -> tuple[F64, F64]:
    """A ring of 60 level vehicles whose loop edge is tilted. Returns their poses before and after.

    scaled: scale may drift. yaw_rad: by which the loop edge is turned, too.
    """
    angle = 2.0 * np.pi * np.arange(60) / 60
    T = np.array([se3.from_rt(se3.so3_exp(a * UP), 9.0 * np.array([np.cos(a), np.sin(a), 0.0])) for a in angle])
    edges = [(i, i + 1) for i in range(59)] + [(0, 59)]
    between = [se3.inverse(T[a]) @ T[b] for a, b in edges]
    between[-1] = between[-1] @ se3.exp(np.array([0.2, 0.1, 0.0, 0.7 * tilted_rad, 0.7 * tilted_rad, yaw_rad]))
    held = np.arange(60) == 0
    sigma = np.tile([0.01, 0.003], (60, 1))
    known = Level(np.arange(60), UP, np.full(60, 0.002)) if level else None
    scales = Scaled(np.ones(60, np.bool_), np.ones(60), np.full(60, 0.003)) if scaled else None
    at_camera = se3.inverse(MOUNT) @ np.array(between) @ MOUNT
    inputs = GraphInputs(
        np.arange(60), T @ MOUNT, held, np.array(edges), at_camera, sigma, np.arange(60) == 59, GraphConfig(), scales,
        known,
    )  # fmt: skip
    return T, optimise(inputs).T_w_k @ se3.inverse(MOUNT)


@pytest.mark.parametrize("scaled", [False, True])
def test_a_loop_bends_yaw_and_keeps_roll_and_pitch(scaled: bool) -> None:
    def tilts(T: F64) -> float:
        return float(np.linalg.norm(np.cross(T[:, :3, 2], UP), axis=1).mean())

    before, without = a_loop(0.05, level=False, scaled=scaled)
    _, kept = a_loop(0.05, level=True, scaled=scaled)
    assert tilts(without) > 0.01
    assert tilts(kept) < 0.4 * tilts(without)
    assert float(np.abs(kept[:, 2, 3]).max()) < 0.4 * float(np.abs(without[:, 2, 3]).max())  # nor do heights
    moved = np.linalg.norm(kept[-1, :2, 3] - before[-1, :2, 3])
    assert moved > 0.1  # the loop still closes
    assert np.allclose(kept[0], before[0], atol=1e-12)


@pytest.mark.parametrize("scaled", [False, True])
def test_gravity_does_not_hold_yaw(scaled: bool) -> None:
    def yaw(T: F64) -> F64:
        return np.asarray(np.arctan2(T[:, 1, 0], T[:, 0, 0]))

    before, free = a_loop(0.0, level=False, scaled=scaled, yaw_rad=0.2)
    _, kept = a_loop(0.0, level=True, scaled=scaled, yaw_rad=0.2)
    turned = np.unwrap(yaw(free) - yaw(before))
    assert np.ptp(turned) > 0.05
    assert np.allclose(np.unwrap(yaw(kept) - yaw(before)), turned, atol=0.1 * np.ptp(turned))


# ties over losses

T_M_LAST = se3.exp(np.array([1.0, 0.5, 0.2, 0.1, -0.2, 0.3]))
T_M_FIRST = se3.exp(np.array([-0.3, 0.2, 1.0, 0.3, 0.1, -0.5]))
T_K_F = se3.exp(np.array([2.0, -0.4, 0.1, 0.05, 0.02, 0.4]))
LAST, FIRST = keyframe_id(OLD, 1), keyframe_id(NEW, 0)
FLOWN: tuple[Record, ...] = (
    CameraIntrinsics(AGENT, CAMERA),
    KeyframeHeader(keyframe_id(OLD, 0), 0, NO_KEYFRAME, np.eye(4), 0),
    KeyframeHeader(LAST, 10**9, keyframe_id(OLD, 0), T_M_LAST, 0),
    KeyframeHeader(FIRST, 4 * 10**9, NO_KEYFRAME, T_M_FIRST, 0),
)


def placed(mapper: Mapper) -> F64 | None:
    """Where the first keyframe of the new submap lies in the last one of the old."""
    S = mapper.placements.get(NEW)
    return None if S is None else se3.inverse(mapper.placements[OLD] @ T_M_LAST) @ sim3.place(S, T_M_FIRST)


def step(mapper: Mapper, now_s: float, *records: Record) -> None:
    mapper.step(MapperInput(((AGENT, records),)), round(now_s * 1e9))


@pytest.mark.parametrize("late", [False, True])
def test_a_submap_after_a_loss_lies_where_its_tie_says(late: bool) -> None:
    mapper, tie = Mapper(BaseConfig()), SubmapTie(NEW, LAST, T_K_F, 0.1, 0.004)
    step(mapper, 0.0, *FLOWN[:3])
    step(mapper, 1.0, *((FLOWN[3],) if late else (tie, FLOWN[3])))
    if late:
        assert placed(mapper) is None  # without images for longer than odometry is followed
        step(mapper, 2.0, tie)
    assert np.allclose(placed(mapper), T_K_F, atol=1e-9)
    better = T_K_F @ se3.exp(np.array([0.1, 0.0, -0.2, 0.0, 0.0, 0.0]))
    step(mapper, 3.0, SubmapTie(NEW, LAST, better, 0.05, 0.004))
    assert np.allclose(placed(mapper), better, atol=1e-9)
    step(mapper, 4.0, SubmapTie(NEW, LAST, T_K_F, 0.5, 0.004))  # too uncertain
    assert np.allclose(placed(mapper), better, atol=1e-9)


@pytest.mark.parametrize("up_to_scale", [False, True])
def test_a_submap_without_metres_keeps_the_unit_of_the_one_before(up_to_scale: bool) -> None:
    mapper, one_eye = Mapper(BaseConfig()), replace(CAMERA, stereo=False)
    step(mapper, 0.0, CameraIntrinsics(AGENT, one_eye), *FLOWN[1:3])
    mapper._placements._set(OLD, sim3.of(2.0, np.eye(4)))  # as after a merge with a map in metres
    metres = () if up_to_scale else (SubmapScale(NEW, 1.0),)
    step(mapper, 1.0, *metres, SubmapTie(NEW, LAST, T_K_F, 0.005, 0.002), FLOWN[3])
    S = mapper.placements[NEW]
    assert sim3.scale_of(S) == pytest.approx(2.0 if up_to_scale else 1.0)
    expected = sim3.place(mapper.placements[OLD], T_M_LAST @ T_K_F)
    assert np.allclose(sim3.place(S, T_M_FIRST), expected, atol=1e-9)


def test_submaps_after_one_that_follows_its_tie_move_along() -> None:
    mapper, later = Mapper(BaseConfig()), submap_id(AGENT, 0, 2)
    T_m_third = se3.exp(np.array([0.1, 0.3, -0.2, 0.0, 0.4, 0.1]))
    step(mapper, 0.0, *FLOWN[:3])
    step(
        mapper, 1.0, SubmapTie(NEW, LAST, T_K_F, 0.1, 0.004), FLOWN[3], LivePose(AGENT, 5 * 10**9, FIRST, np.eye(4), 50)
    )
    step(mapper, 2.0, KeyframeHeader(keyframe_id(later, 0), 5 * 10**9 + 10**8, NO_KEYFRAME, T_m_third, 0))
    between = se3.inverse(mapper.placements[NEW]) @ mapper.placements[later]
    assert np.allclose(mapper.placements[NEW] @ T_M_FIRST, mapper.placements[later] @ T_m_third)  # where it was left
    before = mapper.placements[later]
    better = T_K_F @ se3.exp(np.array([0.1, 0.0, -0.2, 0.0, 0.0, 0.3]))
    step(mapper, 3.0, SubmapTie(NEW, LAST, better, 0.05, 0.004))
    assert np.allclose(placed(mapper), better, atol=1e-9)
    assert not np.allclose(before, mapper.placements[later], atol=0.05)
    assert np.allclose(se3.inverse(mapper.placements[NEW]) @ mapper.placements[later], between, atol=1e-9)
    mapper.map.root_submaps[later] = OLD  # recognised: it lies where the merge says
    kept = mapper.placements[later]
    step(mapper, 4.0, SubmapTie(NEW, LAST, T_K_F, 0.05, 0.004))
    assert np.allclose(mapper.placements[later], kept)


def test_a_recognised_submap_no_longer_follows_its_tie() -> None:
    mapper = Mapper(BaseConfig())
    step(mapper, 0.0, *FLOWN)
    mapper.map.root_submaps[NEW] = OLD
    step(mapper, 1.0, SubmapTie(NEW, LAST, T_K_F, 0.1, 0.004))
    assert placed(mapper) is None


@pytest.mark.parametrize(
    "tie",
    [
        SubmapTie(NEW, keyframe_id(submap_id(2, 0, 0), 1), T_K_F, 0.1, 0.004),  # another agent's
        SubmapTie(NEW, keyframe_id(OLD, 7), T_K_F, 0.1, 0.004),  # unknown
        SubmapTie(NEW, FIRST, T_K_F, 0.1, 0.004),  # its own
        SubmapTie(OLD, FIRST, T_K_F, 0.1, 0.004),  # the submap that defines w
        SubmapTie(NEW, LAST, T_K_F, 0.1, 0.2),  # too uncertain a rotation
    ],
)
def test_a_tie_that_tells_nothing_places_nothing(tie: SubmapTie) -> None:
    mapper = Mapper(BaseConfig())
    step(mapper, 0.0, tie, *FLOWN)
    step(mapper, 1.0, LivePose(AGENT, 4 * 10**9, FIRST, np.eye(4), 50))
    assert placed(mapper) is None
    assert np.array_equal(mapper.placements[OLD], np.eye(4))
