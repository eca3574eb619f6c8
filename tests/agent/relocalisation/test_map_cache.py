"""The base's copies: kept within bounds, met by corners, and enough to find a lost frame."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.relocalisation.frame_features import FrameFeatures
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_codec.schema import CachedKeyframe, CachedLandmarks, Key
from kiteline_core.arrays import F64, I64, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import KeyframeId, SubmapId, keyframe_id, submap_id
from kiteline_hw.system.vocabulary import shipped_vocabulary

CAMERA = RectifiedCamera(752, 480, 420.0, 420.0, 376.0, 240.0, 0.11, True, np.eye(4))
HERE, THERE = submap_id(0, 1, 0), submap_id(3, 0, 0)


@dataclass
class World:
    """Points (n,3) on walls around the origin, with descriptors (n,32) that no two share."""

    points: F64
    descriptor: U8

    def seen(self, T_m_c: F64, rng: np.random.Generator, share: float = 0.6, noise_px: float = 0.5) -> FrameFeatures:
        """Corners of a view: some of the points in it, and as many others."""
        rows, uv, _ = self.in_view(T_m_c)
        keep = rng.random(len(rows)) < share
        rows, uv = rows[keep], uv[keep] + rng.normal(0, noise_px, (int(keep.sum()), 2))
        n = len(rows)
        flips = np.packbits(rng.random((n, 256)) < 0.08, axis=1)
        return FrameFeatures(
            np.concatenate([uv, rng.uniform((8, 8), (744, 472), (n, 2))]),
            np.zeros(2 * n, np.uint8),
            np.zeros(2 * n, np.uint8),
            np.concatenate([self.descriptor[rows] ^ flips, rng.integers(0, 256, (n, 32), dtype=np.uint8)]),
        )

    def in_view(self, T_m_c: F64) -> tuple[I64, F64, F64]:
        local = se3.transform(se3.inverse(T_m_c), self.points)
        z = np.maximum(local[:, 2], 1e-3)
        uv = local[:, :2] / z[:, None] * 420.0 + (376.0, 240.0)
        rows = np.flatnonzero((local[:, 2] > 0.3) & (uv > 8).all(1) & (uv < (744, 472)).all(1))
        return rows, uv[rows], z[rows]

    def copy(
        self, keyframe: KeyframeId, submap: SubmapId, T_m_k: F64, points: int = 100
    ) -> list[CachedKeyframe | CachedLandmarks]:
        """A keyframe that bore the first points in its view, in two parts."""
        rows, uv, z = self.in_view(T_m_k)
        halves = np.array_split(np.arange(min(points, len(rows))), 2)
        zeros = [np.zeros(len(h), np.uint8) for h in halves]
        return [
            CachedKeyframe(keyframe, submap, T_m_k),
            *(
                CachedLandmarks(
                    keyframe, part, h.astype(np.uint16), uv[h].astype(np.float32), (1.0 / z[h]).astype(np.float32),
                    zeros[part], zeros[part], self.descriptor[rows[h]],
                )
                for part, h in enumerate(halves)
            ),
        ]  # fmt: skip


def look(turn: float, at: tuple[float, float] = (0.0, 0.0)) -> F64:
    """T_m_c (4,4) of a level camera that looks so many rad to the left of x."""
    forward = np.array([np.cos(turn), np.sin(turn), 0.0])
    right = np.array([np.sin(turn), -np.cos(turn), 0.0])
    return se3.from_rt(np.stack([right, [0.0, 0.0, -1.0], forward], 1), np.array([*at, 0.0]))


@pytest.fixture
def world() -> World:
    rng = np.random.default_rng(3)
    n = 1500
    phi, radius = rng.uniform(0, 2 * np.pi, n), rng.uniform(3.0, 6.0, n)
    points = np.stack([radius * np.cos(phi), radius * np.sin(phi), rng.uniform(-1.5, 1.5, n)], 1)
    return World(points, rng.integers(0, 256, (n, 32), dtype=np.uint8))


def window(**limits: float) -> MapCache:
    config = AgentConfig()
    return MapCache(CAMERA, replace(config.map_cache, **limits), shipped_vocabulary())


def ring(world: World, box: MapCache, copies: int = 12, submap: SubmapId = HERE) -> None:
    """Copies of keyframes that look all around."""
    for k in range(copies):
        for record in world.copy(keyframe_id(THERE, k), submap, look(2 * np.pi * k / copies)):
            box.store(record)


def test_corners_match_cached_landmarks_and_give_the_camera_pose(world: World) -> None:
    box, rng = window(), np.random.default_rng(0)
    ring(world, box)
    true = look(0.7, (0.2, -0.1))
    guess = true @ se3.exp(np.array([0.005, -0.004, 0.005, 0.001, 0.001, -0.0005]))
    seen = world.seen(true, rng)
    met = box.match_landmarks(se3.inverse(guess), HERE, seen)
    assert len(met.corner) > 40
    error = se3.log(met.T_c_m @ true)
    assert np.linalg.norm(error[:3]) < 0.005
    assert np.linalg.norm(error[3:]) < 0.001
    assert np.all(met.corner < len(seen.uv) // 2), "a corner of noise"
    # Where the corners lie at those depths, the world has points.
    at = (seen.uv[met.corner] - (376.0, 240.0)) / 420.0
    lifted = se3.transform(true, np.column_stack([at, np.ones(len(at))]) * met.depth_m[:, None])
    off_m = np.linalg.norm(lifted[:, None] - world.points, axis=2).min(axis=1)
    assert np.median(off_m / met.depth_m) < 0.01


def test_cached_keyframes_of_another_submap_are_not_matched(world: World) -> None:
    box, rng = window(), np.random.default_rng(1)
    ring(world, box, submap=THERE)
    true = look(0.7)
    assert box.match_landmarks(se3.inverse(true), HERE, world.seen(true, rng)) is None


@pytest.mark.parametrize("turn", [0.3, 2.0, 4.5])
def test_a_lost_frame_is_found(world: World, turn: float) -> None:
    box, rng = window(), np.random.default_rng(2)
    ring(world, box)
    true = look(turn, (0.3, 0.2))
    seen = world.seen(true, rng)
    found = box.find(seen, {HERE}, 0)
    assert found[0] == HERE
    assert np.linalg.norm(se3.log(found[1].T_c_m @ true)[:3]) < 0.02
    assert box.find(seen, {THERE}, 0) is None, "a submap that the agent cannot go on in"


def test_a_frame_of_elsewhere_is_not_found(world: World) -> None:
    box, rng = window(), np.random.default_rng(4)
    ring(world, box)
    other = World(world.points, rng.integers(0, 256, (len(world.points), 32), dtype=np.uint8))
    for turn in np.linspace(0.0, 6.0, 9):
        assert box.find(other.seen(look(float(turn)), rng), {HERE}, 0) is None


def test_what_is_taken_back_is_gone_and_the_number_is_bounded(world: World) -> None:
    box, rng = window(keyframes=8), np.random.default_rng(5)
    ring(world, box, copies=12)
    assert len(box) == 8
    assert set(box.keyframe.tolist()) == {keyframe_id(THERE, k) for k in range(4, 12)}, "the oldest make room"
    true = look(2 * np.pi * 8 / 12)
    assert box.find(world.seen(true, rng), {HERE}, 0) is not None
    box.remove([Key(CachedKeyframe.KIND, int(keyframe_id(THERE, k))) for k in range(4, 12)])
    assert len(box) == 0
    assert box.find(world.seen(true, rng), {HERE}, 0) is None


def test_cached_landmarks_wait_for_their_keyframe(world: World) -> None:
    box, rng = window(), np.random.default_rng(6)
    head, *parts = world.copy(keyframe_id(THERE, 0), HERE, look(0.0))
    for part in reversed(parts):
        box.store(part)
    true = look(0.0)
    assert box.match_landmarks(se3.inverse(true), HERE, world.seen(true, rng)) is None
    box.store(head)
    assert box.match_landmarks(se3.inverse(true), HERE, world.seen(true, rng)) is not None


@pytest.mark.parametrize("units", [0.2, 1.0, 40.0])
def test_landmarks_of_one_camera_are_known_to_the_same_share_of_their_depth_in_any_unit(
    world: World, units: float
) -> None:
    """Other deviations would give them too much weight in the pose, or too little."""
    alone, config = replace(CAMERA, stereo=False, baseline_m=0.1), AgentConfig().map_cache
    box = MapCache(alone, config, shipped_vocabulary())
    keyframe = keyframe_id(THERE, 0)
    for record in world.copy(keyframe, HERE, look(0.0)):
        if isinstance(record, CachedLandmarks):
            record = replace(record, inv_depth=(record.inv_depth / units).astype(np.float32))
        box.store(record)
    met = box._project(se3.inverse(look(0.0)), HERE, 0.0)
    along = np.linalg.norm(met.ray, axis=1) / np.linalg.norm(met.xyz, axis=1)
    assert np.median(along) == pytest.approx(config.sigma_px * 4.0 / alone.bf, rel=0.2)
