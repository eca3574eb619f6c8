"""Landmarks of one camera get their depth where rays of two keyframes meet well, and nowhere else."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from kiteline_basestation.config import TriangulationConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.map.map_tables import CULLED
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.triangulation import triangulate_landmarks
from kiteline_codec.schema import RefinedLandmarks
from kiteline_core.arrays import F64, I32, U8
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, point_id, submap_id

CAMERA = RectifiedCamera(640, 480, 400.0, 410.0, 320.0, 240.0, 0.1, False, np.eye(4))
OTHER_LENS = RectifiedCamera(640, 480, 300.0, 290.0, 300.0, 250.0, 0.1, False, np.eye(4))
CONFIG = TriangulationConfig()
ASIDE = np.array([0.3, 0.05, -0.1, 0.02, -0.1, 0.05])  # of the second keyframe in the first one


@dataclass
class Views:
    """A map of keyframes of one agent, or of a submap each, and what they saw."""

    map: SparseMap
    poses: list[F64]
    cameras: list[RectifiedCamera]

    def kf(self, n: int) -> KeyframeId:
        return keyframe_id(submap_id(n if self.cameras[n] is not self.cameras[0] else 0, 1, 0), n)

    def pixels(self, n: int, xyz: F64) -> F64:
        camera, local = self.cameras[n], se3.transform(se3.inverse(self.poses[n]), xyz)
        return np.stack([camera.fx, camera.fy]) * local[:, :2] / local[:, 2:] + [camera.cx, camera.cy]

    def slots(self, n: int, which: range) -> I32:
        return self.map.find_landmarks(np.array([point_id(self.kf(n), i) for i in which], np.int64))

    def positions(self, n: int, which: range) -> tuple[F64, list[bool]]:
        xyz, known = self.map.positions(self.slots(n, which))
        return xyz, known.tolist()

    def triangulate(self, n: int) -> tuple[int, list[int]]:
        """How many, and which keypoints of keyframe 0 are published with a depth."""
        publisher = Publisher(self.map)
        found = triangulate_landmarks(self.map, self.kf(n), CONFIG, publisher)
        told = [r for _, records in publisher.collect() for r in records if isinstance(r, RefinedLandmarks)]
        return found, [i for record in told for i in record.index.tolist()]


def landmarks(n: int, seed: int = 1) -> tuple[F64, U8]:
    rng = np.random.default_rng(seed)
    return rng.uniform([-1.0, -0.7, 2.5], [1.2, 0.7, 4.0], (n, 3)), rng.integers(0, 256, (n, 32), dtype=np.uint8)


def observed(xyz: F64, steps: Sequence[F64], shift_px: Sequence[F64 | float], octave: int = 0) -> Views:
    """Keyframes of one camera; landmarks of the first, without depths, are observed by the others, off by shift_px."""
    views = Views(SparseMap(), [np.eye(4)], [CAMERA] * (1 + len(steps)))
    views.map.set_camera(AgentId(0), CAMERA)
    index, octaves = np.arange(len(xyz), dtype=np.uint16), np.full(len(xyz), octave, np.uint8)
    nothing, angle = np.zeros(len(xyz), np.float32), np.zeros(len(xyz), np.uint8)
    views.map.add_keyframe(views.kf(0), 0, NO_KEYFRAME, np.eye(4), len(xyz))
    uv = views.pixels(0, xyz).astype(np.float32)
    views.map.put_new_landmarks(
        views.kf(0), 0, index, uv, nothing, octaves, angle, np.ones((len(xyz), 32), np.uint8)
    )  # fmt: skip
    ids = np.array([point_id(views.kf(0), int(i)) for i in index], np.int64)
    for n, (step, shift) in enumerate(zip(steps, shift_px, strict=True), 1):
        views.poses.append(views.poses[-1] @ se3.exp(step))
        views.map.add_keyframe(views.kf(n), n, views.kf(n - 1), se3.exp(step), len(xyz))
        uv = (views.pixels(n, xyz) + shift).astype(np.float32)
        views.map.put_observations(views.kf(n), 0, index, uv, nothing, octaves, ids)
    return views


def test_observed_landmarks_lie_where_the_first_and_the_last_ray_meet() -> None:
    """What was seen between, here wrong by far, is not used."""
    xyz, _ = landmarks(8)
    views = observed(xyz, [ASIDE, ASIDE], [np.array([40.0, -30.0]), 0.0])
    assert views.triangulate(2) == (8, list(range(8)))
    np.testing.assert_allclose(views.positions(0, range(8))[0], xyz, atol=2e-3)
    assert views.triangulate(2) == (0, [])


@pytest.mark.parametrize(("degrees", "known"), [(1.0, False), (1.3, True)])
def test_rays_that_are_nearly_parallel_tell_no_depth(degrees: float, known: bool) -> None:
    xyz = np.array([[0.0, 0.0, 3.0]])
    step = np.array([3.0 * np.tan(np.radians(degrees)), 0.0, 0.0, 0.0, 0.0, 0.0])
    assert observed(xyz, [step], [0.0]).triangulate(1)[0] == known


@pytest.mark.parametrize(
    ("across_px", "octave", "known"), [(3.4, 0, True), (4.6, 0, False), (4.6, 1, True), (9.2, 1, False)]
)
def test_rays_that_miss_each_other_by_pixels_tell_no_depth(across_px: float, octave: int, known: bool) -> None:
    """Half of what they miss each other by is left in either view; it may be 2 px, doubled with each octave."""
    xyz, _ = landmarks(5)
    step = np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])
    views = observed(xyz, [step], [np.array([0.0, across_px])], octave)
    assert views.triangulate(1)[0] == (5 if known else 0)


def test_rays_that_meet_behind_the_cameras_tell_no_depth() -> None:
    xyz = np.array([[0.0, 0.0, 3.0]])
    disparity_px = 400.0 * 0.4 / 3.0
    views = observed(xyz, [np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])], [np.array([2.0 * disparity_px, 0.0])])
    assert views.triangulate(1) == (0, [])


def matched(step: F64, scale: float = 1.0, culled: range = range(0)) -> tuple[Views, F64]:
    """Two agents' keyframes with lenses of their own: of 20 landmarks each the first 10 share depths and are fused.

    Those after them have no depth in either. scale: of both submaps in w.
    """
    xyz, descriptor = landmarks(20)
    views = Views(SparseMap(), [np.eye(4), se3.exp(step)], [CAMERA, OTHER_LENS])
    rng = np.random.default_rng(3)
    order = [np.arange(20), np.concatenate([np.arange(10), 10 + rng.permutation(10)])]
    for n, pose in enumerate(views.poses):
        views.map.set_camera(AgentId(n), views.cameras[n])
        views.map.add_keyframe(views.kf(n), 0, NO_KEYFRAME, pose, 20)
        local = se3.transform(se3.inverse(pose), xyz[order[n]])
        inverse = np.where(np.arange(20) < 10, 1.0 / local[:, 2], 0.0).astype(np.float32)
        views.map.put_new_landmarks(
            views.kf(n), 0, np.arange(20, dtype=np.uint16), views.pixels(n, xyz[order[n]]).astype(np.float32), inverse,
            np.zeros(20, np.uint8), np.zeros(20, np.uint8), descriptor[order[n]],
        )  # fmt: skip
    submaps = submap_id(0, 1, 0), submap_id(1, 1, 0)
    views.map.root_submaps[submaps[1]] = submaps[0]
    for submap in submaps:
        views.map.move_submap(submap, sim3.of(scale, np.eye(4)))
    for a, b in zip(views.slots(0, range(10)).tolist(), views.slots(1, range(10)).tolist(), strict=True):
        views.map.fuse(b, a)
    views.map.set_flags(views.slots(0, culled), CULLED)
    return views, scale * xyz


@pytest.mark.parametrize("scale", [1.0, 20.0])
def test_new_landmarks_of_two_views_are_matched_along_epipolar_lines(scale: float) -> None:
    views, xyz = matched(ASIDE, scale)
    found, told = views.triangulate(1)
    assert found == 10 and told == list(range(10, 20))
    np.testing.assert_allclose(views.positions(0, range(20))[0], xyz, atol=5e-3 * scale)
    roots = views.map.keypoints.root[views.slots(1, range(10, 20))]
    assert sorted(roots.tolist()) == views.slots(0, range(10, 20)).tolist()


def test_culled_landmarks_are_not_matched() -> None:
    assert matched(ASIDE, culled=range(12, 15))[0].triangulate(1) == (7, [10, 11, 15, 16, 17, 18, 19])


@pytest.mark.parametrize(("bits", "matched_too"), [(9, False), (15, True)])
def test_a_match_is_clearly_better_than_the_next_on_the_line(bits: int, matched_too: bool) -> None:
    """Of two on one epipolar line the right one is 9 bits off; the other one may not be as near as 12."""
    views, _ = matched(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    right, wrong = views.slots(0, range(10, 12))
    table, descriptor = views.map.keypoints, views.map.keypoints.descriptor[views.slots(0, range(10, 11))]
    table.uv[wrong, 1] = table.uv[right, 1]
    for slot, off in ((right, 9), (wrong, bits)):
        flipped = np.unpackbits(descriptor, axis=1)
        flipped[:, :off] ^= 1
        table.descriptor.put(np.array([slot], np.int32), np.packbits(flipped, axis=1))
    _, told = views.triangulate(1)
    assert (10 in told) == matched_too and 11 not in told and len(told) == 8 + matched_too


@pytest.mark.parametrize("scale", [1.0, 20.0])
def test_two_keyframes_of_one_viewpoint_are_not_matched(scale: float) -> None:
    """Their baseline is below a hundredth of the depth, in whatever unit."""
    assert matched(np.array([0.01, 0.0, 0.0, 0.0, 0.1, 0.0]), scale)[0].triangulate(1) == (0, [])
